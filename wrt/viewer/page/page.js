// The viewer's page: it shows pictures and the panel of wrt/viewer/page.py, and sends what the user does. panel.py lists the messages.
"use strict";

const by = id => document.getElementById(id);
const stage = by("stage"), frame = by("frame"), canvas = by("picture"), overlay = by("overlay");
const NARROW = 700, DRAG_FROM = 4;  // CSS pixels: width of a phone, and of a drag that is no click
const GRACE = 2000;  // milliseconds until the page tries to connect again
let socket, picture = null, picked = null, steps = null;
const rows = new Map();  // of the panel, by the control's name

// --- connection ------------------------------------------------------------------------------------------------------

function connect() {
  const address = new URL("socket", location.href);
  address.protocol = address.protocol.replace("http", "ws");
  socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { activity(""); sendSize(); };
  socket.onclose = () => { activity("the connection to the viewer is lost; trying again ..."); setTimeout(connect, GRACE); };
  socket.onmessage = ({data}) => {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      RECEIVED[message.type](message);
      return;
    }
    const length = new DataView(data).getUint32(0);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    RECEIVED[head.type](head, new Blob([new Uint8Array(data, 4 + length)], {type: head.mime}));
  };
}

function send(type, fields = {}) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({type, ...fields}));
}

const RECEIVED = {state: showState, activity: message => activity(message.text), picture: showPicture, picked: showPicked, rays: showRays, step: showStep};

function activity(text) {
  by("activity").textContent = text;
  by("activity").hidden = !text;
}

// --- the picture -----------------------------------------------------------------------------------------------------

function sendSize() {
  const [width, height] = [stage.clientWidth, stage.clientHeight].map(side => Math.max(1, Math.round(side * devicePixelRatio)));
  send("size", {width, height});
}

let latest = 0;
async function showPicture(head, blob) {
  const turn = ++latest;
  const bitmap = await createImageBitmap(blob);
  if (turn < latest) return;
  [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  picture = head;
  fit();
  by("status").replaceChildren(...head.lines.flatMap(line => [line, document.createElement("br")]));
  by("done").style.width = `${100 * head.done}%`;
  by("line").textContent = `${head.lines[0]}, ${head.left}`;
  by("camera").textContent = head.camera;
  document.body.dataset.pictures = turn;
}

function fit() {
  if (!picture) return;
  const [width, height] = picture.size;
  const scale = Math.min(stage.clientWidth / width, stage.clientHeight / height);
  const snapped = side => `${Math.round(side * devicePixelRatio) / devicePixelRatio}px`;  // between device pixels it would be blurred
  frame.style.width = snapped(width * scale);
  frame.style.height = snapped(height * scale);
  frame.style.left = snapped(0.5 * (stage.clientWidth - width * scale));
  frame.style.top = snapped(0.5 * (stage.clientHeight - height * scale));
  drawOverlay(width * scale, height * scale);
}

function svg(name, attributes) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

function drawOverlay(width, height) {
  overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
  overlay.replaceChildren(...picture.overlay.flatMap(line => {
    const [x1, y1, x2, y2] = line.ends.map((value, i) => value * (i % 2 ? height : width));
    const dash = line.dashed ? {"stroke-dasharray": "6 4"} : {};
    const drawn = [svg("line", {x1, y1, x2, y2, stroke: "#fff", "stroke-width": line.width + 2, opacity: 0.6, ...dash}),
      svg("line", {x1, y1, x2, y2, stroke: line.color, "stroke-width": line.width, "data-node": line.node, ...dash})];
    if (line.node === 0 || line.mark && line.mark !== "missed") {
      drawn.push(svg("circle", {cx: x2, cy: y2, r: line.node === 0 ? 5 : 3, fill: line.color, stroke: "#fff", "data-node": line.node}));
    }
    return drawn;
  }));
}

new ResizeObserver(() => { fit(); clearTimeout(stage.wait); stage.wait = setTimeout(sendSize, 100); }).observe(stage);

by("save").onclick = () => canvas.toBlob(blob => {
  const link = make("a", {href: URL.createObjectURL(blob), download: `${by("title").title}.png`});
  link.click();
  URL.revokeObjectURL(link.href);
});

// --- moves -----------------------------------------------------------------------------------------------------------

const moves = new Map();  // of this frame, by kind
function move(kind, step) {
  if (!moves.size) requestAnimationFrame(flush);
  moves.set(kind, (moves.get(kind) ?? [0, 0, 0]).map((value, i) => value + (step[i] ?? 0)));
}

function flush() {
  for (const [kind, step] of moves) send("move", {kind, by: step.map(value => Math.max(-100, Math.min(100, value)))});
  moves.clear();
}

const fingers = new Map();
let gesture = null;  // {x, y: where it began; moved: whether it is a drag; kind}

stage.addEventListener("pointerdown", event => {
  if (event.target.closest("button")) return;
  stage.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, event);
  const pans = event.button === 2 || event.button === 1 || event.shiftKey;
  gesture = {x: event.clientX, y: event.clientY, moved: fingers.size > 1, kind: pans ? "pan" : "orbit"};
});

