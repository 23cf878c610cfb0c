"""The render of a picture: passes over its tiles, until the number of samples, a time limit, a target error or Ctrl-C ends it."""

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import warp as wp

from wrt.core import VERSION
from wrt.core.interrupts import held_interrupts
from wrt.core.threads import submit, with_stack
from wrt.core.types import Device
from wrt.picture.film import Film
from wrt.picture.tonemap import auto_exposure
from wrt.renderer.film import VISIBLE, AovFilm, DeviceFilm, Rectangle, Work, needed_depth
from wrt.renderer.options import Options, Progress
from wrt.renderer.plan import Plan
from wrt.renderer.prepare import Prepared

if TYPE_CHECKING:
    from wrt.renderer.checkpoint import Checkpoint

MAX_PASS = 64  # Largest number of samples per pixel in a pass. On a GPU, Ctrl-C waits for the end of the pass.
# Factor by which the samples per pixel grow from pass to pass. A larger factor is faster on the CPU (with 16 spp, 4 is up to 1.15 times
# as fast as 2). If the render ends early, however, the samples are spread less evenly over the picture.
GROWTH = 4
STEP_SECONDS = 0.1  # Time between two steps of a tracer.

# A step: samples done, summed over pixels; and True if no tile is running, so that all pixels have whole samples.
Steps = Generator[tuple[int, bool], None, None]
Facts = dict[str, Any]  # entries of a film's stats


class Tracer(Protocol):
    """Traces the tiles of a run, with threads of this process or with workers (wrt.renderer.workers).

    - device: the film's device. seconds: time by stage of the preparation. facts: entries of Film.stats. tiles: tiles of a pass.
    - trace: yields an item of Steps about every tenth of a second, and one at the end. If `due()` is true, it first waits for the
      running tiles. If the caller closes the generator early, it finishes the running tiles and begins no other tile."""

    plan: Plan
    device: Device
    seconds: dict[str, float]

    def facts(self) -> Facts: ...

    def tiles(self, samples: int) -> Iterable[Rectangle]: ...

    def trace(self, film: DeviceFilm | AovFilm, work: list[Work], due: Callable[[], bool]) -> Steps: ...


class LocalTracer:
    """Traces on the device of a prepared scene. On the CPU, all threads share the tiles. On CUDA, one tile is traced after another."""

    def __init__(self, prepared: Prepared) -> None:
        self.prepared, self.plan, self.device, self.seconds = prepared, prepared.plan, prepared.device, prepared.seconds
        self.facts, self.tiles = prepared.facts, prepared.tiles

    def trace(self, film: DeviceFilm | AovFilm, work: list[Work], due: Callable[[], bool]) -> Steps:
        trace = self.prepared.launch(film)
        if self.device.is_cuda:
            done = sum(trace(job) for job in work)
            wp.synchronize_device(self.device)
            yield done, True
            return
        if min(self.prepared.threads, len(work)) == 1:  # the calling thread: another thread would cost 5 % of a small picture
            done, next_step = 0, time.monotonic() + STEP_SECONDS
            for job in work:
                done += with_stack(partial(trace, job))
                if time.monotonic() >= next_step or due():
                    yield done, True
                    next_step = time.monotonic() + STEP_SECONDS
            yield done, True
            return
        left, samples = deque(work), list[int]()  # a future for each job would add 10 % to a short picture
        at_rest = False

        def trace_left() -> None:
            while not at_rest:
                try:
                    job = left.popleft()
                except IndexError:
                    return
                samples.append(trace(job))

        running: list[Future[None]] = []
        try:
            while left or running:
                running = running or [submit(trace_left) for _ in range(min(self.prepared.threads, len(left)))]
                wait(running, timeout=STEP_SECONDS)
                at_rest = due()
                if at_rest:
                    wait(running)
                for future in [future for future in running if future.done()]:
                    running.remove(future)
                    future.result()
                yield sum(samples), not running
                at_rest = False
        finally:
            left.clear()
            wait(running)


