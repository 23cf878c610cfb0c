"""A render whose tiles others trace. The film stays here, and with it all that follows from it: passes, time limit, target
error, checkpoints, pictures so far. So the pixels are those of a render by threads, bit for bit, whoever traces them."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.renderer.distributed.workers import Crew, Devices, Job, Reply, Workers, packaged
from wrt.renderer.options import Progress
from wrt.renderer.renderer import PREPARING_TOLD, Renderer
from wrt.renderer.tiles import Rectangle, Work, tiles
from wrt.renderer.upload import tell_left_out

TILES_EACH = 4  # of a pass, for each that traces: the last one to come must not be long
SIDES = {"cpu": (32, 256), "cuda": (256, 1024)}  # pixels: smaller tiles are not worth sending, larger ones take long
REPORT_EVERY = 0.1  # seconds


class SpreadRenderer(Renderer):
    """A Renderer for options with `devices` or an `executor`."""

    def _film_device(self) -> Any:
        return start("cpu")

    def kind(self) -> str:
        return self._told[0]

    @property
    def _on_cuda(self) -> bool:
        return self.options.device.startswith("cuda")

    def facts(self) -> dict[str, Any]:
        return {**self._told[1]["facts"], "workers": dict(self.tiles_by)}

    @cached_property
    def crew(self) -> Crew:
        scene, options = replace(self.scene, cameras=(self.camera,)), replace(self.options, camera=None)
        if options.devices is not None:
            return Devices(scene, options)
        key, package = packaged(scene, options, self.kernels_hash())
        if hasattr(options.executor, "get_executor"):
            from wrt.renderer.distributed.dask import ClusterWorkers

            return ClusterWorkers(options.executor, key, package)
        assert options.executor is not None
        return Workers(options.executor, key, package)

    @cached_property
    def _told(self) -> tuple[str, dict[str, Any]]:
        """The kind of the workers' devices, and what one of them tells (Renderer.ready) when they have the scene ready."""
        tell_left_out(self.scene)
        begin, told, all_told = time.perf_counter(), False, []
        for done in self.crew.run([("ready",)] * self.crew.slots()):
            seconds = time.perf_counter() - begin
            if done is None and not told and seconds >= PREPARING_TOLD and self.options.progress is not None:
                self.options.progress(Progress(0, 100, 0, seconds, stage="compile"))
                told = True
            if done is not None:
                all_told.append(done[1])
        kind = all_told[0][1]
        for reply in all_told:
            _check_kind(reply, kind)
        return kind, all_told[0][2] | {"seconds": _waited_for(all_told, time.perf_counter() - begin)}

    def _prepare(self) -> None:
        self.seconds |= self._told[1]["seconds"]
        self.tiles_by: Counter[str] = Counter()

    def run(self, *, seed: int | None = None, spp: int | None = None) -> Film:
        self.tiles_by.clear()
        return super().run(seed=seed, spp=spp)

    def _tiles(self) -> Iterator[Rectangle]:
        x0, y0, x1, y1 = self.crop
        low, high = SIDES["cuda" if self._on_cuda else "cpu"]
        side = math.ceil(math.sqrt((x1 - x0) * (y1 - y0) / (TILES_EACH * self.crew.slots())))
        return tiles(self.crop, self.options.tile_size or min(max(side, low), high))

    def _run_pass(self, first: int, count: int) -> None:
        """What ends a pass leaves a checkpoint."""
        try:
            super()._run_pass(first, count)
        except Exception as error:
            if self.checkpoint is not None:
                self.checkpoint.save(self.film, self._seconds())
                if isinstance(error, InputError) and not self.checkpoint.problem:
                    told = InputError(f"{error}; {self.checkpoint.path} has what was done")
                    told.path = error.path
                    raise told from error
            raise

    def _trace(self, work: list[Work], report: Callable[[int], None]) -> None:
        views = [self.film.view(array) for _, array in self.film.arrays()]
        jobs = (("trace_tile", job, self.seed, [view[self._place(job.rectangle)] for view in views] if job.first else None)
                for job in work)
        done, due = 0, 0.0
        for job, arrays in self._replies(jobs):
            if job is not None:
                for view, array in zip(views, arrays, strict=True):
                    view[self._place(job[1].rectangle)] = array
                done += job[1].total
            if time.monotonic() >= due:
                report(done)
                due = time.monotonic() + REPORT_EVERY
        report(done)

    def _aovs(self) -> dict[str, np.ndarray]:
        shape = self.film.shape
        out: dict[str, np.ndarray] = {}
        for job, arrays in self._replies(("aov_tile", rectangle) for rectangle in self._tiles()):
            for name, array in zip(self.options.aov, arrays or (), strict=False):
                if name not in out:
                    out[name] = np.zeros((*shape, *array.shape[2:]), array.dtype)
                out[name][self._place(job[1])] = array
        return {name: out[name] for name in self.options.aov}

    def _replies(self, jobs: Iterator[Job]) -> Iterator[tuple[Any, Any]]:
        """Each job and what came of it; (None, None) where nothing came for a while. KeyboardInterrupt where Ctrl-C came: the
        tiles that run are given up, and those that came are in the film."""
        running = self.crew.run(jobs)
        try:
            for done in running:
                if done is None:
                    yield None, None
                else:
                    job, reply = done
                    _check_kind(reply, self.kind())  # a worker may have come later
                    self.tiles_by[reply[0]] += 1
                    yield job, reply[2]
                self._save_if_due()
                if self.interrupts:
                    raise KeyboardInterrupt
        finally:
            running.close()

    def _place(self, rectangle: Rectangle) -> tuple[slice, slice]:
        x, y, width, height = rectangle
        x, y = x - self.crop[0], y - self.crop[1]
        return slice(y, y + height), slice(x, x + width)


def _waited_for(replies: list[Reply], waited: float) -> dict[str, float]:
    """The seconds of the worker that took longest; less where it was ready before and nobody waited for it so long."""
    seconds: dict[str, float] = max((reply[2]["seconds"] for reply in replies), key=lambda each: sum(each.values()))
    share = min(1.0, waited / max(sum(seconds.values()), 1e-9))
    return {name: share * value for name, value in seconds.items()}


def _check_kind(reply: Reply, kind: str) -> None:
    if reply[1] != kind:
        raise InputError(f"the workers' devices are of several kinds, which do not round alike: {kind},"
                         f" and at {reply[0]} {reply[1]}")