stage.addEventListener("pointermove", event => {
  const before = fingers.get(event.pointerId);
  if (!before || !gesture) return;
  gesture.moved ||= Math.hypot(event.clientX - gesture.x, event.clientY - gesture.y) > DRAG_FROM;
  if (!gesture.moved) return;
  const height = frame.clientHeight || stage.clientHeight;
  const shift = [(event.clientX - before.clientX) / height / fingers.size, (event.clientY - before.clientY) / height / fingers.size];
  if (fingers.size === 2) {
    const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, each]) => each);
    const apart = each => Math.max(1, Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY));
    move("dolly", [Math.log(apart(before) / apart(event))]);
    move("pan", shift);
  } else {
    move(gesture.kind, shift);
  }
  fingers.set(event.pointerId, event);
});

for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, event => {
  const known = fingers.delete(event.pointerId);
  if (known && gesture && !gesture.moved && name === "pointerup" && gesture.kind === "orbit") click(event);
  if (!fingers.size) gesture = null;
});

stage.addEventListener("contextmenu", event => event.preventDefault());

stage.addEventListener("wheel", event => {
  event.preventDefault();
  move("dolly", [event.deltaY * [0.001, 0.03, 0.5][event.deltaMode]]);
}, {passive: false});

function click(event) {
  const box = frame.getBoundingClientRect();
  const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  if (x >= 0 && x <= 1 && y >= 0 && y <= 1) send("click", {x, y, sample: 0});
}

const STEP = 0.05, TURN = 1 / 36;
const HELD = {
  w: ["walk", [0, 0, STEP]], s: ["walk", [0, 0, -STEP]], a: ["walk", [-STEP, 0, 0]], d: ["walk", [STEP, 0, 0]],
  q: ["walk", [0, -STEP, 0]], e: ["walk", [0, STEP, 0]],
  ArrowLeft: ["orbit", [TURN, 0]], ArrowRight: ["orbit", [-TURN, 0]], ArrowUp: ["orbit", [0, TURN]], ArrowDown: ["orbit", [0, -TURN]],
};
const PRESSED = {
  r: () => send("reset"), p: togglePanel, "?": () => by("help").showModal(), Escape: () => send("clear"),
  ",": () => walk(-1), ".": () => walk(1),
};

