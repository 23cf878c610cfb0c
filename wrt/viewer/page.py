"""The viewer's page: a picture that a user steers, a panel of controls, and the rays of a clicked pixel.

All browsers share one view and get every picture, which has the size of the window that steered last. The folder `page` beside this
module has the page's HTML, style and script.
"""

import io
import math
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wrt.core.errors import InputError
from wrt.core.types import JsonObject
from wrt.picture.film import Film
from wrt.picture.heatmap import colors, short
from wrt.picture.image import encode_png
from wrt.renderer.options import Options
from wrt.renderer.progress import time_left
from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.model import Scene
from wrt.viewer.access import HERE, Place, Refused, access_for
from wrt.viewer.camera import Steering, camera_toml, pose_of
from wrt.viewer.panel import RESOLUTIONS, Panel
from wrt.viewer.rays import Rays, pick
from wrt.viewer.refine import Viewer
from wrt.viewer.renderers import CounterOf, Shown
from wrt.viewer.server import Browser, Server, listen, to_stderr
from wrt.viewer.walks import WalkOf, Walks


class Asked:
    """Questions of browsers to a thread: a queue with one place for each kind. Only the latest question of a kind is answered."""

    def __init__(self) -> None:
        self._waiting: dict[str, Any] = {}
        self._changed, self._closed = threading.Condition(), False

    def put(self, kind: str, what: Any) -> None:
        """Ask `what`, in place of an older question of this kind that waits."""
        with self._changed:
            self._waiting[kind] = what
            self._changed.notify()

    def take(self) -> dict[str, Any]:
        """Wait for questions and return them by kind; an empty dict after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed)
            taken, self._waiting = {} if self._closed else self._waiting, {}
        return taken

    def close(self) -> None:
        """End `take`."""
        with self._changed:
            self._closed = True
            self._changed.notify()


MOST_PIXELS = 1 << 23  # Largest number of pixels of a picture; a larger window shows the picture enlarged.
QUALITY = {True: 92, False: 80}  # JPEG quality of a picture at full resolution, and of a coarse picture.
WIDEST = math.radians(160.0)  # Horizontal angle of view that a narrow window may widen a camera to.
LEGEND_HEIGHT = 12  # Pixels.
DARK_SHARE = 0.01  # Share of visibly too dark pixels above which the page warns.
FOLDER = Path(__file__).parent / "page"
FILES = {"/": ("page.html", "text/html; charset=utf-8"), "/page.css": ("page.css", "text/css; charset=utf-8"),
         "/page.js": ("page.js", "text/javascript; charset=utf-8")}
SAVED = {"/picture.png": "image/png", "/picture.exr": "image/x-exr", "/camera.toml": "application/toml"}


STEER = ("move", "set", "undo", "reset")  # messages after which the picture has the size of the browser's window


class Click(NamedTuple):
    """A click into the picture. x, y: 0 to 1 from the top left corner; sample: index of the sample to inspect."""

    x: float
    y: float
    sample: int


class Tools(NamedTuple):
    """Functions of the laboratory for a page. counter_of: see Viewer. walk_of: see wrt.viewer.walks; None: no walks."""

    counter_of: CounterOf | None = None
    walk_of: WalkOf | None = None


NO_TOOLS = Tools()


class Page:
    """A server with the page and one Viewer. Both run until `close`. `url` is the page's address with the token.

    spp: see Viewer. warn: called with one line, once for each kind of refused request or message. Raises InputError if the server cannot
    listen at `place`."""

    def __init__(self, scene: Scene, options: Options, place: Place = HERE, spp: int = 1024, *,
                 tools: Tools = NO_TOOLS, warn: Callable[[str], None] = to_stderr) -> None:
        self.scene, self.name = scene, scene.name or "picture"
        self.viewer = Viewer(scene, options, self._show, self._report, spp, tools.counter_of)
        self.steering = Steering(pose_of(scene, self.viewer.view.camera))
        self.rays = Rays(self.viewer.renderers, self._report)
        self.panel = Panel(scene, self.viewer, self.steering, self._look)
        self._sizes: dict[Browser, tuple[int, int]] = {}  # of the browsers' windows, in device pixels
        self._leader: Browser | None = None  # the browser that steered last
        self.walks = Walks(tools.walk_of)
        self._asked = Asked()  # "click": a Click to inspect; "walk": a step to show
        self._activity = ""
        self.failure: BaseException | None = None
        self.server: Server | None = None
        listening = listen(place)
        try:
            address, self.port = listening.getsockname()[:2]
            access, self.url = access_for(place, address, self.port)
            self.server = Server(access, self, listening, warn)
        except BaseException:
            listening.close()
            raise
        self.thread = self._start(self.viewer.run, "wrt viewer")
        self._start(self._inspect_clicks, "wrt viewer's inspector")

    def _start(self, work: Callable[[], None], name: str) -> threading.Thread:
        def run() -> None:
            try:
                work()
            except BaseException as error:
                self.failure = error

        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        return thread

    def wait(self) -> None:
        """Wait until `close`. Raises the error that ends a thread."""
        while self.thread.is_alive() and self.failure is None:
            self.thread.join(0.5)
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        self.viewer.stop()
        self._asked.close()
        if self.server is not None:
            self.server.close()

    # --- messages of browsers, in the server's thread -----------------------------------------------------------------

    def joined(self, browser: Browser) -> None:
        browser.put("state", self._state())
        browser.put("activity", {"text": self._activity})
        if self.rays.shown is not None:
            browser.put("rays", self.rays.shown.as_json())

    def left(self, browser: Browser) -> None:
        self._sizes.pop(browser, None)
        if not self._sizes:
            self._leader = None
            self.viewer.pause()
        elif self._leader is browser:
            self._leader = next(iter(self._sizes))
            self._look()
        self._tell_state()

    def received(self, browser: Browser, message: JsonObject) -> None:
        """Act on a checked message."""
        if message["type"] == "size":
            self._sizes[browser] = message["width"], message["height"]
            self._leader = self._leader or browser
            if not self._look():
                self.viewer.again()
        else:
            if message["type"] in STEER and browser in self._sizes:
                self._leader = browser
            self._act(message)
        if message["type"] != "move":
            self._tell_state()

    def _act(self, message: JsonObject) -> None:
        kind = message["type"]
        if kind == "set":
            control = self.panel.controls.get(message["name"])
            if control is None:
                raise Refused("no control", "a change of an unknown control")
            control.check(message["value"])
            control.apply(message["value"])
            self._look()
        elif kind == "click":
            self._asked.put(kind, Click(message["x"], message["y"], message["sample"]))
        elif kind == "walk":
            self._asked.put(kind, message["step"])
        elif kind == "clear":
            self.rays.shown = None
            self._tell("picked", {})
            self.viewer.again()
        else:
            before = self.steering.pose
            if kind == "move":
                self.steering.move(message["kind"], message["by"], message["begin"])
            elif kind == "undo":
                self.steering.undo()
            else:
                self.steering.reset()
            self.panel.look_or(before)

    def _look(self) -> bool:
        """Request the picture of the steered camera in the leader's window; return False if it is the same view as before."""
        size = self.viewer.view.size if self._leader is None else self._sizes[self._leader]
        coarser = 1.0 if self._leader is None else max(RESOLUTIONS[self.panel.resolution], math.sqrt(size[0] * size[1] / MOST_PIXELS))
        size = max(1, round(size[0] / coarser)), max(1, round(size[1] / coarser))
        return self.viewer.change(camera=widened(self.steering.pose.camera, self.scene.settings.size), size=size)

    # --- messages to browsers, from any thread ------------------------------------------------------------------------

    def _tell(self, kind: str, message: JsonObject, data: bytes | None = None) -> None:
        for browser in () if self.server is None else self.server.browsers:
            browser.put(kind, message, data)

    def _tell_state(self) -> None:
        self._tell("state", self._state())

    def _state(self) -> JsonObject:
        return {"scene": self.scene.name or "scene", "browsers": len(self._sizes),
                "controls": [control.as_json() for control in self.panel.controls.values()],
                "camera": camera_toml(self.steering.pose), "counter": bool(self.viewer.view.cost),
                "walks": self.walks.walk_of is not None}

    def _report(self, text: str) -> None:
        self._activity = text
        self._tell("activity", {"text": text})

    def _show(self, shown: Shown) -> None:
        data = encode_png(shown.codes) if shown.done else jpeg(shown.codes, QUALITY[shown.scale == 1])
        inspected = self.rays.shown
        overlay = [] if inspected is None else inspected.overlay(shown.view.camera, shown.view.size)
        self._tell("picture", {"mime": "image/png" if shown.done else "image/jpeg", "size": shown.view.size,
                               "overlay": overlay, **status(shown, self.viewer)}, data)
        if shown.done and self.viewer.display.settings.auto_exposure:
            self._tell_state()

    # --- clicks, in a thread of their own -----------------------------------------------------------------------------

    def _inspect_clicks(self) -> None:
        while asked := self._asked.take():
            try:
                if "click" in asked:
                    self._inspect(asked["click"])
                if "walk" in asked and (shown := self.walks.step(asked["walk"])):
                    self._tell("step", *shown)
            except InputError as error:
                self._report(f"error: {error}")

    def _inspect(self, click: Click) -> None:
        """Tell what is at the clicked point at once, then inspect the pixel's rays."""
        view = self.viewer.view
        prepared = self.viewer.renderers.prepared(view)
        if prepared is None:
            return
        found = pick(prepared, view, click.x, click.y)
        self._tell("picked", {"x": click.x, "y": click.y, "sample": click.sample, "of": self.viewer.spp,
                              "surface": None if found is None else found.as_json()})
        self.walks.aim(prepared, view, click.x, click.y)
        self.rays.shown = self.rays.inspect(view, *click, self.viewer.spp)
        self._report("")
        self._tell("rays", self.rays.shown.as_json())
        self.viewer.again()

    # --- files, in threads of their own -------------------------------------------------------------------------------

    def file(self, path: str) -> tuple[str, bytes] | None:
        if path in FILES:
            name, kind = FILES[path]
            return kind, (FOLDER / name).read_bytes()
        if path == "/legend.png":
            return "image/png", encode_png(np.repeat(colors()[None], LEGEND_HEIGHT, axis=0))
        if path == "/camera.toml":
            return SAVED[path], camera_toml(self.steering.pose).encode()
        picture = self.viewer.picture() if path in SAVED else None
        suffix = Path(path).suffix
        if picture is None or (suffix == ".exr" and not isinstance(picture, Film)):
            return None
        return SAVED[path], encoded(picture, suffix)


