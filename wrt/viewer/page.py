"""The viewer's page: a picture that a user steers, a panel of controls, and the rays of a clicked pixel.

All browsers share one view and get every picture, which has the size of the window that was opened or resized last. The folder `page`
beside this module has the page's HTML, style and script.
"""

import io
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.errors import InputError
from wrt.core.types import JsonObject
from wrt.picture.image import encode_png
from wrt.renderer.options import Options
from wrt.renderer.progress import time_left
from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.model import Scene
from wrt.viewer.access import HERE, Place, Refused, access_for
from wrt.viewer.camera import Steering, camera_toml
from wrt.viewer.panel import controls_of
from wrt.viewer.rays import Rays, WalkOf, Walks, pick
from wrt.viewer.refine import Shown, Viewer
from wrt.viewer.server import Browser, Server, listen, to_stderr

MOST_PIXELS = 1 << 23  # Largest number of pixels of a picture; a larger window shows the picture enlarged.
QUALITY = 90  # JPEG quality of a picture that gets finer.
WIDEST = math.radians(160.0)  # Horizontal angle of view that a narrow window may widen a camera to.
DARK_SHARE = 0.01  # Share of visibly too dark pixels above which the page warns.
FOLDER = Path(__file__).parent / "page"
FILES = {"/": ("page.html", "text/html; charset=utf-8"), "/page.css": ("page.css", "text/css; charset=utf-8"),
         "/page.js": ("page.js", "text/javascript; charset=utf-8")}


class Page:
    """A server with the page and one Viewer. Both run until `close`. `url` is the page's address with the token.

    spp: see Viewer. walk_of: see Walks. warn: called with one line, once for each kind of refused request or message. Raises InputError
    if the server cannot listen at `place`."""

    def __init__(self, scene: Scene, options: Options, place: Place = HERE, spp: int = 1024, *,
                 walk_of: WalkOf | None = None, warn: Callable[[str], None] = to_stderr) -> None:
        self.scene = scene
        self.viewer = Viewer(scene, options, self._show, self._report, spp)
        self.steering = Steering(scene, self.viewer.view.camera)
        self.controls = controls_of(self.viewer, self.steering)
        self.rays, self.walks = Rays(self.viewer.renderers, self._report), Walks(walk_of)
        self._size = self.viewer.view.size  # of the window that was opened or resized last, in device pixels
        self._asked: dict[str, JsonObject] = {}  # the newest message "click" and the newest message "walk" that wait for an answer
        self._asking = threading.Condition()
        self._activity = ""
        self.failure: BaseException | None = None
        self.server: Server | None = None
        listening = listen(place)
        address, self.port = listening.getsockname()[:2]
        access, self.url = access_for(place, address, self.port)
        self.server = Server(access, self, listening, warn)
        self.thread = self._start(self.viewer.run, "wrt viewer")
        self._start(self._answer_clicks, "wrt viewer's inspector")

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
        self._ask("close", {})
        if self.server is not None:
            self.server.close()

    # --- messages of browsers, in the server's thread -----------------------------------------------------------------

    def joined(self, browser: Browser) -> None:
        browser.put("state", self._state())
        browser.put("activity", {"text": self._activity})
        if self.rays.shown is not None:
            browser.put("rays", self.rays.shown.as_json())

    def left(self, browser: Browser) -> None:
        if self.server is not None and not self.server.browsers:
            self.viewer.pause()
        self._tell("state", self._state())

    def received(self, message: JsonObject) -> None:
        """Act on a checked message. If a camera's numbers overflow, keep the camera, and raise the InputError."""
        kind, before = message["type"], self.steering.pose
        try:
            if kind == "set":
                control = self.controls.get(message["name"])
                if control is None:
                    raise Refused("no control", "a change of an unknown control")
                control.check(message["value"])
                control.apply(message["value"])
            elif kind == "size":
                self._size = message["width"], message["height"]
            elif kind == "move":
                self.steering.move(message["kind"], message["by"])
            elif kind == "reset":
                self.steering.reset()
            elif kind == "clear":
                self.rays.shown = None
                self._tell("picked", {})
            else:
                self._ask(kind, message)
            if not self._look() and kind in ("size", "clear"):
                self.viewer.again()
        except InputError:
            self.steering.pose = before
            raise
        if kind != "move":
            self._tell("state", self._state())

    def _look(self) -> bool:
        """Request the picture of the steered camera; return False if it is the same view as before."""
        coarser = max(1.0, math.sqrt(self._size[0] * self._size[1] / MOST_PIXELS))
        size = max(1, round(self._size[0] / coarser)), max(1, round(self._size[1] / coarser))
        return self.viewer.change(camera=widened(self.steering.pose.camera, self.scene.settings.size), size=size)

    # --- messages to browsers, from any thread ------------------------------------------------------------------------

    def _tell(self, kind: str, message: JsonObject, data: bytes | None = None) -> None:
        for browser in () if self.server is None else self.server.browsers:
            browser.put(kind, message, data)

    def _state(self) -> JsonObject:
        return {"scene": self.scene.name or "scene", "browsers": 0 if self.server is None else len(self.server.browsers),
                "controls": [control.as_json() for control in self.controls.values()], "walks": self.walks.walk_of is not None}

    def _report(self, text: str) -> None:
        self._activity = text
        self._tell("activity", {"text": text})

    def _show(self, shown: Shown) -> None:
        data = encode_png(shown.codes) if shown.done else jpeg(shown.codes)
        inspected = self.rays.shown
        overlay = [] if inspected is None else inspected.overlay(shown.view.camera, shown.view.size)
        self._tell("picture", {"mime": "image/png" if shown.done else "image/jpeg", "size": shown.view.size, "overlay": overlay,
                               "camera": camera_toml(self.steering.pose), **status(shown, self.viewer)}, data)

    # --- clicks, in a thread of their own -----------------------------------------------------------------------------

    def _ask(self, kind: str, message: JsonObject) -> None:
        with self._asking:
            self._asked[kind] = message
            self._asking.notify()

    def _answer_clicks(self) -> None:
        asked: dict[str, JsonObject] = {}
        while "close" not in asked:
            with self._asking:
                self._asking.wait_for(lambda: self._asked)
                asked, self._asked = self._asked, {}
            try:
                if "click" in asked:
                    self._inspect(**asked["click"])
                if "walk" in asked and (shown := self.walks.step(asked["walk"]["step"])):
                    self._tell("step", *shown)
            except InputError as error:
                self._report(f"error: {error}")

    def _inspect(self, x: float, y: float, sample: int, **_: Any) -> None:
        """Tell what is at the clicked point at once, then inspect the pixel's rays."""
        view, spp = self.viewer.view, self.viewer.spp
        prepared = self.viewer.renderers.prepared(view)
        if prepared is None:
            return
        self._tell("picked", {"x": x, "y": y, "sample": sample, "of": spp, "surface": pick(prepared, view, x, y)})
        self.walks.aim(prepared, view, x, y)
        self.rays.shown = self.rays.inspect(view, x, y, sample, spp)
        self._report("")
        self._tell("rays", self.rays.shown.as_json())
        self.viewer.again()

    def file(self, path: str) -> tuple[str, bytes] | None:
        name, kind = FILES.get(path, ("", ""))
        return (kind, (FOLDER / name).read_bytes()) if name else None


