"""Distributed renders: workers trace the tiles; this process keeps the film and controls passes, limits and checkpoints.

The pixels have the same bits as those of a render on one device."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, nullcontext
from dataclasses import replace
from typing import Any

from wrt.core.compiling import WATCH
from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.renderer.checkpoint import checkpoint_of
from wrt.renderer.distributed.workers import DeviceWorkers, ExecutorWorkers, Job, Reply, packaged
from wrt.renderer.film_arrays import AovFilm, DeviceFilm
from wrt.renderer.options import Options, Progress
from wrt.renderer.plan import Plan, plan_of
from wrt.renderer.result import Facts
from wrt.renderer.schedule import STEP_SECONDS, Run, Steps
from wrt.renderer.tiles import Rectangle, Work, tiles
from wrt.renderer.upload import warn_left_out
from wrt.scene.model import Scene

TILES_EACH = 4  # tiles of a pass for each slot of the workers
SIDES = {"cpu": (32, 256), "cuda": (256, 1024)}  # limits of a tile's side: smaller tiles cost more to send, larger tiles take long


class DistributedRenderer:
    """A scene that workers have prepared, for options with `devices` or `executor`. It implements Tracer (wrt.renderer.schedule)."""

    def __init__(self, scene: Scene, options: Options) -> None:
        self.device = start("cpu")  # the film's device
        self.plan = plan_of(scene, options)
        self.plan.require_memory(self.device)
        warn_left_out(scene)
        self.workers = workers_for(self.plan)
        self.tiles_by: Counter[str] = Counter()
        self.kind, self.seconds, self.counts = self._prepare_workers()
        self.checkpoint = checkpoint_of(self.plan, self.kind)

    def run(self) -> Film:
        """Render until the number of samples, the time limit or the target error is reached."""
        self.tiles_by.clear()
        return Run(self, self.checkpoint).film()

    def _prepare_workers(self) -> tuple[str, dict[str, float], dict[str, Any]]:
        """Let the workers prepare the scene. Return the kind of their devices, the seconds by stage, and Prepared.facts()."""
        progress, begin, replies = self.plan.options.progress, time.perf_counter(), []
        with nullcontext() if progress is None else WATCH.reported_by_caller():
            for done in self.workers.run([("ready",)] * self.workers.slots()):
                seconds = time.perf_counter() - begin
                if done is not None:
                    replies.append(done[1])
                elif progress is not None and seconds >= WATCH.delay:
                    progress(Progress(0, 100, 0, seconds, stage="compile"))
                    progress = None
        kind = replies[0][1]
        for reply in replies:
            _check_kind(reply, kind)
        return kind, _waited_for(replies, time.perf_counter() - begin), replies[0][2]["facts"]

    # --- a Tracer (wrt.renderer.schedule) ---

    def facts(self) -> Facts:
        return {**self.counts, "workers": dict(self.tiles_by)}

    def tiles(self, samples: int) -> Iterator[Rectangle]:
        """Yield the tiles of a pass. Tiles are large for any number of samples, since a call to a worker costs more than a wave."""
        low, high = SIDES["cuda" if self.plan.options.device.startswith("cuda") else "cpu"]
        side = math.ceil(math.sqrt(self.plan.area / (TILES_EACH * self.workers.slots())))
        return tiles(self.plan.crop, self.plan.options.tile_size or min(max(side, low), high))

    def trace(self, film: DeviceFilm | AovFilm, work: list[Work], due: Callable[[], bool]) -> Steps:
        """Trace as Tracer.trace does. The film receives finished tiles only, so that each step may report that no tile is running."""
        jobs: Iterable[Job]
        if isinstance(film, AovFilm):
            views = [film.view(name) for name in self.plan.options.aov]
            jobs = (("aov_tile", part) for part in work)
        else:
            views = [film.view(array) for _, array in film.arrays()]
            jobs = (("trace_tile", part, film.seed, [view[self._place(part.rectangle)] for view in views] if part.first else None)
                    for part in work)
        total, next_step = 0, 0.0
        with closing(self.workers.run(jobs)) as running:
            for done in running:
                if done is not None:
                    (_, part, *_), reply = done
                    _check_kind(reply, self.kind)  # a new worker may have connected meanwhile
                    self.tiles_by[reply[0]] += 1
                    total += part.total
                    for view, array in zip(views, reply[2], strict=True):
                        view[self._place(part.rectangle)] = array
                if time.monotonic() >= next_step:
                    yield total, True
                    next_step = time.monotonic() + STEP_SECONDS
            yield total, True

    def _place(self, rectangle: Rectangle) -> tuple[slice, slice]:
        x, y, width, height = rectangle
        x, y = x - self.plan.crop[0], y - self.plan.crop[1]
        return slice(y, y + height), slice(x, x + width)


def workers_for(plan: Plan) -> ExecutorWorkers:
    """Return the workers that the plan's options name."""
    scene, options = replace(plan.scene, cameras=(plan.camera,)), replace(plan.options, camera=None, accel=plan.accel)
    if options.devices is not None:
        return DeviceWorkers(scene, options)
    key, package = packaged(scene, options, plan.kernels_hash())
    if hasattr(options.executor, "get_executor"):
        from wrt.renderer.distributed.dask import ClusterWorkers

        return ClusterWorkers(options.executor, key, package)
    return ExecutorWorkers(options.executor, key, package)


def _waited_for(replies: list[Reply], waited: float) -> dict[str, float]:
    """Return the slowest worker's seconds by stage, at most `waited` each: a worker may have prepared the scene for an earlier render."""
    seconds: dict[str, float] = max((reply[2]["seconds"] for reply in replies), key=lambda each: max(each.values()))
    return {name: min(value, waited) for name, value in seconds.items()}


def _check_kind(reply: Reply, kind: str) -> None:
    if reply[1] != kind:
        raise InputError(f"the workers' devices are of several kinds, which round differently: {kind}, and {reply[1]} of {reply[0]}")
