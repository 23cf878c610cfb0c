"""`python -m wrt bench error`: time and error of a render as its settings vary.

A knob is a setting or option that the study varies, one knob at a time. Each value is rendered with 1, 2, 4 ... samples per pixel and
several seeds. Every picture is compared with one reference of the same scene."""

import hashlib
import math
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Literal

import numpy as np

from wrt.accel.structures import ACCELERATORS
from wrt.core.interrupts import Interrupted
from wrt.core.threads import thread_count
from wrt.kernels.shade.features import Features
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench import Error as Plan
from wrt.lab.bench import error_statistics as statistics
from wrt.lab.bench.error_statistics import CONFIDENCE, UNKNOWN, Estimate
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, machine_line, tabled
from wrt.picture import metrics
from wrt.picture.film import Film
from wrt.renderer.options import Options
from wrt.renderer.plan import features_of
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
    """Return the unchanged scene and a variant for every other value of every knob. Also return the names of the knobs without effect."""
    found, without_effect = [Variant("", None, scene, options)], []
    for name in knobs:
        knob = KNOBS[name]
        if not knob.matters(scene, features):
            without_effect.append(name)
            continue
        now = getattr(scene.settings if knob.kind == "settings" else options, name)
        for turned in [{name: value} for value in knob.values(scene) if value != now]:
            here = (scene.with_settings(**turned), options) if knob.kind == "settings" else (scene, replace(options, **turned))
            found.append(Variant(name, turned[name], *here))
    return found, without_effect


def groups(plan: Plan) -> Groups:
    """Yield a group with the reference, then a group for each variant. All seeds follow from plan.seed."""
    scene, options = plan.load(), Options(device=plan.device, threads=plan.threads, camera=plan.camera)
    seeds = [int(word) for word in np.random.SeedSequence(plan.seed).generate_state(REFERENCE_SEEDS + plan.repeats)]
    found, without_effect = variants(scene, options, features_of(scene, scene.camera(plan.camera)), plan.knobs or tuple(KNOBS))
    truth = cache(partial(make_reference, scene, options, plan.reference_spp or 8 * plan.max_spp, seeds[:REFERENCE_SEEDS]))
    yield lambda: [Row(**vars(truth()), without_effect=without_effect)]
    for variant in found:
        yield partial(variant_rows, plan, variant, seeds[REFERENCE_SEEDS:], truth)


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


def variant_rows(plan: Plan, variant: Variant, seeds: Sequence[int], truth: Callable[[], Row]) -> list[Row]:
    """Return a row for 1, 2, 4 ... samples per pixel, up to plan.max_spp."""
    renderer = Renderer(variant.scene, variant.options)
    finished(renderer.run(spp=1))  # the first launch is slower, and not timed
    return [measure(variant, renderer, spp, seeds, truth()) for spp in plan.levels]


def measure(variant: Variant, renderer: Renderer, spp: int, seeds: Sequence[int], truth: Row) -> Row:
    """Render a variant with every seed; return time, error against the reference `truth`, and their confidence intervals.
    - rmse: square root of one picture's mean squared error less the reference's variance; NaN unless this difference is above 0.
    - bias: root mean square bias, NaN if noise hides it; bias_below: its upper bound. rmse^2 = bias^2 + noise^2.
    - efficiency: 1 / (mse x seconds). products: `gram` of the pictures."""
    films = [finished(renderer.run(seed=seed, spp=spp)) for seed in seeds]
    n, settings = len(films), variant.scene.settings
    seconds = np.array([film.stats["seconds"]["trace"] for film in films])
    products = statistics.gram([film.pixels for film in films], truth.pixels)
    flips = [metrics.compare(film.pixels, truth.pixels, exposure=settings.exposure, tonemap=settings.tonemap)["flip"] for film in films]

    def mse(indices: np.ndarray) -> float:
        return statistics.mse_of(products[np.ix_(indices, indices)], truth.variance)

    def efficiency(indices: np.ndarray) -> float:
        return 1.0 / (mse(indices) * float(seconds[indices].mean()))

    measurable = mse(np.arange(n)) > 0.0
    bias, bias_below = statistics.bias_with_bound(products, truth.variance)
    return Row(
        variant=variant.label, knob=variant.knob or None, value=variant.value, spp=spp, sampler=settings.sampler, products=products,
        seconds=statistics.mean_estimate(seconds.tolist()),
        rmse=statistics.estimate(lambda i: max(mse(i), 0.0) ** 0.5, n, logarithmic=True) if measurable else UNKNOWN,
        efficiency=statistics.estimate(efficiency, n, logarithmic=True) if measurable else UNKNOWN,
        flip=statistics.mean_estimate(flips), bias=bias, bias_below=bias_below,
        noise=max(statistics.noise_of(products), 0.0) ** 0.5,
        _digest=hashlib.sha256(b"".join(film.pixels.tobytes() for film in films)).hexdigest())


