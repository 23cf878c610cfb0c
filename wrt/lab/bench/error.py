"""`python -m wrt bench error`: time and error of a render as its settings vary.

A knob is a setting or option that the study varies, one knob at a time. Each value is rendered with 1, 2, 4 ... samples per pixel and
several seeds. Every picture is compared with one reference of the same scene."""

import hashlib
import math
import platform
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

import wrt
from wrt.accel.structures import ACCELERATORS
from wrt.core.interrupts import Interrupted
from wrt.kernels.shade.features import Features
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench import Error as Plan
from wrt.lab.bench import error_statistics as statistics
from wrt.lab.bench.error_statistics import CONFIDENCE, UNKNOWN, Estimate
from wrt.lab.bench.report import Columns, Part, Row, grouped, markdown, tabled, tables_page
from wrt.picture import metrics
from wrt.picture.film import Film
from wrt.renderer.options import Options
from wrt.renderer.progress import TimeLeft
from wrt.renderer.render import Renderer
from wrt.scene.model import Scene
from wrt.scene.settings import SAMPLERS

BASE = "as it is"
# Slopes of log variance over log spp. Independent samples have -1. Scrambled nets have -3 if the integrand is smooth (Owen 1997,
# "Scrambled Net Variance for Integrals of Smooth Functions"). They have -1 - 1/d if an edge crosses d dimensions (He and Wang 2015, "On
# the Convergence Rate of Randomized Quasi-Monte Carlo for Discontinuous Functions"). Here d is 2: each pair of dimensions is a net by
# itself. An integrand that depends on two pairs at once (pixel and lens, pixel and light) has -1, as for independent samples.
THEORY = {"independent": "-1", "sobol": "-1 to -3"}
REFERENCE_SEEDS = 8
REFERENCE_DEPTH, REFERENCE_THROUGHPUT = 32, 1e-5  # least max_depth and largest min_throughput of the reference
BRUTE_FORCE_LIMIT = 5000  # most primitives for which brute force is measured


@dataclass(frozen=True)
class Knob:
    """A field of Settings or Options that the study varies. values: the values to try; matters: False if the scene ignores the field."""

    name: str
    kind: Literal["settings", "options"]
    values: Callable[[Scene], Iterable[Any]]
    matters: Callable[[Scene, Features], bool] = lambda scene, features: True


def triangles(scene: Scene) -> int:
    return sum(len(thing.mesh.faces) for thing in scene.objects)


def structures(scene: Scene) -> list[str]:
    """Return each structure's name in the registry, without aliases; brute_force only for up to BRUTE_FORCE_LIMIT primitives."""
    first = {cls: name for name, cls in reversed(list(ACCELERATORS.items()))}.values()
    small = triangles(scene) + len(scene.spheres) <= BRUTE_FORCE_LIMIT
    return [name for name in ACCELERATORS if name in first and (name != "brute_force" or small)]


def has_secondary_rays(scene: Scene, features: Features) -> bool:
    return features.reflection or features.refraction or features.blend


KNOBS = {knob.name: knob for knob in (
    Knob("sampler", "settings", lambda scene: SAMPLERS),
    Knob("max_depth", "settings", lambda scene: (0, 1, 2, 4, 8, 16), has_secondary_rays),
    Knob("min_throughput", "settings", lambda scene: (0.1, 0.01, 0.001, 0.0001), has_secondary_rays),
    Knob("fresnel", "settings", lambda scene: ("exact", "schlick"), lambda scene, _: any(m.uses("ior") for m in scene.materials)),
    Knob("triangle", "options", lambda scene: RAY_TRIANGLE, lambda scene, _: triangles(scene) > 0),
    Knob("box", "options", lambda scene: RAY_AABB),
    Knob("accel", "options", structures),
)}


@dataclass(frozen=True)
class Variant:
    """The scene and options with one knob at one value. The unchanged scene has knob "" and value None."""

    knob: str
    value: Any
    scene: Scene
    options: Options

    @property
    def label(self) -> str:
        return f"{self.knob} = {self.value}" if self.knob else BASE


