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
from wrt.lab.bench import error_statistics as statistics
from wrt.lab.bench.error_report import BASE, THEORY, Sweep
from wrt.lab.bench.error_statistics import CONFIDENCE, UNKNOWN
from wrt.lab.bench.report import Row, grouped
from wrt.lab.plans import Error as Plan
from wrt.picture import metrics
from wrt.picture.film import Film
from wrt.renderer.options import Options
from wrt.renderer.progress import TimeLeft
from wrt.renderer.render import Renderer
from wrt.scene.model import Scene
from wrt.scene.settings import SAMPLERS

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
