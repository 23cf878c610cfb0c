"""`python -m wrt bench mitsuba`: the same picture by wrt and by Mitsuba 3, to the same error; Mitsuba with both of its variants
that run on a CPU, each in a process of its own.

All are held against one reference. wrt renders with a given number of samples; Mitsuba gets as many as it likely needs for the
same error, and what it really needs is taken from the error that it reaches: its samples are independent, so that its mean
squared error falls as 1 / time. Runs alternate; each has a seed of its own. All have the same number of threads.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from wrt.core.device import thread_count
from wrt.core.errors import InputError
from wrt.lab.bench import error_statistics as statistics
from wrt.lab.bench.error import REFERENCE_SEEDS, Reference, finished, make_reference
from wrt.lab.bench.report import table
from wrt.lab.bench.timing import Quartiles, quartiles, shown
from wrt.lab.mitsuba.llvm import NotAvailable
from wrt.lab.mitsuba.process import Job, MitsubaProcess, environment_of
from wrt.lab.plans import Mitsuba as Plan
from wrt.renderer.options import Options
from wrt.renderer.renderer import Renderer
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Scene

PILOT_SPP = 16
SAME = 0.25  # of the squared error compared at: a squared bias beyond it means that the pictures are not of the same light


@dataclass(frozen=True)
class Side:
    """One renderer: samples a pixel, seconds of each picture, root mean squared error over all its pictures, and its bias
    against the reference (NaN where it cannot be told from noise; `bias_below` bounds it). prepare_seconds: structure and
    scene; process_seconds: a whole process at this many samples, start included (NaN where it was not timed)."""

    spp: int
    seconds: np.ndarray
    rmse: float
    bias: float
    bias_below: float
    prepare_seconds: float
    process_seconds: float

    def as_dict(self) -> dict[str, Any]:
        return vars(self) | {"seconds": self.seconds.tolist()}


@dataclass(frozen=True)
class Rival:
    """A variant of Mitsuba. ratio: its seconds over those of wrt at wrt's error, tracing alone; process_ratio: of whole
    processes. same_light: whether its picture has wrt's expectation, as far as its noise at equal error can tell."""

    side: Side
    ratio: Quartiles
    process_ratio: float
    same_light: bool

    def as_dict(self) -> dict[str, Any]:
        return {**self.side.as_dict(), **{name: value for name, value in vars(self).items() if name != "side"}}


@dataclass(frozen=True)
class Result:
    """mitsuba: by variant. not_available: variants that could not be used, and why."""

    scene: str
    size: tuple[int, int]
    integrator: str
    threads: int
    wrt: Side
    mitsuba: dict[str, Rival]
    not_available: dict[str, str]
    reference: Reference

    def as_dict(self) -> dict[str, Any]:
        return vars(self) | {"wrt": self.wrt.as_dict(), "reference": self.reference.as_dict(),
                             "mitsuba": {name: rival.as_dict() for name, rival in self.mitsuba.items()}}


def matte(scene: Scene) -> Scene:
    """The scene with every surface diffuse, of the albedo that it has, and round apertures: what Mitsuba's "direct" draws
    exactly. Emission that is only seen is left out."""
    changed = {id(m): Material(name=m.name, albedo=m.albedo, albedo_texture=m.albedo_texture, two_sided=m.two_sided,
                               emission=m.emission if m.lights_others else (0.0, 0.0, 0.0)) for m in scene.materials}
    objects = tuple(replace(thing, materials=tuple(changed[id(m)] for m in thing.materials)) for thing in scene.objects)
    spheres = tuple(replace(sphere, material=changed[id(sphere.material)]) for sphere in scene.spheres)
    cameras = tuple(replace(each, blades=0) if isinstance(each, Camera) else each for each in scene.cameras)
    return replace(scene, objects=objects, spheres=spheres, cameras=cameras, ambient=(0.0, 0.0, 0.0))


class _Runs:
    """Pictures of one renderer at its number of samples, and their seconds."""

    def __init__(self, spp: int) -> None:
        self.spp = spp
        self.seconds: list[float] = []
        self.films: list[np.ndarray] = []

    def add(self, seconds: float, film: np.ndarray) -> None:
        self.seconds.append(seconds)
        self.films.append(film)

    def side(self, truth: Reference, prepare: float, start: float) -> Side:
        """start: seconds of a process but for tracing."""
        products = statistics.gram(self.films, truth.pixels)
        bias, below = statistics.bias_with_bound(products, truth.variance)
        return Side(self.spp, np.array(self.seconds), max(statistics.mse_of(products, truth.variance), 0.0) ** 0.5, bias, below,
                    prepare, start + float(np.median(self.seconds)))