def variants(scene: Scene, options: Options, features: Features, knobs: Sequence[str]) -> tuple[list[Variant], list[str]]:
    """Return the unchanged scene and a variant for every other value of every knob. Also return a sentence for each knob without effect."""
    found, left_out = [Variant("", None, scene, options)], []
    for name in knobs:
        knob = KNOBS[name]
        if not knob.matters(scene, features):
            left_out.append(f"{name}: it changes nothing in this scene")
            continue
        now = getattr(scene.settings if knob.kind == "settings" else options, name)
        for turned in [{name: value} for value in knob.values(scene) if value != now]:
            here = (scene.with_settings(**turned), options) if knob.kind == "settings" else (scene, replace(options, **turned))
            found.append(Variant(name, turned[name], *here))
    return found, left_out


class Sweep(Row):
    """Results of a sweep over knobs.

    - rows: one row for each variant and spp (samples per pixel); knob None: the unchanged scene; products: `gram` of the row's pictures.
    - rmse: square root of one picture's mean squared error less the reference's variance; NaN unless this difference is above 0.
    - bias: root mean square bias, NaN if noise hides it; bias_below: its upper bound. rmse^2 = bias^2 + noise^2.
    - efficiency: 1 / (mse x seconds). slopes: for each variant, the slopes of log mse and of log variance over log spp.
    - same_pixels: variants whose pixels equal those of the unchanged scene. interrupted: number of the signal that ended the sweep."""

    def _repr_html_(self) -> str:
        return tables_page(tables(self))


def make_reference(scene: Scene, options: Options, spp: int, seeds: Sequence[int], depth: int | None = None) -> Row:
    """Render the reference with exact Fresnel, Sobol samples and default intersection tests. depth: max_depth, by default 32 or more.
    - pixels: mean over the seeds, (H, W, 3) float64; variance: variance of this mean, averaged over pixels and channels.
    - lost_throughput_per_sample: throughput of the rays that were cut; it bounds the light that the reference itself lacks."""
    settings = scene.settings
    depth = max(settings.max_depth, REFERENCE_DEPTH) if depth is None else depth
    throughput = min(settings.min_throughput, REFERENCE_THROUGHPUT)
    scene = scene.with_settings(max_depth=depth, min_throughput=throughput, fresnel="exact", sampler="sobol")
    renderer = Renderer(scene, Options(device=options.device, threads=options.threads, camera=options.camera))
    begin = time.perf_counter()
    films = [finished(renderer.run(seed=seed, spp=spp)) for seed in seeds]
    pictures = np.stack([film.pixels for film in films]).astype(np.float64)
    variance = float(pictures.var(axis=0, ddof=1).mean()) / len(seeds)
    return Row(pixels=pictures.mean(axis=0), variance=variance, rmse=math.sqrt(variance), mean=float(pictures.mean()),
               lost_throughput_per_sample=float(np.mean([film.stats["lost_throughput_per_sample"] for film in films])),
               seeds=len(seeds), spp_each=spp, max_depth=depth, min_throughput=throughput, seconds=time.perf_counter() - begin)


def finished(film: Film) -> Film:
    """Return the film; raise Interrupted if Ctrl-C ended it early."""
    if film.stats["interrupted"]:
        raise Interrupted(film.stats["signal"] or signal.SIGINT)
    return film


def measure(variant: Variant, renderer: Renderer, spp: int, seeds: Sequence[int], truth: Row) -> Row:
    """Render a variant with every seed; return time, error against the reference `truth`, and their confidence intervals."""
    films = [finished(renderer.run(seed=seed, spp=spp)) for seed in seeds]
    n, settings = len(films), variant.scene.settings
    seconds = np.array([film.stats["seconds"]["trace"] for film in films])
    products = statistics.gram([film.pixels for film in films], truth.pixels)
    compared = [metrics.compare(film.pixels, truth.pixels, exposure=settings.exposure, tonemap=settings.tonemap) for film in films]

    def mse(indices: np.ndarray) -> float:
        return statistics.mse_of(products[np.ix_(indices, indices)], truth.variance)

    def efficiency(indices: np.ndarray) -> float:
        return 1.0 / (mse(indices) * float(seconds[indices].mean()))

    measurable = mse(np.arange(n)) > 0.0
    bias, bias_below = statistics.bias_with_bound(products, truth.variance)
    return Row(
        variant=variant.label, knob=variant.knob or None, value=variant.value, spp=spp, products=products, pareto=False,
        seconds=statistics.mean_estimate(seconds.tolist()),
        rmse=statistics.estimate(lambda i: max(mse(i), 0.0) ** 0.5, n, logarithmic=True) if measurable else UNKNOWN,
        efficiency=statistics.estimate(efficiency, n, logarithmic=True) if measurable else UNKNOWN,
        relmse=statistics.mean_estimate([result["relmse"] for result in compared]),
        flip=statistics.mean_estimate([result["flip"] for result in compared]),
        bias=bias, bias_below=bias_below, noise=max(statistics.noise_of(products), 0.0) ** 0.5,
        build_seconds=films[0].stats["accel"]["build_seconds"],
        rays_per_sample=float(np.mean([film.stats["rays_per_sample"] for film in films])),
        _digest=hashlib.sha256(b"".join(film.pixels.tobytes() for film in films)).hexdigest())


