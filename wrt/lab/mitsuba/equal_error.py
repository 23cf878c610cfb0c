"""`python -m wrt bench mitsuba`: time that wrt and Mitsuba 3 need for a picture of the same error.

All pictures are compared with one reference. wrt takes a fixed number of samples. Mitsuba takes about as many as it needs for
the same error. Its samples are independent, so its mean squared error falls as 1 / time. Mitsuba's time for exactly wrt's error follows.
Runs alternate, each with its own seed, and use the same number of threads. Each variant of Mitsuba has its own process, so that a crash
(LLVM 15 and 16 crash at the first picture) is a message."""

import importlib
import importlib.util
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.lab.bench import error_statistics as statistics
from wrt.lab.bench.error import REFERENCE_SEEDS, finished, make_reference
from wrt.lab.bench.report import Columns, Groups, Part, Row, tabled
from wrt.lab.bench.timing import quartiles, shown, spread
from wrt.lab.mitsuba import Mitsuba as Plan
from wrt.lab.mitsuba.translate import llvm_missing, mitsuba, translate
from wrt.renderer.options import Options
from wrt.renderer.render import Renderer
from wrt.scene.cameras import Camera, CameraKind
from wrt.scene.materials import Material
from wrt.scene.model import Scene

PILOT_SPP = 16  # samples per pixel of the picture that estimates how many samples Mitsuba needs
SAME = 0.25  # largest squared bias over squared error at which two pictures show the same light


def matte(scene: Scene) -> Scene:
    """Return the scene with diffuse surfaces and round apertures, which Mitsuba's integrator "direct" renders exactly.
    Albedos stay the same; emission that does not light other surfaces is removed."""
    changed = {id(m): Material(name=m.name, albedo=m.albedo, albedo_texture=m.albedo_texture, two_sided=m.two_sided,
                               emission=m.emission if m.lights_others else (0.0, 0.0, 0.0)) for m in scene.materials}
    objects = tuple(replace(thing, materials=tuple(changed[id(m)] for m in thing.materials)) for thing in scene.objects)
    spheres = tuple(replace(sphere, material=changed[id(sphere.material)]) for sphere in scene.spheres)
    cameras = tuple(replace(each, blades=0) if isinstance(each, Camera) else each for each in scene.cameras)
    return replace(scene, objects=objects, spheres=spheres, cameras=cameras, ambient=(0.0, 0.0, 0.0))


def side_of(spp: int, runs: Sequence[tuple[float, np.ndarray]], truth: Row, prepare: float, start: float) -> Row:
    """Return the figures of one renderer. runs: seconds and pixels of each picture; start: seconds of a process without tracing.
    - rmse, bias: error of the pictures against the reference; bias is NaN if noise hides it, and bias_below is its upper bound.
    - prepare_seconds: time to prepare scene and structure; process_seconds: time of a whole process with one picture at this spp."""
    seconds, films = zip(*runs, strict=True)
    products = statistics.gram(films, truth.pixels)
    bias, below = statistics.bias_with_bound(products, truth.variance)
    return Row(spp=spp, seconds=list(seconds), rmse=max(statistics.mse_of(products, truth.variance), 0.0) ** 0.5, bias=bias,
               bias_below=below, prepare_seconds=prepare, process_seconds=start + float(np.median(seconds)))


class Job(NamedTuple):
    """Task of a process: variant, scene, camera (or its name or index in the scene), integrator, and number of threads."""

    variant: str
    scene: Scene
    camera: CameraKind | str | int | None
    integrator: str
    threads: int


