"""Schedule of a render: passes of tiles, until the samples, the time limit, the target error or Ctrl-C end it."""

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import closing
from functools import partial
from typing import Protocol

import numpy as np
import warp as wp

from wrt.core.errors import InputError
from wrt.core.interrupts import held_interrupts
from wrt.core.threads import submit, with_stack
from wrt.core.types import Device
from wrt.picture.film import Film
from wrt.renderer.checkpoint import Checkpoint
from wrt.renderer.film_arrays import AovFilm, DeviceFilm
from wrt.renderer.options import Options, Progress
from wrt.renderer.plan import Plan
from wrt.renderer.prepare import Prepared
from wrt.renderer.result import Facts, bare_film, film_of
from wrt.renderer.tiles import Rectangle, Work, work_left

MAX_PASS = 64  # Largest number of samples per pixel in a pass. On a GPU, Ctrl-C waits for the end of the pass.
# Factor by which the samples per pixel grow from pass to pass. A larger factor is faster on the CPU (with 16 spp, 4 is up to 1.15 times
# as fast as 2). If the render ends early, however, the samples are spread less evenly over the picture.
GROWTH = 4
STEP_SECONDS = 0.1  # Time between two steps of a tracer.
OVERTIME = 5.0  # Seconds after the time limit without a finished tile, until the pass is abandoned. In the first pass: SILENT.
SILENT = 20.0  # Seconds without a finished tile until the progress notes it.

# A step: samples done, summed over pixels; and True if no tile is running, so that all pixels have whole samples.
Steps = Generator[tuple[int, bool], None, None]


class OutOfTime(Exception):
    """The time limit has passed, and for some seconds the tracer has finished no tile."""