def slope_of(rows: Sequence[Row], known: float, sampler: str) -> Row:
    """Fit the slopes of log error over log spp to the rows of one variant. known: variance of the reference; sampler: key of THEORY."""

    def fit(of: Callable[[np.ndarray], float]) -> statistics.Estimate:
        return statistics.slope([row.spp for row in rows], lambda some: [of(row.products[np.ix_(some, some)]) for row in rows],
                                len(rows[0].products))

    return Row(variant=rows[0].variant, mse=fit(lambda products: statistics.mse_of(products, known)),
               noise=fit(statistics.noise_of), theory=THEORY[sampler])


def same_pixels(rows: Sequence[Row]) -> list[str]:
    """Return the variants whose pictures equal those of the unchanged scene, bit for bit."""
    base = {row.spp: row._digest for row in rows if row.knob is None}
    return [variant for (variant, knob), group in grouped(rows, "variant", "knob").items()
            if knob is not None and all(row._digest == base.get(row.spp) for row in group)]


def sweep(scene: Scene, plan: Plan, options: Options, report: Callable[[str], None] = lambda text: None) -> Sweep:
    """Measure all variants. `report` receives a line before each step; all seeds follow from options.seed.
    After Ctrl-C, return the finished rows, or raise KeyboardInterrupt if no row is finished."""
    seeds = [int(word) for word in np.random.SeedSequence(options.seed).generate_state(REFERENCE_SEEDS + plan.repeats)]
    base = Renderer(scene, options)
    found, left_out = variants(scene, options, base.prepared.plan.features, plan.knobs or tuple(KNOBS))
    reference_spp = plan.reference_spp or 8 * plan.max_spp
    truth_samples, variant_samples = REFERENCE_SEEDS * reference_spp, plan.repeats * sum(plan.levels)
    left = TimeLeft(truth_samples + len(found) * variant_samples)  # as if all samples took the same time
    report(f"reference: {REFERENCE_SEEDS} seeds of {reference_spp} spp")
    truth = make_reference(scene, options, reference_spp, seeds[:REFERENCE_SEEDS])
    machine = {"device": base.prepared.device.name or "CPU", "threads": base.prepared.threads, "system": platform.machine(),
               "wrt": wrt.__version__}
    result = Sweep(scene=scene.name, size=list(scene.settings.size), repeats=plan.repeats, seed=options.seed, confidence=CONFIDENCE,
                   reference=truth, machine=machine, left_out=left_out, interrupted=None)
    rows: dict[str, list[Row]] = {variant.label: [] for variant in found}
    try:
        for number, variant in enumerate(found):
            left.done = truth_samples + number * variant_samples
            renderer = base if variant.knob == "" else Renderer(variant.scene, variant.options)
            finished(renderer.run(spp=1))  # the first launch is slower, and not timed
            for spp in plan.levels:
                likely = 2.0 * rows[variant.label][-1].seconds.value * plan.repeats if rows[variant.label] else 0.0
                if likely > plan.row_limit:
                    result.left_out.append(f"{variant.label} from {spp} spp on: its seeds would take about {likely:.0f} s")
                    break
                report(f"{number + 1}/{len(found)} {variant.label}: {spp} spp{left}")
                rows[variant.label].append(measure(variant, renderer, spp, seeds[REFERENCE_SEEDS:], truth))
                left.done += plan.repeats * spp
    except KeyboardInterrupt as stop:
        if not any(rows.values()):
            raise
        result.interrupted = int(getattr(stop, "number", signal.SIGINT))
        result.left_out.append(f"what was not done when it was interrupted: {', '.join(each.label for each in found[number:])}")
    result.rows = [row for each in rows.values() for row in each]
    result.slopes = [slope_of(rows[each.label], truth.variance, each.scene.settings.sampler) for each in found if rows[each.label]]
    result.same_pixels = same_pixels(result.rows)
    for i in statistics.pareto_front([(row.seconds.value, row.rmse.value) for row in result.rows]):
        result.rows[i].pareto = True
    return result


