"""`python -m wrt bench mitsuba`: the same picture by wrt and by Mitsuba 3 (scalar_rgb), to the same error.

Both are held against one reference. wrt renders with a given number of samples; Mitsuba gets as many as it likely needs for the
same error, and what it really needs is taken from the error that it reaches: its samples are independent, so that its mean
squared error falls as 1 / time. Runs alternate; each has a seed of its own.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wrt.bench import error_statistics as statistics
from wrt.bench.error import REFERENCE_SEEDS, Reference, finished, make_reference
from wrt.bench.mitsuba import mitsuba, to_mitsuba
from wrt.bench.price import Quartiles, quartiles, shown
from wrt.driver import Options, Renderer
from wrt.errors import InputError
from wrt.scene import Material, Scene

PILOT_SPP = 16
SAME = 0.25  # of the squared error compared at: a squared bias beyond it means that the pictures are not of the same light


@dataclass(frozen=True)
class Plan:
    """spp: wrt's samples. repeats: pictures of each. reference_spp: of each of its seeds (None: 8 spp). rival_seconds: no
    picture of Mitsuba's takes longer. integrator: Mitsuba's, see wrt.bench.mitsuba. starts: how often a whole process is
    timed (0: not at all)."""

    spp: int = 64
    repeats: int = 7
    reference_spp: int | None = None
    rival_seconds: float = 60.0
    integrator: str = "auto"
    starts: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.spp <= 1 << 16 or not 3 <= self.repeats <= 1000:
            raise InputError(f"spp must be 1 to 65536 and repeats 3 to 1000, got {self.spp} and {self.repeats}")


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
        return {"spp": self.spp, "seconds": self.seconds.tolist(), "rmse": self.rmse, "bias": self.bias,
                "bias_below": self.bias_below, "prepare_seconds": self.prepare_seconds, "process_seconds": self.process_seconds}


@dataclass(frozen=True)
class Result:
    """ratio: seconds of Mitsuba over those of wrt at wrt's error, tracing alone; process_ratio: of whole processes."""

    scene: str
    size: tuple[int, int]
    integrator: str
    wrt: Side
    mitsuba: Side
    ratio: Quartiles
    process_ratio: float
    reference: Reference

    @property
    def same_light(self) -> bool:
        """Whether Mitsuba's picture has wrt's expectation, as far as its noise at equal error can tell."""
        return not self.mitsuba.bias**2 > SAME * self.wrt.rmse**2

    def as_dict(self) -> dict[str, Any]:
        return {"scene": self.scene, "size": list(self.size), "integrator": self.integrator, "wrt": self.wrt.as_dict(),
                "mitsuba": self.mitsuba.as_dict(), "ratio": list(self.ratio), "process_ratio": self.process_ratio,
                "same_light": self.same_light, "reference": self.reference.as_dict()}


def matte(scene: Scene) -> Scene:
    """The scene with every surface diffuse, of the albedo that it has, and round apertures: what Mitsuba's "direct" draws
    exactly. Emission that is only seen is left out."""
    changed = {id(m): Material(name=m.name, albedo=m.albedo, albedo_texture=m.albedo_texture, two_sided=m.two_sided,
                               emission=m.emission if m.lights_others else (0.0, 0.0, 0.0)) for m in scene.materials}
    objects = tuple(replace(thing, materials=tuple(changed[id(m)] for m in thing.materials)) for thing in scene.objects)
    spheres = tuple(replace(sphere, material=changed[id(sphere.material)]) for sphere in scene.spheres)
    cameras = tuple(replace(camera, blades=0) for camera in scene.cameras)
    return replace(scene, objects=objects, spheres=spheres, cameras=cameras, ambient=(0.0, 0.0, 0.0))