def pictures_of(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if "spp" in vars(row)]


def slopes(rows: Sequence[Row]) -> list[Row]:
    """Return for each variant the slopes of log mse and of log variance (noise) over log spp, and the slope of the theory."""
    known, out = rows[0].variance, []
    for (variant, sampler), group in grouped(pictures_of(rows), "variant", "sampler").items():

        def fit(of: Callable[[np.ndarray], float], group: list[Row] = group) -> Estimate:
            return statistics.slope([row.spp for row in group], lambda some: [of(row.products[np.ix_(some, some)]) for row in group],
                                    len(group[0].products))

        out.append(Row(variant=variant, mse=fit(lambda products: statistics.mse_of(products, known)), noise=fit(statistics.noise_of),
                       theory=THEORY[sampler]))
    return out


def same_pixels(rows: Sequence[Row]) -> list[str]:
    """Return the variants whose pictures equal those of the unchanged scene, bit for bit."""
    base = {row.spp: row._digest for row in pictures_of(rows) if row.knob is None}
    return [variant for (variant, knob), group in grouped(pictures_of(rows), "variant", "knob").items()
            if knob is not None and all(row._digest == base.get(row.spp) for row in group)]


def number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def interval(x: Estimate) -> str:
    """Format a value, and half the width of its confidence interval in percent of the value."""
    half = 0.5 * (x.high - x.low) / abs(x.value) if x.value else math.nan
    return number(x.value) + ("" if math.isnan(half) else f" ±{100.0 * half:.0f}%")


TITLE = "Speed against error"
COLUMNS: Columns = {
    "setting": "{variant}", "spp": "{spp}", "seconds": lambda row: interval(row.seconds), "RMSE": lambda row: interval(row.rmse),
    "bias": lambda row: f"< {number(row.bias_below)}" if math.isnan(row.bias) else number(row.bias),
    "noise": lambda row: number(row.noise), "FLIP": lambda row: interval(row.flip), "efficiency": lambda row: interval(row.efficiency)}
SLOPES: Columns = {"setting": "{variant}", "slope of MSE": "{mse.value:.2f} [{mse.low:.2f}, {mse.high:.2f}]",
                   "slope of noise": "{noise.value:.2f} [{noise.low:.2f}, {noise.high:.2f}]", "theory": "{theory}"}
LEGEND = f"""\
seconds: of tracing alone. The seeds give {CONFIDENCE:.0%} confidence intervals. RMSE, bias and efficiency exclude the reference's variance;
FLIP includes it. RMSE^2 = bias^2 + noise^2. A bias with < is an upper bound, because noise hides the bias. efficiency: 1 / (MSE x seconds).
slopes: of log MSE, and of log variance (noise), over log spp. theory: -1 for independent samples. Scrambled nets have -3 if the integrand
is smooth and -1.5 if an edge crosses it. Each pair of dimensions is a net by itself: light that depends on two pairs (pixel and lens, pixel
and light) has -1."""


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    truth, same = rows[0], same_pixels(rows)
    text = (f"Reference: the mean (float64) of {truth.seeds} pictures with {truth.spp_each} spp each, exact Fresnel, max_depth"
            f" {truth.max_depth}, min_throughput {truth.min_throughput:g}, rendered in {truth.seconds:.0f} s. Its standard error is"
            f" {number(truth.rmse)} (root mean square over the pixels, whose mean is {number(truth.mean)}). Cut rays had"
            f" {number(truth.lost_throughput_per_sample)} of the throughput.")
    if same:
        text += f"\n\nPixels equal to those of the unchanged scene, bit for bit: {', '.join(same)}."
    if truth.without_effect:
        text += f"\n\nLeft out, because they change nothing in this scene: {', '.join(truth.without_effect)}."
    return [tabled(COLUMNS, pictures_of(rows), "", text), tabled(SLOPES, slopes(rows), "Slopes of the error")]


def line(row: Row) -> str:
    if "spp" not in vars(row):
        return f"reference: {row.seconds:.0f} s"
    return f"{row.variant}, {row.spp} spp: {row.seconds.value:.3g} s, RMSE {interval(row.rmse)}"


def machine(plan: Plan) -> str:
    return machine_line(f"{thread_count(plan.threads)} threads", f"{plan.size} pixels, {plan.repeats} seeds each", device=plan.device)


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, Any]:
    return {"slopes": [row.as_dict() for row in slopes(rows)], "same_pixels": same_pixels(rows)}