def status(shown: Shown, viewer: Viewer) -> JsonObject:
    """Return the panel's text about a picture."""
    height, width = shown.codes.shape[:2]
    target, total = viewer.renderers.options.target_error, viewer.spp
    noise = f", noise {shown.error:.2g}" if math.isfinite(shown.error) else ""
    noise += f" (target {target:g})" if noise and target is not None else ""
    lines = [f"{shown.spp:,} of {total:,} samples per pixel{noise}",
             f"{width} x {height} pixels" + (", coarse" if shown.scale > 1 else ""),
             f"{shown.speed / 1e6:.2f} million rays per second, {shown.rays_per_sample:.1f} rays per sample"]
    if shown.visibly_cut > DARK_SHARE:
        lines.append(f"{100.0 * shown.visibly_cut:.2g} % of the pixels are visibly too dark: raise bounces")
    left = "done" if shown.done else time_left(shown.seconds_left) if shown.scale == 1 else "coarse"
    return {"lines": lines, "left": left, "done": 1.0 if shown.done else shown.spp / total if shown.scale == 1 else 0.0}


def widened(camera: CameraKind, size: tuple[int, int]) -> CameraKind:
    """Return a camera that shows at least the width of a picture of this size, also in a narrower window such as a phone's."""
    if not isinstance(camera, Camera):
        return camera
    least = min(2.0 * math.atan(math.tan(0.5 * camera.fov_y) * size[0] / size[1]), WIDEST)
    return replace(camera, least_fov_x=max(camera.least_fov_x, least))


def jpeg(codes: np.ndarray) -> bytes:
    """Encode display codes (h, w, 3) uint8 as a JPEG file."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(codes).save(out, "JPEG", quality=QUALITY)
    return out.getvalue()