def run(scene: Scene, plan: Plan, options: Options, command: list[str] | None = None,
        report: Callable[[str], None] = lambda line: None) -> Result:
    """Measure. command: arguments of `python -m wrt` that render this scene at 1 spp: what a process takes but for tracing
    (None: not timed).

    Raises InputError where Mitsuba is missing, or cannot draw the scene exactly.
    """
    scene = scene.with_settings(filter="box")  # the only one whose pixels Mitsuba takes by themselves
    seeds = [int(word) for word in np.random.SeedSequence(plan.seed).generate_state(REFERENCE_SEEDS + plan.repeats)]
    pictures = seeds[REFERENCE_SEEDS:]
    with mitsuba() as mi:
        begin = time.perf_counter()
        translated = to_mitsuba(scene, options.camera, integrator=plan.integrator)
        load_seconds = time.perf_counter() - begin
        spp = PILOT_SPP
        report(f"reference: {REFERENCE_SEEDS} seeds")
        truth = make_reference(scene, options, plan.reference_spp or 8 * plan.spp, seeds[:REFERENCE_SEEDS],
                               scene.settings.max_depth)
        renderer = Renderer(scene, options)

        def ours(seed: int) -> np.ndarray:
            return finished(renderer.run(seed=seed, spp=plan.spp)).pixels

        def theirs(seed: int) -> np.ndarray:
            return np.array(mi.render(translated, spp=spp, seed=seed % 2**31), dtype=np.float32)

        report("pilot")
        target = statistics.mse_of(statistics.gram([ours(pictures[0])], truth.pixels), truth.variance)
        seconds, pilot = timed(theirs, pictures[0])
        needed = spp * statistics.mse_of(statistics.gram([pilot], truth.pixels), truth.variance) / max(target, 1e-30)
        spp = int(np.clip(round(needed), 1, max(1.0, PILOT_SPP * plan.rival_seconds / seconds)))
        times: dict[str, list[float]] = {"wrt": [], "mitsuba": []}
        films: dict[str, list[np.ndarray]] = {"wrt": [], "mitsuba": []}
        for turn, seed in enumerate(pictures):
            for name, job in list({"wrt": ours, "mitsuba": theirs}.items())[:: 1 if turn % 2 == 0 else -1]:
                report(f"picture {turn + 1} of {plan.repeats}, {name}")
                seconds, film = timed(job, seed)
                times[name].append(seconds)
                films[name].append(film)

    def side(name: str, samples: int, prepare: float, process: float) -> Side:
        products = statistics.gram(films[name], truth.pixels)
        bias, below = statistics.bias_with_bound(products, truth.variance)
        return Side(samples, np.array(times[name]), max(statistics.mse_of(products, truth.variance), 0.0) ** 0.5, bias, below,
                    prepare, process)

    report("whole processes")
    prepare = sum(renderer.seconds.get(part, 0.0) for part in ("compile", "upload", "build"))
    starts = plan.starts if command else 0
    a = side("wrt", plan.spp, prepare, process_seconds(["-m", "wrt", *(command or [])], starts) + float(np.median(times["wrt"])))
    b = side("mitsuba", spp, load_seconds, float("nan"))
    factor = (b.rmse / a.rmse) ** 2
    start = process_seconds(["-c", "import mitsuba as mi; mi.set_variant('scalar_rgb')"], starts) + load_seconds
    b = replace(b, process_seconds=start + factor * float(np.median(b.seconds)))
    return Result(scene.name, scene.settings.size, plan.integrator, a, b, quartiles(factor * b.seconds / a.seconds),
                  b.process_seconds / a.process_seconds, truth)


def timed(job: Callable[[int], np.ndarray], seed: int) -> tuple[float, np.ndarray]:
    begin = time.perf_counter()
    out = job(seed)
    return time.perf_counter() - begin, out


def process_seconds(arguments: list[str], times: int) -> float:
    """The median wall clock of a Python process; one more run, before, is not counted (kernel caches, files). NaN: no times."""
    seconds = []
    for _ in range(times + 1 if times else 0):
        begin = time.perf_counter()
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True)
        if done.returncode != 0:
            raise InputError(f"python {' '.join(arguments)} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds[1:])) if times else float("nan")


def text(result: Result) -> str:
    """For the terminal and for a report, as Markdown."""
    rows = ["| | spp | seconds, tracing | RMSE | bias against the reference | scene and structure, s | process to wrt's error, s |",
            "| --- | ---: | ---: | ---: | ---: | ---: | ---: |"]
    for name, side in (("wrt", result.wrt), (f"Mitsuba scalar_rgb, {result.integrator}", result.mitsuba)):
        bias = f"below {side.bias_below:.2g}" if np.isnan(side.bias) else f"{side.bias:.2g}"
        rows.append(f"| {name} | {side.spp} | {shown(quartiles(side.seconds))} | {side.rmse:.4g} | {bias} | "
                    f"{side.prepare_seconds:.2f} | {side.process_seconds:.2f} |")
    told = [f"{result.scene}, {result.size[0]}x{result.size[1]}; the reference's own RMSE is {result.reference.rmse:.2g}.", "",
            *rows, "", f"To equal error Mitsuba takes {shown(result.ratio)} times as long, tracing alone."]
    if not np.isnan(result.process_ratio):
        told.append(f"With start, imports and scene (kernels compiled before): {result.process_ratio:.3g} times.")
    if not result.same_light:
        told.append("The pictures are not of the same light: the ratio says nothing. Try --matte, or another --integrator.")
    return "\n".join(told)