def status(shown: Shown, viewer: Viewer) -> JsonObject:
    """Return the panel's text about a picture."""
    height, width = shown.codes.shape[:2]
    target, total = viewer.renderers.options.target_error, viewer.spp
    noise = f", noise {shown.error:.2g}" if math.isfinite(shown.error) else ""
    noise += f" (target {target:g})" if noise and target is not None else ""
    lines = [f"{shown.view.cost} per pixel: mean {short(shown.mean)}, largest {short(shown.largest)}" if shown.view.cost
             else f"{shown.spp:,} of {total:,} samples per pixel{noise}",
             f"{width} x {height} pixels" + (", coarse" if shown.scale > 1 else ""),
             f"{shown.speed / 1e6:.2f} million rays per second, {shown.rays_per_sample:.1f} rays per sample"]
    if shown.visibly_cut > DARK_SHARE:
        lines.append(f"{100.0 * shown.visibly_cut:.2g} % of the pixels are visibly too dark: raise bounces")
    left = "done" if shown.done else time_left(shown.seconds_left) if shown.scale == 1 and not shown.view.cost else "coarse"
    return {"lines": lines, "left": left, "done": 1.0 if shown.done else shown.spp / total if shown.scale == 1 else 0.0,
            "legend": f"0 (dark) to {short(shown.top)} (light)" if shown.view.cost else ""}


def widened(camera: CameraKind, size: tuple[int, int]) -> CameraKind:
    """Return a camera that shows at least the width of a picture of this size, also in a narrower window such as a phone's."""
    if not isinstance(camera, Camera):
        return camera
    least = min(2.0 * math.atan(math.tan(0.5 * camera.fov_y) * size[0] / size[1]), WIDEST)
    return replace(camera, least_fov_x=max(camera.least_fov_x, least))


def jpeg(codes: np.ndarray, quality: int) -> bytes:
    """Encode display codes (h, w, 3) uint8 as a JPEG file."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(codes).save(out, "JPEG", quality=quality)
    return out.getvalue()


def encoded(picture: Film | np.ndarray, suffix: str) -> bytes:
    """Return the bytes of a picture's file. picture: a Film, or a heat map's display codes (h, w, 3) uint8, which become a PNG."""
    if isinstance(picture, np.ndarray):
        return encode_png(picture)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"picture{suffix}"
        picture.save(path)
        return path.read_bytes()