class Passes:
    """Iterator over passes: index of the first sample, and number of samples, of each pixel in each group.

    With one group and no limits, the passes have 1, 3, 12, 48, 64, 64 ... samples. The time limit counts from the first pass on. A pass
    has only as many samples as will probably be done in the time left, and in `every` seconds. Each pixel gets at least one sample.
    samples: smallest and largest number of samples that the pixels have already in each group. The two numbers differ if the checkpoint
    was written within a pass. The first passes then bring all pixels to the larger number."""

    def __init__(self, film: DeviceFilm, options: Options, spp: int, samples: tuple[int, int], every: float) -> None:
        self.film, self.options, self.every = film, options, every
        self.spp = max(1, spp // len(film.groups))
        self.largest = MAX_PASS // len(film.groups)
        self.fewest, self.most = samples
        self.expected_spp, self.timed_out = self.spp, False

    def __iter__(self) -> Iterator[tuple[int, int]]:
        limit = self.options.time_limit or math.inf
        first = timed_from = self.fewest  # the speed is measured from the sample `timed_from` on, which began at the time `since`
        begin = since = time.perf_counter()
        count = self._size(first)
        while first < self.spp and (first < self.most or not self._precise_enough(first)):
            count = min(count, (self.most if first < self.most else self.spp) - first)
            if self.options.target_error is not None:
                count = min(count, (1 << first.bit_length()) - first)  # up to the next power of 2
            if first > 0 and min(limit, self.every) < math.inf:
                now = time.perf_counter()
                left = begin + limit - now
                if left <= 0.0:
                    self.timed_out = True
                    return
                likely = min(left, self.every) / (now - since) * (first - timed_from) if first > timed_from else 1.0
                count = max(1, min(count, int(min(likely, self.spp))))
            yield first, count
            first += count
            if first == self.most:
                timed_from, since = first, time.perf_counter()
            count = self._size(first)

    def _size(self, first: int) -> int:
        """Return the number of samples of a pass that begins at sample `first`. The limits of time and error may reduce it."""
        return self.options.pass_size or min(max((GROWTH - 1) * first, 1), self.largest)

    def _precise_enough(self, samples: int) -> bool:
        """Return True if the target error is reached. samples: number in each group; False unless a power of 2."""
        target = self.options.target_error
        if target is None or samples == 0 or samples & (samples - 1):
            return False
        error = self.film.error()
        if error > target:  # the variance falls as 1 / samples or faster
            steps = math.ceil(min(2.0 * math.log2(error / target), 24.0))
            self.expected_spp = min(self.spp, samples << steps)
        return error <= target


def work_left(work: list[Work], samples: np.ndarray, crop: tuple[int, int, int, int]) -> list[Work]:
    """Return the part of the work that is not done yet. samples: samples that each pixel of the crop has, (H, W) int32.

    Rectangles are halved until all pixels of a part have equally many samples. This ends soon: the earlier run finished whole tiles."""
    out = []
    stack = work[::-1]
    while stack:
        (x, y, width, height), first, n = stack.pop()
        of_part = samples[y - crop[1] : y - crop[1] + height, x - crop[0] : x - crop[0] + width]
        low, high = int(of_part.min()), int(of_part.max())
        goal = first + n
        if low == high:
            if low < goal:
                out.append(Work((x, y, width, height), low, goal - low))
        elif low < goal:
            if width >= height:
                parts = [(x, y, width // 2, height), (x + width // 2, y, width - width // 2, height)]
            else:
                parts = [(x, y, width, height // 2), (x, y + height // 2, width, height - height // 2)]
            stack += [Work(part, first, n) for part in parts[::-1]]
    return out


class Run:
    """The render of one picture. seed, spp: replace the options' seed and the scene's spp, unless None."""

    def __init__(self, tracer: Tracer, checkpoint: "Checkpoint | None" = None, seed: int | None = None, spp: int | None = None) -> None:
        plan = tracer.plan
        self.tracer, self.plan, self.checkpoint = tracer, plan, checkpoint
        self.seed = plan.options.seed if seed is None else seed
        self.arrays = DeviceFilm(plan.scene.settings, plan.crop, tracer.device, self.seed, plan.groups)
        self.aov: dict[str, np.ndarray] = {}
        self.seconds, self.seconds_before = dict(tracer.seconds), 0.0
        self.interrupts: list[int] = []
        self.due: Callable[[], bool] = lambda: False
        samples, every = (0, 0), math.inf
        if checkpoint is not None:
            checkpoint.restore(self.arrays)
            self.due = checkpoint.due
            if checkpoint.saved is not None:
                samples, self.seconds_before = checkpoint.saved.samples, checkpoint.saved.seconds
            if tracer.device.is_cuda:  # the film cannot be saved during a launch, which traces the whole picture
                every = checkpoint.every
        self.passes = Passes(self.arrays, plan.options, spp or plan.scene.settings.spp, samples, every)

    def film(self) -> Film:
        """Render and return the film."""
        begin = self.begin = time.perf_counter()
        interrupted = False
        with held_interrupts() as self.interrupts:
            try:
                if self.plan.options.aov:
                    self._trace_aovs()
                    self.seconds["aov"] = time.perf_counter() - begin
                self.begin = time.perf_counter()
                for first, count in self.passes:
                    self._trace_pass(first, count)
            except KeyboardInterrupt:  # raised by _trace, or by a progress callback
                interrupted = True
            except Exception:
                if self.tracer.device.is_cpu:  # after an error on CUDA, the film may be unreadable
                    self._save(self._elapsed())
                raise
            self.seconds["trace"] = self._elapsed()
            self._save(self.seconds["trace"])
            facts = self.tracer.facts() | self._end(interrupted or bool(self.interrupts))
            return film_of(self.plan, self.arrays, self.seed, self.aov, self.seconds, facts)

    def _end(self, interrupted: bool) -> Facts:
        """Return the entries of Film.stats about the end of the run and the checkpoint."""
        end: Facts = {"interrupted": interrupted, "signal": int(self.interrupts[0]) if self.interrupts else None,
                      "timed_out": self.passes.timed_out and not interrupted}
        if self.checkpoint is not None:
            if self.checkpoint.problem:
                warnings.warn(self.checkpoint.problem, RuntimeWarning, stacklevel=5)
            saved = self.checkpoint.saved
            end["checkpoint"] = None if self.checkpoint.problem else str(self.checkpoint.path)
            end["resumed"] = saved and {"samples": saved.samples[0] * self.plan.groups, "seconds": saved.seconds}
        return end

    def _save(self, seconds: float) -> None:
        if self.checkpoint is not None:
            self.checkpoint.save(self.arrays, seconds)

    def _elapsed(self) -> float:
        """Return the seconds of tracing, including those before a resume."""
        return self.seconds_before + time.perf_counter() - self.begin

    def _trace_pass(self, first: int, count: int) -> None:
        """Trace until every pixel has at least `first + count` samples in each group of samples.
        With a target error, each pixel has several groups, whose means estimate the error (DeviceFilm); else it has one."""
        work, before = [Work(tile, first, count) for tile in self.tracer.tiles(count)], first * self.plan.area
        if first < self.passes.most:  # after a resume
            samples = self.arrays.view(self.arrays.groups[0].samples)
            work, before = work_left(work, samples, self.plan.crop), int(samples.sum(dtype=np.int64))
        self._trace(self.arrays, work, lambda done: self._report(before + done))

    def _trace_aovs(self) -> None:
        arrays = AovFilm(self.plan.scene.settings, self.plan.crop, self.tracer.device)
        self._trace(arrays, [Work(tile, 0, 1) for tile in self.tracer.tiles(1)], lambda done: None)
        self.aov = {name: arrays.picture(name) for name in self.plan.options.aov}

    def _trace(self, film: DeviceFilm | AovFilm, work: list[Work], report: Callable[[int], None]) -> None:
        """Trace, save checkpoints, and call report(samples done). Ctrl-C raises KeyboardInterrupt."""
        total = sum(job.total for job in work)
        if self.interrupts:
            raise KeyboardInterrupt
        with closing(self.tracer.trace(film, work, self.due)) as steps:
            for done, at_rest in steps:
                if at_rest and self.due():
                    self._save(self._elapsed())
                report(done)
                if done < total and self.interrupts:
                    raise KeyboardInterrupt

    def _report(self, done: int) -> None:
        """Call Options.progress. done: samples of one group, summed over the pixels."""
        plan = self.plan
        if plan.options.progress is not None:
            total = plan.area * self.passes.expected_spp * plan.groups
            note = "" if self.checkpoint is None else self.checkpoint.problem
            plan.options.progress(Progress(done * plan.groups, total, self.arrays.count("rays"), self._elapsed(), note=note,
                                           picture=lambda: bare_film(plan, self.arrays.snapshot())))


# --- films ------------------------------------------------------------------------------------------------------------


def film_of(plan: Plan, arrays: DeviceFilm, seed: int, aov: dict[str, np.ndarray], seconds: dict[str, float], facts: Facts) -> Film:
    """Return the film with its statistics. facts: entries of Film.stats about the scene, its structure and the end of the run."""
    arrays = arrays.snapshot()
    options, settings, samples = plan.options, plan.scene.settings, arrays.samples()
    total = max(int(samples.sum()), 1)
    rays = arrays.count("rays")
    ior = max((m.ior for m in plan.scene.materials if m.kind == "glass" or m.transmission > 0.0), default=1.0)
    most_by_throughput = settings.min_throughput * ior**2  # inside glass, radiance is larger by ior^2
    lost = arrays.lost_by_depth(most_by_throughput) if plan.features.reflection else np.zeros(samples.shape)
    stats: dict[str, Any] = {
        "seconds": seconds, "rays": rays, "rays_per_sample": rays / total,
        "rays_per_second": rays / seconds["trace"] if seconds["trace"] > 0.0 else 0.0,
        "cut_by_depth": arrays.count("cut_depth"), "cut_by_throughput": arrays.count("cut_throughput"),
        "lost_throughput_per_sample": arrays.lost_throughput() / total,
        "visibly_cut": float((lost > VISIBLE).mean()), "lost_by_depth": float(lost.mean()),
        "needed_depth": needed_depth(lost, settings.max_depth),
        "clamped_share": arrays.clamped_share() if settings.clamp else 0.0,
        "not_finite": arrays.count("not_finite"), "samples": int(samples.sum()), **facts,
    }
    if options.target_error is not None:
        error = arrays.error()
        stats |= {"estimated_error": error, "target_error": options.target_error,
                  "target_reached": error <= options.target_error and int(samples.min()) > 0}
    metadata = {
        "scene": plain_text(plan.scene.name), "camera": plain_text(plan.camera.name), "spp": int(samples.max()), "seed": seed,
        "seconds": round(seconds["trace"], 3), "version": VERSION, "max_depth": settings.max_depth, "filter": settings.filter,
        "accel": options.accel, "device": options.device,
    }
    if settings.clamp:
        metadata |= {"clamp": settings.clamp, "clamped_share": stats["clamped_share"]}
    return replace(bare_film(plan, arrays), aov=aov, stats=stats, metadata=metadata)


def bare_film(plan: Plan, arrays: DeviceFilm) -> Film:
    """Return a film with pixels, variance and samples only. arrays: result of DeviceFilm.snapshot."""
    settings = plan.scene.settings
    pixels, variance = arrays.pixels_and_variance()
    exposure = settings.exposure + (auto_exposure(pixels) if settings.auto_exposure else 0.0)
    return Film(pixels, variance, arrays.samples(), exposure=exposure, tonemap=settings.tonemap)


def plain_text(name: str) -> str:
    """Return a name that UTF-8 can encode: lone surrogates, which glTF files and file names may contain, become "?"."""
    return name.encode("utf-8", "replace").decode()