class _Measured:
    """A variant of Mitsuba that is being measured."""

    def __init__(self, job: Job, process: MitsubaProcess) -> None:
        self.job, self.process = job, process
        self.runs = _Runs(PILOT_SPP)
        self.start = float("nan")

    def choose_spp(self, seed: int, truth: Reference, target: float, longest: float) -> None:
        """As many samples as likely give the squared error `target`, in pictures that take no longer than `longest`. Kernels are
        compiled as a picture is rendered, and others for another number of samples: the first of each is not counted."""
        self.process.render(PILOT_SPP, seed)
        seconds, film = self.process.render(PILOT_SPP, seed)
        needed = PILOT_SPP * statistics.mse_of(statistics.gram([film], truth.pixels), truth.variance) / max(target, 1e-30)
        self.runs.spp = int(np.clip(round(needed), 1, max(1.0, PILOT_SPP * longest / seconds)))
        self.process.render(self.runs.spp, seed)

    def picture(self, seed: int) -> None:
        self.runs.add(*self.process.render(self.runs.spp, seed))

    def time_starts(self, times: int) -> None:
        """All that a process takes but for tracing, with its first picture at 1 spp, as wrt's process is timed. (It is handed
        the scene as arrays: reading files is not counted.)"""
        program = f"import mitsuba as mi; mi.set_variant({self.job.variant!r})"
        imports = process_seconds(["-c", program], times, environment_of(self.job.variant))
        rest = [self._load_and_first_picture() for _ in range(times + 1 if times else 0)]
        self.start = imports + float(np.median(rest[1:])) if times else imports

    def _load_and_first_picture(self) -> float:
        with MitsubaProcess(self.job) as process:
            return process.load_seconds + process.render(1, 0)[0]

    def result(self, ours: Side, truth: Reference) -> Rival:
        side = self.runs.side(truth, self.process.load_seconds, self.start)
        factor = (side.rmse / ours.rmse) ** 2
        process_seconds = self.start + factor * float(np.median(side.seconds))
        return Rival(replace(side, process_seconds=process_seconds), quartiles(factor * side.seconds / ours.seconds),
                     process_seconds / ours.process_seconds, not side.bias**2 > SAME * ours.rmse**2)


class _Rivals:
    """The variants that can be used, and why the others cannot. Raises NotAvailable where none can."""

    def __init__(self, stack: ExitStack) -> None:
        self.stack = stack
        self.measured: dict[str, _Measured] = {}
        self.not_available: dict[str, str] = {}

    def start(self, jobs: list[Job]) -> None:
        for job in jobs:
            try:
                self.measured[job.variant] = _Measured(job, self.stack.enter_context(MitsubaProcess(job)))
            except NotAvailable as error:
                self._leave_out(job.variant, error)
        self._check()

    def each(self, do: Callable[[_Measured], None]) -> None:
        for variant, measured in list(self.measured.items()):
            try:
                do(measured)
            except NotAvailable as error:
                self._leave_out(variant, error)
        self._check()

    def _leave_out(self, variant: str, error: NotAvailable) -> None:
        self.measured.pop(variant, None)
        self.not_available[variant] = str(error)

    def _check(self) -> None:
        if not self.measured:
            raise NotAvailable("; ".join(f"Mitsuba {variant}: {why}" for variant, why in self.not_available.items()))