class Tracer(Protocol):
    """Traces the tiles of a run, with threads of this process or with workers (wrt.renderer.distributed).

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
        if min(self.prepared.threads, len(work)) == 1:  # the calling thread
            yield from self._trace_here(trace, work, due)
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

    def _trace_here(self, trace: Callable[[Work], int], work: list[Work], due: Callable[[], bool]) -> Steps:
        done, next_step = 0, time.monotonic() + STEP_SECONDS
        for job in work:
            done += with_stack(partial(trace, job))
            if time.monotonic() >= next_step or due():
                yield done, True
                next_step = time.monotonic() + STEP_SECONDS
        yield done, True


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
        self.expected_spp, self.timed_out, self.deadline = self.spp, False, math.inf

    def __iter__(self) -> Iterator[tuple[int, int]]:
        limit = self.options.time_limit or math.inf
        first = timed_from = self.fewest  # the speed is measured from the sample `timed_from` on, which began at the time `since`
        begin = since = time.perf_counter()
        self.deadline = begin + limit
        count = self._size(first)
        while first < self.spp and (first < self.most or not self._precise_enough(first)):
            count = min(count, (self.most if first < self.most else self.spp) - first)
            if self.options.target_error is not None:
                count = min(count, (1 << first.bit_length()) - first)  # up to the next power of 2
            if first > 0 and min(limit, self.every) < math.inf:
                now = time.perf_counter()
                left = self.deadline - now
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


class Run:
    """The render of one picture. seed, spp: replace the options' seed and the scene's spp, unless None."""

    def __init__(self, tracer: Tracer, checkpoint: Checkpoint | None, seed: int | None = None, spp: int | None = None) -> None:
        plan = tracer.plan
        self.tracer, self.plan, self.checkpoint = tracer, plan, checkpoint
        self.seed = plan.options.seed if seed is None else seed
        self.arrays = DeviceFilm(plan.scene.settings, plan.crop, tracer.device, self.seed, plan.groups)
        self.aov: dict[str, np.ndarray] = {}
        self.seconds, self.seconds_before = dict(tracer.seconds), 0.0
        self.interrupts: list[int] = []
        samples, every = (0, 0), math.inf
        if checkpoint is not None and checkpoint.saved is not None:
            checkpoint.restore(self.arrays)
            samples, self.seconds_before = checkpoint.saved.samples, checkpoint.saved.seconds
        if checkpoint is not None and tracer.device.is_cuda:  # the film cannot be saved during a launch, which traces the whole picture
            every = checkpoint.every
        self.passes = Passes(self.arrays, plan.options, spp or plan.scene.settings.spp, samples, every)

    def film(self) -> Film:
        """Render and return the film."""
        begin = self.begin = time.perf_counter()
        interrupted = out_of_time = False
        with held_interrupts() as self.interrupts:
            if self.checkpoint is not None:
                self.checkpoint.begin()
            try:
                if self.plan.options.aov:
                    self._trace_aovs()
                    self.seconds["aov"] = time.perf_counter() - begin
                self.begin = time.perf_counter()
                for first, count in self.passes:
                    self._trace_pass(first, count)
            except KeyboardInterrupt:  # raised by _trace, or by a progress callback
                interrupted = True
            except OutOfTime:
                out_of_time = True
            except Exception as error:
                self._save_before(error)
                raise
            self.seconds["trace"] = self._elapsed()
            if self.checkpoint is not None:
                self.checkpoint.save(self.arrays, self.seconds["trace"])
                if self.checkpoint.problem:
                    warnings.warn(self.checkpoint.problem, RuntimeWarning, stacklevel=4)
            facts = self._facts(interrupted or bool(self.interrupts), out_of_time)
            return film_of(self.plan, self.arrays, self.seed, self.aov, self.seconds, facts)

    def _facts(self, interrupted: bool, out_of_time: bool) -> Facts:
        """Return the entries of Film.stats about the scene, the end of the run and the checkpoint."""
        end = {"interrupted": interrupted, "signal": int(self.interrupts[0]) if self.interrupts else None,
               "timed_out": (out_of_time or self.passes.timed_out) and not interrupted}
        return self.tracer.facts() | end | ({} if self.checkpoint is None else self.checkpoint.facts())

    def _save_before(self, error: Exception) -> None:
        """Save a checkpoint before an error ends the run. After an error on CUDA, the film may be unreadable and is not saved."""
        if self.checkpoint is None or self.tracer.device.is_cuda:
            return
        self.checkpoint.save(self.arrays, self._elapsed())
        if isinstance(error, InputError) and not self.checkpoint.problem:
            raise error.at(hint=f"{self.checkpoint.path} has the samples so far") from error

    def _elapsed(self) -> float:
        """Return the seconds of tracing, including those before a resume."""
        return self.seconds_before + time.perf_counter() - self.begin

    def _due(self) -> bool:
        return self.checkpoint is not None and self.checkpoint.due()

    def _trace_pass(self, first: int, count: int) -> None:
        """Trace until every pixel has at least `first + count` samples in each group of samples.
        With a target error, each pixel has several groups, whose means estimate the error (DeviceFilm); else it has one."""
        work, before = [Work(tile, first, count) for tile in self.tracer.tiles(count)], first * self.plan.area
        if first < self.passes.most:  # after a resume
            samples = self.arrays.view(self.arrays.groups[0].samples)
            work, before = work_left(work, samples, self.plan.crop), int(samples.sum(dtype=np.int64))
        self._trace(self.arrays, work, lambda done, silent: self._report(before + done, silent), OVERTIME if first else SILENT)

    def _trace_aovs(self) -> None:
        arrays = AovFilm(self.plan.scene.settings, self.plan.crop, self.tracer.device)
        work = [Work(tile, 0, 1) for tile in self.tracer.tiles(1)]
        self._trace(arrays, work, lambda done, silent: None, SILENT)
        self.aov = {name: arrays.picture(name) for name in self.plan.options.aov}

    def _trace(self, film: DeviceFilm | AovFilm, work: list[Work], report: Callable[[int, float], None], overtime: float) -> None:
        """Trace, save checkpoints, and call report(samples done, seconds without a finished tile). Ctrl-C raises KeyboardInterrupt.

        Raises OutOfTime if, after the time limit, no tile was finished for `overtime` seconds."""
        total = sum(job.total for job in work)
        if self.interrupts:
            raise KeyboardInterrupt
        before, received = 0, time.perf_counter()
        with closing(self.tracer.trace(film, work, self._due)) as steps:
            for done, at_rest in steps:
                now = time.perf_counter()
                if done > before:
                    before, received = done, now
                if self.checkpoint is not None and at_rest and self.checkpoint.due():
                    self.checkpoint.save(self.arrays, self._elapsed())
                report(done, now - received)
                if done < total and self.interrupts:
                    raise KeyboardInterrupt
                if done < total and now - max(received, self.passes.deadline) > overtime:
                    raise OutOfTime

    def _report(self, done: int, silent: float) -> None:
        """Call Options.progress. done: samples of one group, summed over the pixels. silent: seconds without a finished tile."""
        plan = self.plan
        if plan.options.progress is None:
            return
        total = plan.area * self.passes.expected_spp * plan.groups
        note = "" if self.checkpoint is None else self.checkpoint.problem
        if silent > SILENT and not note:
            note = f"a worker has not answered for {silent:.0f} s"
        plan.options.progress(Progress(done * plan.groups, total, self.arrays.count("rays"), self._elapsed(), note=note,
                                       picture=lambda: bare_film(plan, self.arrays.snapshot())))
