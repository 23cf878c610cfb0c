// The viewer's page: it shows pictures and the panel of wrt/viewer/page.py, and sends what the user does. messages.py lists the messages.
"use strict";

const by = id => document.getElementById(id);
const stage = by("stage"), frame = by("frame"), canvas = by("picture"), overlay = by("overlay");
const NARROW = 700, DRAG_FROM = 4, REPEAT = 400;  // CSS pixels of a phone's width and of a click; milliseconds between two turns of a wheel
const BARE = 1e5;  // a slider with a larger ratio of its ends is a number alone
const GRACE = 2000;  // milliseconds until the page tries to connect again
let socket, picture = null, surface = null, sample = 0, picked = null, chosen = -1;
const rows = new Map();

// --- connection ------------------------------------------------------------------------------------------------------

function connect() {
  const address = new URL("socket", location.href);
  address.protocol = address.protocol.replace("http", "ws");
  address.search = "";
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

function pixels() {
  return [stage.clientWidth, stage.clientHeight].map(side => Math.max(1, Math.round(side * devicePixelRatio)));
}

function sendSize() {
  const [width, height] = pixels();
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
  by("legend").hidden = !head.legend;
  by("counts").textContent = head.legend;
  by("exr").hidden = Boolean(head.legend);
  document.body.dataset.pictures = turn;
}

function fit() {
  if (!picture) return;
  const [width, height] = picture.size;
  const scale = Math.min(stage.clientWidth / width, stage.clientHeight / height);
  const snapped = side => Math.round(side * devicePixelRatio) / devicePixelRatio;  // a picture between device pixels would be blurred
  frame.style.width = `${snapped(width * scale)}px`;
  frame.style.height = `${snapped(height * scale)}px`;
  frame.style.left = `${snapped(0.5 * (stage.clientWidth - width * scale))}px`;
  frame.style.top = `${snapped(0.5 * (stage.clientHeight - height * scale))}px`;
  drawOverlay(width * scale, height * scale);
}

function svg(name, attributes) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

function drawOverlay(width, height) {
  overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const drawn = [];
  for (const line of picture.overlay) {
    const dash = line.dashed ? {"stroke-dasharray": "6 4"} : {};
    for (const [x0, y0, x1, y1, hidden] of line.parts) {
      const ends = {x1: x0 * width, y1: y0 * height, x2: x1 * width, y2: y1 * height};
      const opacity = hidden ? 0.3 : 1;
      if (!hidden) drawn.push(svg("line", {...ends, stroke: "#fff", "stroke-width": line.width + 2, opacity: 0.6, ...dash}));
      drawn.push(svg("line", {...ends, stroke: line.color, "stroke-width": line.width, opacity, "data-node": line.node, ...dash}));
    }
    const last = line.parts.at(-1);
    if (last && (line.node === 0 || line.mark && line.mark !== "missed")) {
      drawn.push(svg("circle", {cx: last[2] * width, cy: last[3] * height, r: line.node === 0 ? 5 : 3, fill: line.color, stroke: "#fff",
        opacity: last[4] ? 0.3 : 1, "data-node": line.node}));
    }
  }
  overlay.replaceChildren(...drawn);
  mark();
}

new ResizeObserver(() => { fit(); clearTimeout(stage.wait); stage.wait = setTimeout(sendSize, 100); }).observe(stage);

// --- moves -----------------------------------------------------------------------------------------------------------

const moves = new Map();  // of this frame, by kind
function move(kind, step, begin) {
  const old = moves.get(kind) ?? {by: [0, 0, 0], begin: false};
  moves.set(kind, {by: old.by.map((value, i) => value + (step[i] ?? 0)), begin: old.begin || begin});
  if (moves.size === 1) requestAnimationFrame(flush);
}

function flush() {
  for (const [kind, {by: step, begin}] of moves) send("move", {kind, by: step.map(value => Math.max(-100, Math.min(100, value))), begin});
  moves.clear();
}

const fingers = new Map();
let gesture = null;  // {x, y: where it began; moved: whether it is a drag; begin: whether no move was sent yet; kind}

stage.addEventListener("pointerdown", event => {
  if (event.target.closest("button")) return;
  stage.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, event);
  const pans = event.button === 2 || event.button === 1 || event.shiftKey;
  gesture = {x: event.clientX, y: event.clientY, moved: fingers.size > 1, begin: true, kind: pans ? "pan" : "orbit"};
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
    move("dolly", [Math.log(apart(before) / apart(event))], gesture.begin);
    move("pan", shift, false);
  } else {
    move(gesture.kind, shift, gesture.begin);
  }
  gesture.begin = false;
  fingers.set(event.pointerId, event);
});