def run(scene: Scene, plan: Plan, options: Options, command: list[str] | None = None,
        report: Callable[[str], None] = lambda line: None) -> Result:
    """Measure. command: arguments of `python -m wrt` that render this scene at 1 spp: what a process takes but for tracing
    (None: not timed). A variant of Mitsuba that cannot be used is left out, and named in the result.

    Raises InputError where no variant can be used, Mitsuba is missing, or cannot draw the scene exactly.
    """
    scene = scene.with_settings(filter="box")  # the only one whose pixels Mitsuba takes by themselves
    seeds = [int(word) for word in np.random.SeedSequence(plan.seed).generate_state(REFERENCE_SEEDS + plan.repeats)]
    pictures, starts = seeds[REFERENCE_SEEDS:], plan.starts if command else 0
    threads, ours = thread_count(options.threads), _Runs(plan.spp)
    with ExitStack() as stack:
        rivals = _Rivals(stack)
        report("starting Mitsuba")
        rivals.start([Job(variant, scene, options.camera, plan.integrator, threads) for variant in dict.fromkeys(plan.variants)])
        report(f"reference: {REFERENCE_SEEDS} seeds")
        truth = make_reference(scene, options, plan.reference_spp or 8 * plan.spp, seeds[:REFERENCE_SEEDS],
                               scene.settings.max_depth)
        renderer = Renderer(scene, options)

        def our_picture(seed: int) -> tuple[float, np.ndarray]:
            begin = time.perf_counter()
            film = finished(renderer.run(seed=seed, spp=plan.spp)).pixels
            return time.perf_counter() - begin, film

        report("pilot")
        target = statistics.mse_of(statistics.gram([our_picture(pictures[0])[1]], truth.pixels), truth.variance)
        rivals.each(lambda rival: rival.choose_spp(pictures[0], truth, target, plan.rival_seconds))
        for turn, seed in enumerate(pictures):
            report(f"picture {turn + 1} of {plan.repeats}")
            if turn % 2 == 0:
                ours.add(*our_picture(seed))
            rivals.each(partial(_Measured.picture, seed=seed))
            if turn % 2 == 1:
                ours.add(*our_picture(seed))
        report("whole processes")
        rivals.each(lambda rival: rival.time_starts(starts))
    prepare = sum(renderer.prepared.seconds.get(part, 0.0) for part in ("compile", "upload", "build"))
    side = ours.side(truth, prepare, process_seconds(["-m", "wrt", *(command or [])], starts))
    found = {variant: measured.result(side, truth) for variant, measured in rivals.measured.items()}
    return Result(scene.name, scene.settings.size, plan.integrator, threads, side, found, rivals.not_available, truth)


def process_seconds(arguments: list[str], times: int, environment: Mapping[str, str] | None = None) -> float:
    """The median wall clock of a Python process; one more run, before, is not counted (kernel caches, files). NaN: no times."""
    seconds = []
    for _ in range(times + 1 if times else 0):
        begin = time.perf_counter()
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment)
        if done.returncode != 0:
            raise InputError(f"python {' '.join(arguments)} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds[1:])) if times else float("nan")


COLUMNS = ("", "spp", "seconds, tracing", "RMSE", "bias against the reference", "scene and structure, s",
           "process to wrt's error, s", "times wrt's, tracing", "times wrt's, process")


def text(result: Result) -> str:
    """For the terminal and for a report, as Markdown."""
    lines = [("wrt", *_cells(result.wrt), "1", "1")]
    for variant, rival in result.mitsuba.items():
        lines.append((f"Mitsuba {variant}, {result.integrator}", *_cells(rival.side), shown(rival.ratio),
                      _known(rival.process_ratio, "{:.3g}")))
    width, height = result.size
    told = [f"{result.scene}, {width}x{height}, {result.threads} threads; the reference's own RMSE is {result.reference.rmse:.2g}.",
            "", table(COLUMNS, lines), "", LEGEND]
    told += [f"Mitsuba {variant} is not available: {why}." for variant, why in result.not_available.items()]
    told += [f"The picture of {variant} is not of the same light: its ratio says nothing. Try --matte, or another --integrator."
             for variant, rival in result.mitsuba.items() if not rival.same_light]
    return "\n".join(told)


LEGEND = """\
times wrt's: how many times as long Mitsuba takes to wrt's error, tracing alone (median and quartiles) and as a whole process, with
start, imports, scene, structure and compiler; what both programs' compilers keep on disk was there before. Mitsuba traces with
Embree in its robust mode."""


def _cells(side: Side) -> tuple[str, ...]:
    bias = f"below {side.bias_below:.2g}" if np.isnan(side.bias) else f"{side.bias:.2g}"
    return (str(side.spp), shown(quartiles(side.seconds)), f"{side.rmse:.4g}", bias, f"{side.prepare_seconds:.2f}",
            _known(side.process_seconds, "{:.2f}"))


def _known(value: float, form: str) -> str:
    return "not timed" if np.isnan(value) else form.format(value)