def number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def interval(x: Estimate) -> str:
    """Format a value, and half the width of its confidence interval in percent of the value."""
    if math.isnan(x.value):
        return "-"
    half = 0.5 * (x.high - x.low) / abs(x.value) if x.value else math.nan
    return number(x.value) + ("" if math.isnan(half) else f" ±{100.0 * half:.0f}%")


def range_of(x: Estimate, digits: str) -> str:
    return "-" if math.isnan(x.value) else f"{x.value:{digits}} [{x.low:{digits}}, {x.high:{digits}}]"


COLUMNS: Columns = {
    "setting": "{variant}", "spp": "{spp}", "seconds": lambda row: interval(row.seconds), "RMSE": lambda row: interval(row.rmse),
    "bias": lambda row: f"< {number(row.bias_below)}" if math.isnan(row.bias) else number(row.bias),
    "noise": lambda row: number(row.noise), "relMSE": lambda row: number(row.relmse.value), "FLIP": lambda row: interval(row.flip),
    "efficiency": lambda row: range_of(row.efficiency, ".3g"), "front": lambda row: "*" if row.pareto else ""}
SLOPE_COLUMNS: Columns = {"setting": "{variant}", "slope of MSE": lambda slope: range_of(slope.mse, ".2f"),
                          "slope of noise": lambda slope: range_of(slope.noise, ".2f"), "theory": "{theory}"}


def notes(sweep: Sweep) -> list[str]:
    """Return paragraphs that explain how the figures were measured."""
    r, machine = sweep.reference, sweep.machine
    lines = [
        f"{sweep.size[0]}x{sweep.size[1]} pixels, {sweep.repeats} seeds each, on {machine['device']},"
        f" {machine['threads']} threads ({machine['system']}), wrt {machine['wrt']}.",
        f"Reference: the mean (float64) of {r.seeds} pictures with {r.spp_each} spp each, exact Fresnel, max_depth {r.max_depth},"
        f" min_throughput {r.min_throughput:g}, rendered in {r.seconds:.0f} s. Its standard error is {number(r.rmse)} (root mean square"
        f" over the pixels, whose mean is {number(r.mean)}). Cut rays had {number(r.lost_throughput_per_sample)} of the throughput.",
        f"Seconds are those of tracing alone. The seeds give {CONFIDENCE:.0%} confidence intervals. RMSE, bias and efficiency exclude the"
        " reference's variance; relMSE and FLIP include it. RMSE^2 = bias^2 + noise^2. A bias with < is an upper bound, because noise"
        " hides the bias. Efficiency is 1 / (MSE x seconds). front: * marks the Pareto front; no other row is as fast and more accurate"
        " by over 1%.",
        "Theory of the slopes: -1 for independent samples. Scrambled nets have -3 if the integrand is smooth and -1.5 if an edge"
        " crosses it. Each pair of dimensions is a net by itself: light that depends on two pairs (pixel and lens, pixel and light) has"
        " -1.",
    ]
    if sweep.same_pixels:
        lines.append(f"Pixels equal to those of the unchanged scene, bit for bit: {', '.join(sweep.same_pixels)}.")
    return lines + [f"Left out: {line}." for line in sweep.left_out]


def tables(sweep: Sweep) -> list[Part]:
    return [tabled(COLUMNS, sweep.rows, f"Speed against error: {sweep.scene}"),
            tabled(SLOPE_COLUMNS, sweep.slopes, "Slopes of the error", "Slopes of log MSE, and of log variance (noise), over log spp.")]


def text(sweep: Sweep) -> str:
    """Return the report as Markdown."""
    return markdown([*tables(sweep), Part("", "\n\n".join(notes(sweep)))]).rstrip()
