"""Progressive rendering of a changing view: a coarse picture soon after each change, then finer pictures until the next change.

This module is independent of browsers; wrt.viewer.page connects it to them.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from wrt.accel.structures import ACCELERATORS
from wrt.core.compiling import COMPILING
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.picture.tonemap import auto_exposure, to_codes
from wrt.renderer.options import Options, Progress
from wrt.renderer.prepare import Prepared
from wrt.renderer.render import Renderer
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene, digest

COARSE = 0.08  # Target time of the first picture after a change, in seconds.
PATIENCE = 0.5  # Seconds after which the next change interrupts even the first picture.
EVERY = 0.25  # Seconds between two pictures while a view is refined.
SCALES = (1, 2, 4, 8, 16, 32)  # Pixels of the view, along each side, for one pixel of a coarse picture.
DEEPEST = 12  # Largest max_depth that the user can choose, unless the scene's is larger.
TILE_SIZE = 16  # Pixels a side; small, because the next view waits until all running tiles end.

Kind: TypeAlias = tuple[str, str, tuple[tuple[str, bool], ...]]  # name of the structure, kind of camera and its switches


@dataclass(frozen=True, eq=False)
class View:
    """A picture that the user requests."""

    camera: CameraKind
    size: tuple[int, int]  # width, height in pixels at full resolution
    max_depth: int
    accel: str  # a name in ACCELERATORS

    def same(self, other: "View") -> bool:
        """Return True if both views have the same pixels."""
        fields, others = ((v.size, v.max_depth, v.accel, digest(v.camera)) for v in (self, other))
        return fields == others


def kind_of(view: View) -> Kind:
    """Return what two views must have in common to share a renderer. A lens is open in all of them (CameraKind.opened)."""
    return view.accel, view.camera.kind, tuple(sorted(view.camera.opened().switches().items()))


class Renderers:
    """The renderers of a scene, by `kind_of` their views, made when a view first needs them. progress: callback of all renderers."""

    def __init__(self, scene: Scene, options: Options, progress: Callable[[Progress], None]) -> None:
        self.scene, self.options, self.progress = scene, options, progress
        self.by_kind: dict[Kind, Renderer] = {}

    def prepare(self, view: View) -> None:
        """Make the renderer that the view needs, if it is missing. Raises InputError if that fails."""
        kind = kind_of(view)
        if kind not in self.by_kind:
            options = replace(self.options, accel=view.accel, camera=view.camera.opened(), tile_size=TILE_SIZE, progress=self.progress)
            self.by_kind[kind] = Renderer(self.scene, options)

    def prepared(self, view: View) -> Prepared | None:
        """Return the scene as prepared for the view; None before its structure is built."""
        renderer = self.by_kind.get(kind_of(view))
        return None if renderer is None else renderer.prepared

    def picture(self, view: View, scale: int, spp: int) -> Film:
        """Render the view with one pixel for each block of `scale` x `scale` pixels."""
        renderer = self.by_kind[kind_of(view)]
        width, height = (max(1, -(-side // scale)) for side in view.size)
        renderer.aim(view.camera, view.size, size=(width, height), spp=spp, max_depth=view.max_depth)
        return renderer.run()


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture to show."""

    codes: np.ndarray  # (h, w, 3) uint8, display values.
    view: View
    scale: int  # One pixel stands for scale x scale pixels of the view.
    spp: int  # Smallest number of samples of a pixel.
    speed: float = 0.0  # Rays per second.
    rays_per_sample: float = 0.0  # Mean.
    done: bool = False  # True: the picture gets no finer.
    seconds_left: float = 0.0  # Until it is done, estimated.
    error: float = np.inf  # Estimated root mean square, over pixels and channels, of the standard error; inf: unknown.
    visibly_cut: float = 0.0  # As in Film.stats, of a finished picture.


@dataclass(eq=False)
class _Work:
    """A view that is being rendered."""

    view: View
    request: int  # value of Viewer._requested at the start
    scale: int = 1  # as in Shown
    last_shown: float = -np.inf  # time of the last picture shown