class Rival:
    """A variant of Mitsuba in a process, which loads the scene and renders pictures until it is closed. load_seconds: time to load.

    Raise InputError if the variant is not usable, Mitsuba cannot render the scene exactly, or the process has ended."""

    def __init__(self, job: Job) -> None:
        if importlib.util.find_spec("mitsuba") is None:
            raise InputError("Mitsuba 3 is not usable (not installed)", hint='pip install "wrt[peers]" installs it')
        if job.variant.startswith("llvm") and (reason := llvm_missing()):
            raise InputError(reason)
        self.job, self.spp, self.start = job, PILOT_SPP, math.nan
        self.runs: list[tuple[float, np.ndarray]] = []
        self.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        self.load_seconds: float = self.ask(load, job)

    def __enter__(self) -> "Rival":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.pool.shutdown(wait=kind is None, cancel_futures=True)

    def ask(self, function: Callable[..., Any], *arguments: object) -> Any:
        try:
            return self.pool.submit(function, *arguments).result()
        except BrokenProcessPool as error:
            raise InputError(f"the process of Mitsuba {self.job.variant} ended without an answer") from error

    def render(self, spp: int, seed: int) -> tuple[float, np.ndarray]:
        """Render a picture; return its seconds and pixels (H, W, 3) float32."""
        found: tuple[float, np.ndarray] = self.ask(render, spp, seed % 2**31)
        return found

    def choose_spp(self, seed: int, truth: Row, target: float, longest: float) -> None:
        """Set spp so that the mean squared error is about `target`, but that a picture takes at most about `longest` seconds.
        Mitsuba compiles kernels at the first picture with each spp, so that picture is not timed."""
        self.render(PILOT_SPP, seed)
        seconds, film = self.render(PILOT_SPP, seed)
        needed = PILOT_SPP * statistics.mse_of(statistics.gram([film], truth.pixels), truth.variance) / max(target, 1e-30)
        self.spp = int(np.clip(round(needed), 1, max(1.0, PILOT_SPP * longest / seconds)))
        self.render(self.spp, seed)

    def time_starts(self, times: int) -> None:
        """Set `start` to the median seconds of a process that imports, loads the scene from arrays and renders at 1 spp, as for wrt."""
        imports = process_seconds(["-c", f"import mitsuba as mi; mi.set_variant({self.job.variant!r})"], times)
        rest = []
        for _ in range(times + 1 if times else 0):
            with Rival(self.job) as process:
                rest.append(process.load_seconds + process.render(1, 0)[0])
        self.start = imports + float(np.median(rest[1:])) if times else imports

    def result(self, ours: Row, truth: Row) -> Row:
        """Return the figures of `side_of`, and ratio and process_ratio: Mitsuba's time at wrt's error over wrt's, to trace and in all.
        same_light: False if Mitsuba's squared bias is above SAME times wrt's squared error: the pictures show different light."""
        side = side_of(self.spp, self.runs, truth, self.load_seconds, self.start)
        factor = (side.rmse / ours.rmse) ** 2
        side.process_seconds = self.start + factor * float(np.median(side.seconds))
        return Row(**vars(side), ratio=quartiles(factor * np.array(side.seconds) / np.array(ours.seconds)),
                   process_ratio=side.process_seconds / ours.process_seconds, same_light=not side.bias**2 > SAME * ours.rmse**2)


loaded: dict[str, Any] = {}  # of this process: Mitsuba's context, module and scene


def load(job: Job) -> float:
    """Load a scene in this process; return the seconds. Raise InputError if Mitsuba cannot."""
    os.dup2(2, 1)  # output to stderr, since the parent's standard output may be JSON
    try:
        loaded["context"] = mitsuba(job.variant)
        loaded["mi"] = loaded["context"].__enter__()
        importlib.import_module("drjit").set_thread_count(job.threads)
        begin = time.perf_counter()
        loaded["scene"] = translate(loaded["mi"], job.scene, job.camera, job.integrator).scene
        return time.perf_counter() - begin
    except (ImportError, RuntimeError) as error:  # for example a library that cannot be loaded
        raise InputError(str(error)) from None


def render(spp: int, seed: int) -> tuple[float, np.ndarray]:
    """Render the loaded scene; return the seconds and pixels (H, W, 3) float32."""
    begin = time.perf_counter()
    pixels = np.array(loaded["mi"].render(loaded["scene"], spp=spp, seed=seed), dtype=np.float32)
    return time.perf_counter() - begin, pixels


def groups(plan: Plan) -> Groups:
    yield lambda: [compared(plan)]