for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, event => {
  const known = fingers.delete(event.pointerId);
  if (known && gesture && !gesture.moved && name === "pointerup" && gesture.kind === "orbit") click(event);
  if (!fingers.size) gesture = null;
});

stage.addEventListener("contextmenu", event => event.preventDefault());

let turned = 0;
stage.addEventListener("wheel", event => {
  event.preventDefault();
  move("dolly", [event.deltaY * [0.001, 0.03, 0.5][event.deltaMode]], event.timeStamp - turned > REPEAT);
  turned = event.timeStamp;
}, {passive: false});

function click(event) {
  const box = frame.getBoundingClientRect();
  const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  if (x < 0 || x > 1 || y < 0 || y > 1) return;
  sample = 0;
  send("click", {x, y, sample});
}

const STEP = 0.05, TURN = 1 / 36;
const HELD = {
  w: ["walk", [0, 0, STEP]], s: ["walk", [0, 0, -STEP]], a: ["walk", [-STEP, 0, 0]], d: ["walk", [STEP, 0, 0]],
  q: ["walk", [0, -STEP, 0]], e: ["walk", [0, STEP, 0]],
  ArrowLeft: ["orbit", [TURN, 0]], ArrowRight: ["orbit", [-TURN, 0]], ArrowUp: ["orbit", [0, TURN]], ArrowDown: ["orbit", [0, -TURN]],
};
const PRESSED = {
  u: () => send("undo"), r: () => send("reset"), p: togglePanel, "?": () => by("help").showModal(), Escape: clearRays,
  f: () => document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen(),
  ",": () => walk(-1), ".": () => walk(1),
  "[": () => expose(-0.5), "]": () => expose(0.5),
};

document.addEventListener("keydown", event => {
  const typing = event.target.matches("input:not([type=range]):not([type=checkbox]), select, textarea") || by("help").open;
  if (typing || event.altKey || event.metaKey || (event.ctrlKey && event.key !== "z")) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (HELD[key] && !(event.target.matches("input") && key.startsWith("Arrow"))) {
    move(...HELD[key], !event.repeat);
  } else if (event.ctrlKey) {
    send("undo");
  } else if (PRESSED[key]) {
    PRESSED[key]();
  } else if (/^[1-9]$/.test(key)) {
    const name = rows.get("camera")?.control.choices[key - 1];
    if (name !== undefined) send("set", {name: "camera", value: name});
  } else {
    return;
  }
  event.preventDefault();
});

function expose(stops) {
  const {control} = rows.get("exposure");
  send("set", {name: "exposure", value: Math.min(control.high, Math.max(control.low, control.value + stops))});
}

// --- the panel -------------------------------------------------------------------------------------------------------

function togglePanel() {
  document.body.classList.toggle("closed");
}

function showState(state) {
  document.title = `${state.scene} - wrt`;
  by("title").textContent = state.scene + (state.browsers > 1 ? ` (${state.browsers} browsers)` : "");
  by("title").title = state.browsers > 1 ? "All browsers share this view" : state.scene;
  by("camera").textContent = state.camera;
  by("walk").hidden = !state.walks;
  by("png").download = `${state.scene}.png`;
  by("exr").download = `${state.scene}.exr`;
  for (const control of state.controls) {
    if (!rows.has(control.name)) rows.set(control.name, makeRow(control));
    const row = rows.get(control.name);
    row.control = control;
    row.element.hidden = !control.shown;
    for (const input of row.inputs) {
      if (input === document.activeElement && input.type === "number" || input.held) continue;
      if (input.type === "checkbox") input.checked = control.value; else input.value = control.value;
    }
  }
  by("focus").hidden = !surface || !rows.get("focus").control.shown;
}

function make(name, properties = {}, children = []) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

function group(name) {
  const id = `group ${name}`;
  if (!by(id)) by("controls").append(make("fieldset", {id}, [make("legend", {textContent: name})]));
  return by(id);
}

function makeRow(control) {
  const {name, low, high, step} = control;
  const set = value => send("set", {name, value});
  const within = text => Math.min(high, Math.max(low, Number(text)));
  const inputs = [];
  if (control.kind === "choice") {
    inputs.push(make("select", {onchange: event => set(event.target.value)}, control.choices.map(each => make("option", {textContent: each, value: each}))));
  } else if (control.kind === "flag") {
    inputs.push(make("input", {type: "checkbox", onchange: event => set(event.target.checked)}));
  } else {
    const bare = low > 0 && high / low > BARE;
    const number = make("input", {type: "number", step: "any", className: bare ? "wide" : ""});
    number.onchange = () => { if (number.value !== "") set(within(number.value)); number.blur(); };
    if (!bare) {
      const range = make("input", {type: "range", min: low, max: high, step});
      let wait = 0;
      range.oninput = () => {
        range.held = true;
        number.value = range.value;
        wait ||= requestAnimationFrame(() => { wait = 0; set(within(range.value)); });
      };
      range.onchange = () => { range.held = false; };
      inputs.push(range);
    }
    inputs.push(number);
  }
  for (const input of inputs) input.setAttribute("aria-label", name);
  const label = make("span", {textContent: name}, control.unit ? [" ", make("span", {className: "unit", textContent: control.unit})] : []);
  const element = make("div", {className: "row", title: control.hint}, [label, ...inputs]);
  group(control.group).append(element);
  return {control, element, inputs};
}

