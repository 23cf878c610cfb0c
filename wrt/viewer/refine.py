"""A picture that follows a changing view: coarse at once after a change, then finer until the next change.

It knows nothing of browsers; wrt.viewer.page connects it to one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import require_known
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.picture.heatmap import colored, top_of
from wrt.picture.tonemap import to_codes
from wrt.renderer.options import Options, Progress
from wrt.renderer.progress import COMPILING
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene
from wrt.viewer.renderers import CounterOf, Renderers, Shown, View

COARSE = 0.08  # Target seconds of the first picture after a change.
PATIENCE = 0.5  # Seconds after which it is abandoned for the next change.
EVERY = 0.25  # Seconds between two pictures of a view that is refined.
SCALES = (1, 2, 4, 8, 16, 32)  # Pixels a side of the view to one of a coarse picture.
REST = 0.4  # Seconds after a change of exposure or tone mapping until the picture is shown as done again.
DEEPEST = 12  # Bounces that a user can choose, or more if the scene has more.
COSTS = ("nodes", "primitives", "probes", "boxes", "stack", "node_bytes")  # Counters for heat maps.


@dataclass(eq=False)
class _Work:
    """A view that is being rendered."""

    view: View
    request: int  # the change that asked for it
    scale: int = 1
    last_shown: float = -np.inf  # time of its last picture


class Pace(dict[tuple[str, bool], float]):
    """Seconds of a sample, by structure and by kind: picture (False) or heat map (True)."""

    def note(self, view: View, samples: int, seconds: float) -> None:
        if samples:
            self[view.accel, bool(view.cost)] = seconds / samples

    def scales(self, view: View) -> list[int]:
        """Return the scales to render: the first that should take at most COARSE (8 without a measurement), then finer ones to 1."""
        pace = self.get((view.accel, bool(view.cost)))
        seconds = COARSE * 8**2 if pace is None else pace * view.size[0] * view.size[1]
        first = next((scale for scale in SCALES if seconds / scale**2 <= COARSE), SCALES[-1])
        return [scale for scale in SCALES[::-1] if scale <= first]


class Viewer:
    """A renderer of the view that `change` asked for last. A thread of its own calls `run`, which returns after `stop`.

    All other methods may be called from any thread and never wait for a picture. `change` and `pause` increase `_requested`. The
    thread renders while that differs from `_completed` and somebody watches.

    `scene` and `options` are those of a Renderer, with the first view as options.camera. `run` calls `show` with each picture, and
    `report` with a text on its work or "". Refining ends at `spp` samples a pixel. `counter_of` is that of Renderers.
    """

    def __init__(self, scene: Scene, options: Options, show: Callable[[Shown], None],
                 report: Callable[[str], None] = lambda text: None, spp: int = 1024, counter_of: CounterOf | None = None) -> None:
        self.scene, self.show, self.report, self.spp = scene, show, report, spp
        self.costs = () if counter_of is None else COSTS
        settings = scene.settings
        camera = options.camera if isinstance(options.camera, CameraKind) else scene.camera(options.camera)
        self.deepest = max(settings.max_depth, DEEPEST)
        self.view = View(camera, settings.size, settings.max_depth, options.accel)
        self.exposure, self.tonemap = settings.exposure, settings.tonemap
        self.shown: Shown | None = None  # the last picture
        self.renderers = Renderers(scene.with_settings(max_depth=self.deepest), options, self._on_progress, counter_of)
        self._pace = Pace()
        self._condition = threading.Condition()
        self._requested = self._completed = 0  # counts of changes
        self._watched = self._redraw = self._stopped = False
        self._toning = False  # exposure or tone mapping change, so that the last picture was not shown as done
        self._work: _Work | None = None
        self._film: Film | None = None  # of `shown`, unless that is a heat map

    # --- from any thread ----------------------------------------------------------------------------------------------

    def change(self, **changes: Any) -> bool:
        """Ask for another view by fields of View; return whether it differs. camera: also a function of the present one.

        Raises InputError for an unknown structure or counter.
        """
        if "accel" in changes:
            ACCELERATORS.check(changes["accel"], "accel")
        if changes.get("cost"):
            require_known(changes["cost"], self.costs, "counter", "cost")
        with self._condition:
            if callable(changes.get("camera")):
                changes["camera"] = changes["camera"](self.view.camera)
            view = replace(self.view, **changes)
            if view.same(self.view) and self._watched:
                return False
            self.view, self._watched = view, True
            self._requested += 1
            self._condition.notify_all()
            return True

    def tone(self, exposure: float, tonemap: str) -> None:
        """Change exposure and tone mapping, without tracing a ray."""
        with self._condition:
            self.scene = self.scene.with_settings(exposure=exposure, tonemap=tonemap)  # raises for invalid values
            self.exposure, self.tonemap = exposure, tonemap
        self.again()

    def again(self) -> None:
        """Show the last picture once more, to another viewer."""
        with self._condition:
            self._redraw = True
            self._condition.notify_all()

    def pause(self) -> None:
        """Stop tracing until the next change, because nobody watches."""
        with self._condition:
            self._requested += 1
            self._watched = False

    def stop(self) -> None:
        """Make `run` return after the tiles that are being traced."""
        with self._condition:
            self._stopped = True
            self._requested += 1
            self._condition.notify_all()

    def picture(self) -> Film | np.ndarray | None:
        """Return the last picture for a file: a Film with exposure and tone mapping, or the codes (h, w, 3) of a heat map."""
        with self._condition:
            film, shown = self._film, self.shown
        if film is None:
            return None if shown is None else shown.codes
        return replace(film, exposure=self.exposure, tonemap=self.tonemap)

    # --- the thread that renders --------------------------------------------------------------------------------------

    def run(self) -> None:
        """Compile and build, then render every view that is asked for until `stop`."""
        self._prepare(self.view)
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._stopped or self._redraw or self._pending, REST if self._toning else None)
            if self._stopped:
                return
            self.step()

    @property
    def _pending(self) -> bool:
        return self._watched and self._requested != self._completed

    def step(self) -> None:
        """Refine the last request until it is done or there is another one; or show the picture with another tone mapping.

        While exposure or tone mapping change the picture is not shown as done, so that it is sent faster."""
        with self._condition:
            redraw, self._redraw = self._redraw, False
            work = _Work(self.view, self._requested) if self._pending else None
        if work is not None:
            self._refine(work)
            self._completed = work.request
        elif self.shown is not None and (redraw or self._toning):
            film = self._film
            codes = self.shown.codes if film is None else to_codes(film.pixels, self.exposure, self.tonemap)
            self._put(replace(self.shown, codes=codes), film, rests=not redraw)

    def _refine(self, work: _Work) -> None:
        if not self._prepare(work.view) or self._requested != work.request:
            return
        self.report("")
        self._work = work
        try:
            for scale in self._pace.scales(work.view):
                work.scale = scale
                if not (self._count(work) if work.view.cost else self._trace(work)):
                    return
        except InputError as error:
            self.report(f"error: {error}")

    def _prepare(self, view: View) -> bool:
        """Make the renderer that the view needs, if it is missing; return whether that succeeded."""
        try:
            self.renderers.prepare(view)
        except InputError as error:
            self.report(f"error: {error}")
            return False
        return True

    def _abandoned(self, work: _Work, seconds: float) -> bool:
        """Return whether there is another request, and this view was shown or has had its time."""
        return self._requested != work.request and (work.last_shown > -np.inf or seconds > PATIENCE)

    def _trace(self, work: _Work) -> bool:
        """Render and show the picture at one scale; return False if it was abandoned."""
        film = self.renderers.picture(work.view, work.scale, self.spp if work.scale == 1 else 1)
        if film.stats["interrupted"]:
            return False
        self._show_film(work, film, film.stats["rays"], film.stats["seconds"]["trace"], done=work.scale == 1)
        return True

    def _on_progress(self, progress: Progress) -> None:
        """Report a renderer's progress. Raises KeyboardInterrupt to end the render."""
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
            self._show_film(work, progress.picture(), progress.rays, progress.seconds)

    def _show_film(self, work: _Work, film: Film, rays: int, seconds: float, done: bool = False) -> None:
        codes = to_codes(film.pixels, self.exposure, self.tonemap)
        self._put(Shown(codes, work.view, work.scale, int(film.samples.min()), rays / max(seconds, 1e-9),
                        rays / max(int(film.samples.sum()), 1), done), film)
        work.last_shown = time.perf_counter()

    def _put(self, shown: Shown, film: Film | None, rests: bool = True) -> None:
        with self._condition:
            self.shown, self._film = shown, film
        self._toning = shown.done and not rests
        self.show(shown if rests else replace(shown, done=False))

    def _count(self, work: _Work) -> bool:
        """Render and show the heat map at one scale; return False if it was abandoned."""
        begin = time.perf_counter()

        def go_on(done: int) -> bool:
            seconds = time.perf_counter() - begin
            self._pace.note(work.view, done, seconds)
            return not self._abandoned(work, seconds)

        costs = self.renderers.costs(work.view, work.scale, go_on)
        if costs is None:
            return False
        values = costs[work.view.cost]
        top = top_of(values)
        speed = int(costs["probes"].sum(dtype=np.int64)) / (time.perf_counter() - begin)
        self._put(Shown(colored(values, top), work.view, work.scale, 1, speed, float(costs["probes"].mean()), work.scale == 1,
                        top, float(values.mean()), float(values.max())), None)
        work.last_shown = time.perf_counter()
        return True