def compared(plan: Plan) -> Row:
    """Measure wrt and Mitsuba. Whole processes are timed for a scene that is a file.
    Field not_available: unusable variant -> reason. Raise InputError if no variant is usable or Mitsuba cannot render the scene exactly."""
    scene = plan.load().with_settings(filter="box")  # with other filters of Mitsuba a sample adds to several pixels
    options, integrator = Options(camera=plan.camera), plan.integrator
    if plan.matte:
        scene, integrator = matte(scene), "direct" if integrator == "auto" else integrator
    seeds = [int(word) for word in np.random.SeedSequence(plan.seed).generate_state(REFERENCE_SEEDS + plan.repeats)]
    pictures, starts = seeds[REFERENCE_SEEDS:], 0 if isinstance(plan.scene, Scene) else plan.starts
    threads, ours = thread_count(options.threads), []
    rivals: dict[str, Rival] = {}
    not_available: dict[str, str] = {}
    with ExitStack() as stack:
        for variant in dict.fromkeys(plan.variants):
            try:
                rivals[variant] = stack.enter_context(Rival(Job(variant, scene, options.camera, integrator, threads)))
            except InputError as error:
                not_available[variant] = str(error)
        if not rivals:
            raise InputError("; ".join(f"Mitsuba {variant}: {why}" for variant, why in not_available.items()))
        truth = make_reference(scene, options, plan.reference_spp or 8 * plan.spp, seeds[:REFERENCE_SEEDS], scene.settings.max_depth)
        renderer = Renderer(scene, options)

        def our_picture(seed: int) -> tuple[float, np.ndarray]:
            begin = time.perf_counter()
            film = finished(renderer.run(seed=seed, spp=plan.spp)).pixels
            return time.perf_counter() - begin, film

        target = statistics.mse_of(statistics.gram([our_picture(pictures[0])[1]], truth.pixels), truth.variance)
        require_error(target)
        for rival in rivals.values():
            rival.choose_spp(pictures[0], truth, target, plan.rival_limit)
        for turn, seed in enumerate(pictures):
            if turn % 2 == 0:
                ours.append(our_picture(seed))
            for rival in rivals.values():
                rival.runs.append(rival.render(rival.spp, seed))
            if turn % 2 == 1:
                ours.append(our_picture(seed))
        for rival in rivals.values():
            rival.time_starts(starts)
    ready = renderer.prepared.seconds
    prepare = max(ready["compile"], ready["upload"] + ready["build"])  # these run in parallel
    with tempfile.TemporaryDirectory() as folder:
        command = ["render", str(plan.scene), "--spp", "1", "--size", plan.size, "-q", "-o", f"{folder}/start.png"]
        whole = process_seconds(["-m", "wrt", *command, *(f"--set={word}" for word in plan.set)], starts)
    side = side_of(plan.spp, ours, truth, prepare, whole)
    require_error(side.rmse)
    found = {variant: measured.result(side, truth) for variant, measured in rivals.items()}
    return Row(scene=scene.name, size=scene.settings.size, integrator=integrator, threads=threads, wrt=side, mitsuba=found,
               not_available=not_available, reference=truth)


def require_error(error: float) -> None:
    """Raise InputError unless wrt's error, without the reference's noise, is above 0."""
    if not error > 0.0:
        raise InputError("wrt's pictures are as exact as the reference, so that Mitsuba has no error to reach",
                         hint="try a lower --spp")


def process_seconds(arguments: list[str], times: int) -> float:
    """Return the median wall-clock seconds of a Python process, after one run that is not timed; NaN if `times` is 0."""
    seconds = []
    for _ in range(times + 1 if times else 0):
        begin = time.perf_counter()
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True)
        if done.returncode != 0:
            raise InputError(f"python {' '.join(arguments)} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds[1:])) if times else float("nan")


def known(value: float, form: str) -> str:
    return "not timed" if math.isnan(value) else form.format(value)


COLUMNS: Columns = {
    "renderer": "{name}", "spp": "{spp}", "tracing, s": lambda side: spread(side.seconds), "RMSE": "{rmse:.4g}",
    "bias against the reference":
        lambda side: f"below {side.bias_below:.2g}" if math.isnan(side.bias) else f"{side.bias:.2g}",
    "scene and structure, s": "{prepare_seconds:.2f}",
    "process at wrt's error, s": lambda side: known(side.process_seconds, "{:.2f}"),
    "tracing / wrt's": lambda side: shown(side.ratio) if side.ratio else "1",
    "process / wrt's": lambda side: known(side.process_ratio, "{:.3g}")}


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    (result,) = rows
    sides = [Row(**vars(result.wrt), name="wrt", ratio=None, process_ratio=1.0),
             *(Row(**vars(rival), name=f"Mitsuba {variant}, {result.integrator}") for variant, rival in result.mitsuba.items())]
    width, height = result.size
    notes = [f"{result.scene}, {width}x{height}, {result.threads} threads; the reference's own RMSE is {result.reference.rmse:.2g}."]
    notes += [f"Mitsuba {variant} is not available: {why}." for variant, why in result.not_available.items()]
    notes += [f"The picture of {variant} is not of the same light, so that its ratio has no meaning. Try --matte, or another --integrator."
             for variant, rival in result.mitsuba.items() if not rival.same_light]
    return [tabled(COLUMNS, sides, "", "\n".join(notes))]


def line(row: Row) -> str:
    return f"{row.scene}: {', '.join(f'{variant}: {shown(rival.ratio)}' for variant, rival in row.mitsuba.items())}"


TITLE = "Time to equal error against Mitsuba"
LEGEND = """\
tracing / wrt's, process / wrt's: Mitsuba's time to reach wrt's error over wrt's time, for tracing alone (median [quartiles]) and for a
whole process (start, imports, scene, structure, compiler). Kernels came from the caches on disk. Mitsuba traces with Embree in its robust
mode."""