class Pace(dict[str, float]):
    """Measured seconds per sample, by the structure's name."""

    def note(self, view: View, samples: int, seconds: float) -> None:
        if samples:
            self[view.accel] = seconds / samples

    def scales(self, view: View) -> list[int]:
        """Return the scales (see SCALES) to render, down to 1. The first scale should take COARSE seconds at most; unmeasured, it is 8."""
        pace = self.get(view.accel)
        seconds = COARSE * 8**2 if pace is None else pace * view.size[0] * view.size[1]
        first = next((scale for scale in SCALES if seconds / scale**2 <= COARSE), SCALES[-1])
        return [scale for scale in SCALES[::-1] if scale <= first]


class Viewer:
    """Renders the view that `change` requested last. The caller runs `run` in a thread of its own, until `stop`.

    Any thread may call the other methods, which never wait for a picture. `change` and `pause` increase the counter `_requested`. The
    viewer is watched from `change` until `pause`. Meanwhile `run` renders whenever `_requested` differs from `_completed`.

    - scene, options: as for Renderer; options.camera has the first view.
    - show: called with each picture. report: called with a text about compiling, building or an error; "" clears the last text.
    - spp: samples per pixel of the finished picture.
    """

    def __init__(self, scene: Scene, options: Options, show: Callable[[Shown], None],
                 report: Callable[[str], None] = lambda text: None, spp: int = 1024) -> None:
        self.scene, self.show, self.report, self.spp = scene, show, report, spp
        self.settings = scene.settings  # exposure, tonemap and auto_exposure are those of the pictures
        camera = options.camera if isinstance(options.camera, CameraKind) else scene.camera(options.camera)
        self.deepest = max(self.settings.max_depth, DEEPEST)
        self.view = View(camera, self.settings.size, self.settings.max_depth, options.accel)
        self.shown: Shown | None = None  # the last picture
        self.film: Film | None = None  # of `shown`
        self.renderers = Renderers(scene.with_settings(max_depth=self.deepest), options, self._on_progress)
        self._automatic: float | None = None  # stops that auto_exposure added to the last fine picture
        self._pace = Pace()
        self._condition = threading.Condition()
        self._requested = self._completed = 0  # number of requests, and the last request that was rendered or abandoned
        self._watched = self._redraw = self._stopped = False
        self._work: _Work | None = None

    # --- from any thread ----------------------------------------------------------------------------------------------

    def change(self, **changes: Any) -> bool:
        """Request the view with some fields of View changed.

        Returns False if the view is watched and has the same pixels. Raises InputError for an unknown structure."""
        if "accel" in changes:
            ACCELERATORS.check(changes["accel"], "accel")
        with self._condition:
            view = replace(self.view, **changes)
            if view.same(self.view) and self._watched:
                return False
            self.view, self._watched = view, True
            self._requested += 1
            self._condition.notify_all()
            return True

    def tone(self, **changes: Any) -> None:
        """Change exposure or tonemap, without tracing a ray. Raises InputError for an invalid value."""
        with self._condition:
            self.settings = replace(self.settings, **changes)
        self.again()

    def again(self) -> None:
        """Show the last picture once more, for a browser that has not received it."""
        with self._condition:
            self._redraw = True
            self._condition.notify_all()

    def pause(self) -> None:
        """Stop tracing until the next `change`, because no browser is connected."""
        with self._condition:
            self._requested += 1
            self._watched = False

    def stop(self) -> None:
        """Make `run` return once the running tiles end."""
        with self._condition:
            self._stopped = True
            self._requested += 1
            self._condition.notify_all()

    # --- the thread that renders --------------------------------------------------------------------------------------

    def run(self) -> None:
        """Compile and build, then render each requested view, until `stop`."""
        self._prepare(self.view)
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._stopped or self._redraw or self._pending)
            if self._stopped:
                return
            self.step()

    @property
    def _pending(self) -> bool:
        return self._watched and self._requested != self._completed

    def step(self) -> None:
        """Render the requested view until it is done or the next request comes. If nothing is requested, show the last picture again."""
        with self._condition:
            redraw, self._redraw = self._redraw, False
            work = _Work(self.view, self._requested) if self._pending else None
        if work is not None:
            self._refine(work)
            self._completed = work.request
        elif self.shown is not None and self.film is not None and redraw:
            self._put(replace(self.shown, codes=self._codes(self.film, self.shown.scale)), self.film)

    def _refine(self, work: _Work) -> None:
        if not self._prepare(work.view) or self._requested != work.request:
            return
        self.report("")
        self._work = work
        try:
            for scale in self._pace.scales(work.view):
                work.scale = scale
                if not self._trace(work):
                    return
        except InputError as error:
            self.report(f"error: {error}")

    def _prepare(self, view: View) -> bool:
        """Make the renderer that the view needs, if it is missing; return False if that fails, after reporting the error."""
        try:
            self.renderers.prepare(view)
        except InputError as error:
            self.report(f"error: {error}")
            return False
        return True

    def _abandoned(self, work: _Work, seconds: float) -> bool:
        """Return True if there is a newer request, and this view was shown at least once or has taken over PATIENCE seconds."""
        return self._requested != work.request and (work.last_shown > -np.inf or seconds > PATIENCE)

    def _trace(self, work: _Work) -> bool:
        """Render and show the picture at work.scale; return False if it was abandoned."""
        film = self.renderers.picture(work.view, work.scale, self.spp if work.scale == 1 else 1)
        if film.stats["interrupted"]:
            return False
        self._show_film(work, film, (film.stats["rays"], film.stats["seconds"]["trace"], 0.0), done=work.scale == 1)
        return True

    def _on_progress(self, progress: Progress) -> None:
        """Report a renderer's progress, and show its picture every EVERY seconds. Raises KeyboardInterrupt to end an abandoned render."""
        if progress.stage != "trace" or self._work is None:
            done = f" {progress.done / progress.total:.0%}" if progress.stage == "build" else ""
            self.report("building the structure ..." + done if progress.stage == "build" else COMPILING)
            return
        work = self._work
        pixels = work.view.size[0] * work.view.size[1]
        self._pace.note(work.view, progress.done, progress.seconds)
        if self._abandoned(work, progress.seconds):
            raise KeyboardInterrupt
        if (work.scale == 1 and pixels <= progress.done < progress.total and progress.picture is not None
                and time.perf_counter() - work.last_shown >= EVERY):
            self._show_film(work, progress.picture(), (progress.rays, progress.seconds, progress.seconds_left))

    def _show_film(self, work: _Work, film: Film, pace: tuple[int, float, float], done: bool = False) -> None:
        """Show a film. pace: number of rays, seconds so far, and seconds left."""
        rays, seconds, left = pace
        self._put(Shown(self._codes(film, work.scale), work.view, work.scale, int(film.samples.min()), rays / max(seconds, 1e-9),
                        rays / max(int(film.samples.sum()), 1), done, left, math.sqrt(float(film.variance.mean(dtype=np.float64))),
                        film.stats["visibly_cut"] if done else 0.0), film)
        work.last_shown = time.perf_counter()

    def _codes(self, film: Film, scale: int) -> np.ndarray:
        """Return the display codes of a film. A coarse picture keeps the automatic exposure of the last fine one, so as not to flicker."""
        settings = self.settings
        if settings.auto_exposure and (scale == 1 or self._automatic is None):
            self._automatic = auto_exposure(film.pixels)
        automatic = self._automatic or 0.0 if settings.auto_exposure else 0.0
        return to_codes(film.pixels, settings.exposure + automatic, settings.tonemap)

    def _put(self, shown: Shown, film: Film) -> None:
        self.shown, self.film = shown, film
        self.show(shown)