// --- rays ------------------------------------------------------------------------------------------------------------

function showPicked(message) {
  surface = message.surface;
  picked = message.x === undefined ? null : message;
  by("tools").hidden = !picked;
  leaveWalk();
  by("tree").replaceChildren();
  const text = !picked ? "Click into the picture: its surface and its rays appear here."
    : surface ? `${surface.object} (${surface.material}), primitive ${surface.prim}, at distance ${surface.distance} scene units`
    : "no surface: the background";
  by("picked").textContent = text;
  by("found").textContent = picked ? text : "";
  if (picked) {
    by("sample").value = picked.sample;
    by("of").textContent = `of ${picked.of}`;
  }
  by("focus").hidden = !surface || !rows.get("focus").control.shown;
}

function showRays(message) {
  const lists = new Map([[-1, make("ul")]]);
  message.nodes.forEach((node, i) => {
    const text = make("span", {textContent: node.text, onmouseenter: () => mark(i), onmouseleave: () => mark(-1)});
    text.style.setProperty("--color", node.color);
    text.dataset.node = i;
    const item = make("li", {}, [text]);
    if (!lists.has(node.parent)) {
      lists.set(node.parent, make("ul"));
      lists.get(-1).querySelector(`[data-node="${node.parent}"]`).parentElement.append(lists.get(node.parent));
    }
    lists.get(node.parent).append(item);
  });
  const more = message.more ? [make("p", {textContent: `and ${message.more} more`})] : [];
  const head = `Pixel ${message.pixel.join(",")}, sample ${message.sample}: radiance ${message.radiance}`;
  by("tree").replaceChildren(make("p", {textContent: head}), lists.get(-1), ...more);
  by("tools").hidden = false;
}

let steps = null;  // {step, last} of the walk that is shown
function showStep(head, blob) {
  steps = head;
  by("walking").hidden = false;
  by("step").value = head.step;
  by("step").max = head.last;
  by("last").textContent = `of ${head.last}`;
  by("steptext").textContent = head.text;
  URL.revokeObjectURL(by("drawing").src);
  by("drawing").src = by("enlarge").href = URL.createObjectURL(blob);
}

function walk(by_steps) {
  if (!picked || by("walk").hidden) return;
  goTo(steps ? steps.step + by_steps : 0);
}

function goTo(step) {
  send("walk", {step: Math.min(Math.max(0, Math.round(step)), steps ? steps.last : 0)});
}

function leaveWalk() {
  steps = null;
  by("walking").hidden = true;
}

function mark(node = chosen) {
  chosen = node;
  for (const each of overlay.children) each.classList.toggle("picked", chosen >= 0 && each.dataset.node === String(chosen));
}

function clearRays() {
  send("clear");
}

by("sample").onchange = () => picked && send("click", {x: picked.x, y: picked.y, sample: Math.min(Math.max(0, Math.round(by("sample").value)), picked.of - 1)});
by("focus").onclick = () => send("set", {name: "focus", value: surface.depth});
by("clear").onclick = clearRays;
by("walk").onclick = () => { leaveWalk(); goTo(0); };
by("back").onclick = () => walk(-1);
by("next").onclick = () => walk(1);
by("step").onchange = () => goTo(Number(by("step").value));
by("leave").onclick = leaveWalk;
by("undo").onclick = () => send("undo");
by("reset").onclick = () => send("reset");
by("keys").onclick = () => by("help").showModal();
by("hide").onclick = by("show").onclick = togglePanel;
by("controls").onsubmit = event => event.preventDefault();
by("copy").onclick = async () => {
  const text = by("camera").textContent;
  try {
    await navigator.clipboard.writeText(text);
    by("copy").textContent = "copied";
  } catch {  // without HTTPS, a page of another machine may not write the clipboard
    getSelection().selectAllChildren(by("camera"));
    by("copy").textContent = "press Ctrl-C";
  }
  setTimeout(() => { by("copy").textContent = "copy TOML"; }, 1500);
};
if (innerWidth <= NARROW) document.body.classList.add("closed");
connect();
