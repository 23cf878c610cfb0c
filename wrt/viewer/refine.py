"""A picture that follows what is asked of it: coarse at once when anything changes, then finer while nothing does.

It knows nothing of browsers: wrt.viewer.page puts one in front of it.
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

COARSE = 0.08  # seconds that the first picture after a change should take
PATIENCE = 0.5  # seconds after which it is given up, where the next change is waiting
EVERY = 0.25  # seconds between two pictures of the same view, while it is refined
SCALES = (1, 2, 4, 8, 16, 32)  # pixels a side of the picture to one of a coarse one
REST = 0.4  # seconds without a change of exposure or tone mapping after which the picture is put out as done again
DEEPEST = 12  # bounces that can be chosen, if the scene has no more itself
COSTS = ("nodes", "primitives", "probes", "boxes", "stack", "node_bytes")  # counters that are offered as heat maps


@dataclass(eq=False)
class _Work:
    """A view that is being rendered; number: of the change that asked for it; shown: when a picture of it was put out last."""

    view: View
    number: int
    scale: int = 1
    shown: float = -np.inf


class Pace(dict[tuple[str, bool], float]):
    """Seconds that a sample took last, by structure, and of the picture (False) or of heat maps (True)."""

    def note(self, view: View, samples: int, seconds: float) -> None:
        if samples:
            self[view.accel, bool(view.cost)] = seconds / samples

    def scales(self, view: View) -> list[int]:
        """From the first that is likely to take no longer than COARSE down to 1; 8 where no sample was taken yet."""
        pace = self.get((view.accel, bool(view.cost)))
        seconds = COARSE * 8**2 if pace is None else pace * view.size[0] * view.size[1]
        first = next((scale for scale in SCALES if seconds / scale**2 <= COARSE), SCALES[-1])
        return [scale for scale in SCALES[::-1] if scale <= first]


class Viewer:
    """Renders what `change` asked for last. `run` does so until `stop`, for a thread of its own; all else may be called from
    any thread, and never waits for a picture.

    show: gets every picture; report: gets a word on what is going on, "" when nothing is to be said. Both are called by `run`.
    scene, options: as for a Renderer; options.camera is the view to begin with. spp: where refining ends. counter_of: what counts
    for heat maps, as for Renderers.
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
        self.shown: Shown | None = None  # last
        self.renderers = Renderers(scene.with_settings(max_depth=self.deepest), options, self._hear, counter_of)
        self._pace = Pace()
        self._condition = threading.Condition()
        self._number = self._done = 0  # of changes, so far and rendered
        self._looked_at = self._toned = self._stopped = False
        self._changing = False  # whether the last picture was put out in another way, and not as done
        self._work: _Work | None = None
        self._film: Film | None = None  # of `shown`, where that is no heat map

    # --- from any thread ----------------------------------------------------------------------------------------------

    def change(self, **changes: Any) -> bool:
        """Ask for another view (fields of View; camera may be a function of the present one); whether it is another one.

        Raises InputError for a structure or a counter that there is not.
        """
        if "accel" in changes:
            ACCELERATORS.check(changes["accel"])
        if changes.get("cost"):
            require_known(changes["cost"], self.costs, "counter")
        with self._condition:
            if callable(changes.get("camera")):
                changes["camera"] = changes["camera"](self.view.camera)
            view = replace(self.view, **changes)
            if view.same(self.view) and self._looked_at:
                return False
            self.view, self._looked_at = view, True
            self._number += 1
            self._condition.notify_all()
            return True

    def tone(self, exposure: float, tonemap: str) -> None:
        """Show the picture in another way; no ray is traced for it."""
        with self._condition:
            self.scene = self.scene.with_settings(exposure=exposure, tonemap=tonemap)  # raises where they are none
            self.exposure, self.tonemap = exposure, tonemap
        self.again()

    def again(self) -> None:
        """Show the last picture once more: somebody else looks."""
        with self._condition:
            self._toned = True
            self._condition.notify_all()

    def pause(self) -> None:
        """Trace nothing more until the next change: nobody looks."""
        with self._condition:
            self._number += 1
            self._looked_at = False

    def stop(self) -> None:
        """Let `run` end, after the tiles that it is at."""
        with self._condition:
            self._stopped = True
            self._number += 1
            self._condition.notify_all()

    def picture(self) -> Film | np.ndarray | None:
        """What was shown last, to be saved: a Film (with exposure and tone mapping), or the codes (h, w, 3) of a heat map."""
        with self._condition:
            film, shown = self._film, self.shown
        if film is None:
            return None if shown is None else shown.codes
        return replace(film, exposure=self.exposure, tonemap=self.tonemap)

    # --- the thread that renders --------------------------------------------------------------------------------------

    def run(self) -> None:
        """Compile and build at once, then render whatever is asked for, until `stop`."""
        self._prepare(self.view)
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._stopped or self._toned or self._asked, REST if self._changing else None)
            if self._stopped:
                return
            self.step()

    @property
    def _asked(self) -> bool:
        return self._looked_at and self._number != self._done

    def step(self) -> None:
        """Render what was asked for last until it is as fine as it gets, or until something else is asked for. Or show the picture
        in another way: not as done while exposure or tone mapping change, so that it is sent faster; and again when they rest."""
        with self._condition:
            toned, self._toned = self._toned, False
            work = _Work(self.view, self._number) if self._asked else None
        if work is not None:
            self._refine(work)
            self._done = work.number
        elif self.shown is not None and (toned or self._changing):
            film = self._film
            codes = self.shown.codes if film is None else to_codes(film.pixels, self.exposure, self.tonemap)
            self._put(replace(self.shown, codes=codes), film, rests=not toned)

    def _refine(self, work: _Work) -> None:
        if not self._prepare(work.view) or self._number != work.number:
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
        """Make the renderer that the view needs, if there is none; whether there is one then."""
        try:
            self.renderers.prepare(view)
        except InputError as error:
            self.report(f"error: {error}")
            return False
        return True

    def _given_up(self, work: _Work, seconds: float) -> bool:
        """Whether something else is asked for, and this view has been seen or has had its time."""
        return self._number != work.number and (work.shown > -np.inf or seconds > PATIENCE)

    def _trace(self, work: _Work) -> bool:
        """The picture at one scale, if it was not given up."""
        film = self.renderers.picture(work.view, work.scale, self.spp if work.scale == 1 else 1)
        if film.stats["interrupted"]:
            return False
        self._show_film(work, film, film.stats["rays"], film.stats["seconds"]["trace"], done=work.scale == 1)
        return True

    def _hear(self, progress: Progress) -> None:
        """A renderer's progress. KeyboardInterrupt is how it is made to end."""
        if progress.stage != "trace" or self._work is None:
            done = f" {progress.done / progress.total:.0%}" if progress.stage == "build" else ""
            self.report("building the structure ..." + done if progress.stage == "build" else COMPILING)
            return
        work = self._work
        pixels = work.view.size[0] * work.view.size[1]
        self._pace.note(work.view, progress.done, progress.seconds)
        if self._given_up(work, progress.seconds):
            raise KeyboardInterrupt
        if (work.scale == 1 and pixels <= progress.done < progress.total and progress.picture is not None
                and time.perf_counter() - work.shown >= EVERY):
            self._show_film(work, progress.picture(), progress.rays, progress.seconds)

    def _show_film(self, work: _Work, film: Film, rays: int, seconds: float, done: bool = False) -> None:
        codes = to_codes(film.pixels, self.exposure, self.tonemap)
        self._put(Shown(codes, work.view, work.scale, int(film.samples.min()), rays / max(seconds, 1e-9),
                        rays / max(int(film.samples.sum()), 1), done), film)
        work.shown = time.perf_counter()

    def _put(self, shown: Shown, film: Film | None, rests: bool = True) -> None:
        with self._condition:
            self.shown, self._film = shown, film
        self._changing = shown.done and not rests
        self.show(shown if rests else replace(shown, done=False))

    def _count(self, work: _Work) -> bool:
        """The heat map at one scale, if it was not given up."""
        begin = time.perf_counter()

        def go_on(done: int) -> bool:
            seconds = time.perf_counter() - begin
            self._pace.note(work.view, done, seconds)
            return not self._given_up(work, seconds)

        costs = self.renderers.costs(work.view, work.scale, go_on)
        if costs is None:
            return False
        values = costs[work.view.cost]
        top = top_of(values)
        speed = int(costs["probes"].sum(dtype=np.int64)) / (time.perf_counter() - begin)
        self._put(Shown(colored(values, top), work.view, work.scale, 1, speed, float(costs["probes"].mean()), work.scale == 1,
                        top, float(values.mean()), float(values.max())), None)
        work.shown = time.perf_counter()
        return True