document.addEventListener("keydown", event => {
  const typing = event.target.matches("input:not([type=range]), select") || by("help").open;
  if (typing || event.altKey || event.metaKey || event.ctrlKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const camera = rows.get("camera")?.control.choices[key - 1];
  if (HELD[key] && !(event.target.matches("input") && key.startsWith("Arrow"))) move(...HELD[key]);
  else if (PRESSED[key]) PRESSED[key]();
  else if (camera !== undefined) send("set", {name: "camera", value: camera});
  else return;
  event.preventDefault();
});

// --- the panel -------------------------------------------------------------------------------------------------------

function togglePanel() {
  document.body.classList.toggle("closed");
}

function showState(state) {
  document.title = `${state.scene} - wrt`;
  by("title").textContent = state.scene + (state.browsers > 1 ? ` (${state.browsers} browsers)` : "");
  by("title").title = state.scene;
  by("walk").hidden = !state.walks;
  for (const control of state.controls) {
    if (!rows.has(control.name)) rows.set(control.name, makeRow(control));
    const row = rows.get(control.name);
    row.control = control;
    row.element.hidden = !control.shown;
    for (const input of row.inputs) {
      if (!input.held && (input !== document.activeElement || input.type !== "number")) input.value = control.value;
    }
  }
}

function make(name, properties = {}, children = []) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

function makeRow(control) {
  const {name, low, high, step} = control;
  const set = value => send("set", {name, value});
  const within = text => Math.min(high, Math.max(low, Number(text)));
  const inputs = [];
  if (control.choices.length) {
    inputs.push(make("select", {onchange: event => set(event.target.value)}, control.choices.map(each => make("option", {textContent: each, value: each}))));
  } else {
    const range = make("input", {type: "range", min: low, max: high, step}), number = make("input", {type: "number", step: "any"});
    number.onchange = () => { if (number.value !== "") set(within(number.value)); number.blur(); };
    range.oninput = () => { range.held = true; number.value = range.value; set(within(range.value)); };
    range.onchange = () => { range.held = false; };
    inputs.push(range, number);
  }
  for (const input of inputs) input.setAttribute("aria-label", name);
  const element = make("div", {className: "row", title: control.hint}, [make("span", {textContent: name}), ...inputs]);
  by("controls").append(element);
  return {control, element, inputs};
}

// --- rays ------------------------------------------------------------------------------------------------------------

function showPicked(message) {
  const surface = message.surface;
  picked = message.x === undefined ? null : message;
  by("tools").hidden = !picked;
  leaveWalk();
  by("tree").replaceChildren();
  const text = !picked ? "Click into the picture: its surface and its rays appear here."
    : surface ? `${surface.object} (${surface.material}), primitive ${surface.prim}, at distance ${surface.distance} scene units`
    : "no surface: the background";
  by("picked").textContent = text;
  by("found").textContent = picked ? text : "";
  if (!picked) return;
  by("sample").value = picked.sample;
  by("of").textContent = `of ${picked.of}`;
}

function showRays(message) {
  const lists = [make("ul")], items = [];  // lists[i + 1]: what begins at node i
  message.nodes.forEach((node, i) => {
    const text = make("span", {textContent: node.text, onmouseenter: () => mark(i), onmouseleave: () => mark(-1)});
    text.style.setProperty("--color", node.color);
    items[i] = make("li", {}, [text]);
    if (!lists[node.parent + 1]) items[node.parent].append(lists[node.parent + 1] = make("ul"));
    lists[node.parent + 1].append(items[i]);
  });
  const more = message.more ? [make("p", {textContent: `and ${message.more} more`})] : [];
  const head = `Pixel ${message.pixel.join(",")}, sample ${message.sample}: radiance ${message.radiance}`;
  by("tree").replaceChildren(make("p", {textContent: head}), lists[0], ...more);
}

function mark(node) {
  for (const each of overlay.children) each.classList.toggle("picked", each.dataset.node === String(node));
}

function showStep(head, blob) {  // steps: {step, last} of the walk that is shown
  steps = head;
  by("walking").hidden = false;
  by("step").value = head.step;
  by("last").textContent = `of ${head.last}`;
  by("steptext").textContent = head.text;
  URL.revokeObjectURL(by("drawing").src);
  by("drawing").src = URL.createObjectURL(blob);
}

function walk(more) {
  if (picked && !by("walk").hidden) goTo(steps ? steps.step + more : 0);
}

function goTo(step) {
  send("walk", {step: Math.min(Math.max(0, Math.round(step)), steps ? steps.last : 0)});
}

function leaveWalk() {
  steps = null;
  by("walking").hidden = true;
}

by("sample").onchange = () => picked && send("click", {x: picked.x, y: picked.y, sample: Math.min(Math.max(0, Math.round(by("sample").value)), picked.of - 1)});
by("clear").onclick = () => send("clear");
by("walk").onclick = () => { leaveWalk(); goTo(0); };
by("back").onclick = () => walk(-1);
by("next").onclick = () => walk(1);
by("step").onchange = () => goTo(Number(by("step").value));
by("leave").onclick = leaveWalk;
by("reset").onclick = () => send("reset");
by("keys").onclick = () => by("help").showModal();
by("hide").onclick = by("show").onclick = togglePanel;
by("controls").onsubmit = event => event.preventDefault();
if (innerWidth <= NARROW) document.body.classList.add("closed");
connect();
