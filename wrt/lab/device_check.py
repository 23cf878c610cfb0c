"""`python -m wrt devices --check`: compare a device's results with the CPU's, bit for bit, and measure its speed.

A GPU's hits are compared with those of the default structure on the CPU, since all structures find the same hits. A CPU is compared with
recorded bits: hashes of an x86-64 CPU's pictures, in tests/bits.txt of a checkout. What has no recorded bits is compared between two
structures; what does not depend on a structure, such as functions, is left out."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from platform import platform
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import as_integer
from wrt.core.device import launch_on, load_kernel, start
from wrt.core.threads import run_all, thread_count
from wrt.core.types import JsonObject
from wrt.io.load import load_scene
from wrt.kernels.study.elementary import FUNCTIONS, call_functions
from wrt.lab.bench.accel import BRUTE_FORCE_TESTS, answer
from wrt.lab.bench.instruction_sets import instruction_sets
from wrt.lab.bench.rays import RaySet, ray_sets
from wrt.lab.bench.report import Columns, Row, machine_line, markdown, tabled
from wrt.lab.bench.timing import alternate_on, spread
from wrt.lab.bench.visibility import terrain
from wrt.lab.hard_cases.cases import HARD_CASES, generate
from wrt.lab.hard_cases.contestants import CONSTRUCTORS, Own, WarpMesh
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import compile_queries
from wrt.renderer.render import render
from wrt.scene import shapes
from wrt.scene.backgrounds import GradientBackground
from wrt.scene.lights import PointLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere

FOLDER = Path(__file__).parents[2] / "scenes"  # exists in a checkout, not in an installed package
STORED = FOLDER.parent / "tests" / "bits.txt"  # exists in a checkout: hashes of the pixels that x86-64 CPUs compute with PICTURE
PICTURE: dict[str, Any] = {"size": (64, 36), "spp": 4, "seed": 3}
MESHES: dict[str, Callable[[], Mesh]] = {
    "ball": partial(shapes.icosphere, 3), "torus": partial(shapes.torus, 1.0, 0.4, 64, 32), "terrain": partial(terrain, 48),
    "teapot": partial(shapes.teapot, 32), "teapot in a ring": lambda: shapes.merged([shapes.torus(500.0), shapes.teapot(16)], "")}
FAST, SLOW = 1 << 20, 1 << 15  # timed rays on CUDA and on the CPU
RUNS = 7  # timed runs
TIMED_CELLS = 192  # cells a side of the timed terrain
DEFAULT, OTHER = "bvh8", "bvh2"  # on a CPU, results of the default structure are compared with those of the other
RECORDED = "bits recorded on x86-64"
COLUMNS: Columns = {"results": "{part}", "of": "{what}", "compared with": "{against}", "compared": "{count}", "differ": "{differ}",
                    "places": lambda row: ", ".join(row.where[:4]) + (", ..." if len(row.where) > 4 else "")}
SPEED: Columns = {"structure": "{who}", "rays": "{kind}", "Mray/s": lambda row: spread(row.mrays),
                  "default / structure": "{first_over_it:.2f}"}
LEGEND = """\
compared: number of results; with recorded bits, a picture is one result. differ: results whose bits are others. places: meshes and rays of
these results. On a CPU, functions have no row: they would be compared with themselves. Each difference is a
fault: please report it with this table."""
TIMED = """\
Rays and hits are in device memory. Mray/s: median of alternating runs (on a GPU of 10 calls each), quartiles in brackets. default /
structure: speed of wrt's default structure over that of the row's structure."""


@dataclass(frozen=True)
class Check:
    """Options of the check. scenes: files, default: wrt's own; rays: number of each kind for each mesh; cases: rays of each hard case."""

    device: str
    scenes: Sequence[Path] = ()
    rays: int = 20_000
    cases: int = 2000

    def __post_init__(self) -> None:
        start(self.device)
        as_integer(self.rays, "rays", 1, 2**26)

    @property
    def on_gpu(self) -> bool:
        return bool(start(self.device).is_cuda)

    @cached_property
    def pictures(self) -> dict[str, Scene]:
        found = self.scenes or sorted(FOLDER.glob("*.toml"))
        return {path.stem: load_scene(path) for path in found} or {"built in": built_in()}

    @property
    def hashes(self) -> dict[str, str]:
        """Hashes of the pixels of an x86-64 CPU, by scene; empty for a GPU, for the user's scenes, and outside a checkout."""
        if self.on_gpu or self.scenes or not STORED.exists():
            return {}
        return dict(line.split() for line in STORED.read_text(encoding="utf-8").splitlines())


def built_in() -> Scene:
    """Return a scene with most kinds of light transport, for an installed package, which has no scene files."""
    glass, mirror = (Material(kind=kind, albedo=(0.9, 0.9, 0.9), name=kind) for kind in ("glass", "mirror"))
    return Scene(objects=(Object(shapes.quad((-4.0, 0.0, 4.0), (8.0, 0.0, 0.0), (0.0, 0.0, -8.0)), (Material(),)),
                          Object(shapes.teapot(16), (mirror,))),
                 spheres=(Sphere((1.6, 0.7, 0.8), 0.7, glass), Sphere((-1.8, 0.5, 0.5), 0.5, Material(specular=(0.3, 0.3, 0.3)))),
                 lights=(PointLight((-4.0, 7.0, 5.0), (190.0, 185.0, 170.0)),),
                 background=GradientBackground((0.5, 0.7, 0.9), (0.1, 0.2, 0.5)), name="built in")


def structures() -> list[str]:
    return list(dict.fromkeys(kind.name for kind in ACCELERATORS.values()))


def rows(plan: Check, report: Callable[[str], None]) -> Iterator[Row]:
    """Yield a row after each comparison; `report` receives the name of the next comparison."""
    report("compiling")
    compile_all(plan)
    if plan.on_gpu:
        yield from function_rows(plan)
    report("hits")
    yield from hit_rows(plan)
    report("hard cases")
    yield hard_row(plan)
    hashes = plan.hashes
    for name, scene in plan.pictures.items():
        report(f"picture of {name}")
        pixels = render(scene, device=plan.device, **PICTURE).pixels
        if hashes:
            differs = sha256(pixels.tobytes()).hexdigest()[:32] != hashes[name]
            yield row("picture", name, RECORDED, {"": np.array([differs])})
        else:
            truth = render(scene, device="cpu", accel=DEFAULT if plan.on_gpu else OTHER, **PICTURE).pixels
            yield row("pixels", name, "the CPU" if plan.on_gpu else OTHER, {"": different(truth.reshape(-1, 3), pixels.reshape(-1, 3))})


def compile_all(plan: Check) -> None:
    """Compile all kernels for the device, on all cores."""
    device = start(plan.device)
    jobs: list[Callable[[], Any]] = [partial(compile_queries, name, plan.device) for name in structures()]
    jobs += [partial(load_kernel, kernel, device) for scene in plan.pictures.values()
             for kernel in plan_of(scene, Options(device=plan.device)).kernels]
    run_all(jobs, thread_count(None))


def function_rows(plan: Check) -> Iterator[Row]:
    """Yield a row for each elementary function. Its arguments are numbers that are usual in shading, and random bits."""
    rng = np.random.default_rng(0)
    common = rng.normal(0.0, 4.0, size=(2, 50_000)).astype(np.float32)
    x, y = np.concatenate([common, rng.integers(0, 2**32, size=common.shape, dtype=np.uint32).view(np.float32)], axis=1)
    on_cpu, on_device = (function_values(x, y, device) for device in ("cpu", plan.device))
    for i, name in enumerate(FUNCTIONS):
        yield row("functions", name, "the CPU", {"": different(on_cpu[:, i], on_device[:, i])})


def function_values(x: np.ndarray, y: np.ndarray, name: str) -> np.ndarray:
    device = start(name)
    out = wp.empty((len(x), len(FUNCTIONS)), dtype=wp.float32, device=device)
    launch_on(device, call_functions, len(x), *(wp.array(each, dtype=wp.float32, device=device) for each in (x, y)), out)
    return out.numpy()


def hit_rows(plan: Check) -> Iterator[Row]:
    """Yield for each structure a row that compares its hits with the CPU's, for all meshes and kinds of rays."""
    geometries = {name: Geometry.of(make()) for name, make in MESHES.items()}
    on_cpu = {name: build(geometry, device="cpu") for name, geometry in geometries.items()}
    rays = {name: ray_sets(accel, plan.rays) for name, accel in on_cpu.items()}
    against = f"{DEFAULT} of the CPU" if plan.on_gpu else DEFAULT
    for structure in structures():
        if structure == DEFAULT and not plan.on_gpu:
            continue
        differ = dict[str, np.ndarray]()
        for mesh, geometry in geometries.items():
            accel = build(geometry, structure, device=plan.device)
            n = BRUTE_FORCE_TESTS // (20 * len(geometry)) if structure == "brute_force" else plan.rays
            for kind, of_kind in rays[mesh].items():
                differ[f"{mesh}, {kind}"] = compare(accel, on_cpu[mesh], of_kind.part(slice(0, n)))
        yield row("hits", structure, against, differ)


def compare(accel: Accelerator, truth: Accelerator, rays: RaySet) -> np.ndarray:
    """Return flags of the rays whose hits in `accel` and `truth` differ in a bit, (N,)."""
    found, expected = (answer(each, rays, None) for each in (accel, truth))
    if not (isinstance(found, Hits) and isinstance(expected, Hits)):
        return different(np.asarray(found), np.asarray(expected))
    return np.logical_or.reduce([different(getattr(found, name), getattr(expected, name)) for name in ("t", "u", "v", "prim_id")])


def different(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return flags of the rows of two arrays whose bits differ, (N,)."""
    a, b = (np.ascontiguousarray(each).reshape(len(each), -1).view(np.uint8) for each in (a, b))
    return (a != b).any(axis=1)


def hard_row(plan: Check) -> Row:
    """Return the row that compares a structure's hits in all hard cases whose rays and meshes wrt accepts."""
    structure = DEFAULT if plan.on_gpu else OTHER
    differ = dict[str, np.ndarray]()
    for name in HARD_CASES:
        case = generate(name, plan.cases)
        if not case.refused:
            rays = RaySet(name, case.origins, case.directions, case.t_max)
            differ[name] = compare(build(case.geometry, structure, device=plan.device), build(case.geometry, device="cpu"), rays)
    return row("hits", f"{structure}, {len(differ)} hard cases", f"{DEFAULT} of the CPU" if plan.on_gpu else DEFAULT, differ)


def row(part: str, what: str, against: str, differ: dict[str, np.ndarray]) -> Row:
    """Return the row that counts the differences. differ: name of meshes or rays -> flags of their results that differ."""
    return Row(part=part, what=what, against=against, count=sum(map(len, differ.values())),
               differ=sum(int(each.sum()) for each in differ.values()),
               where=[place for place, each in differ.items() if each.any() and place])


def speed_rows(plan: Check) -> tuple[list[Row], str]:
    """Time wrt's structures, and Warp's mesh query with each BVH constructor. Return the rows, and why constructors were skipped.
    If the device runs none of Warp's queries, return no rows."""
    geometry, device = Geometry.of(terrain(TIMED_CELLS)), start(plan.device)
    algorithms: dict[str, Any] = {f"wrt {name}": Own(structure=name, device=plan.device) for name in structures() if name != "brute_force"}
    skipped, warps, out = [], dict[str, Any](), list[Row]()
    for constructor in CONSTRUCTORS:
        warp = WarpMesh(plan.device, constructor)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", UserWarning)  # Warp warns when it builds by another constructor
                warp.prepare(geometry)
            warps[f"Warp, {constructor}"] = warp
        except (RuntimeError, UserWarning) as error:  # includes NotImplementedError
            skipped.append(f"Warp, {constructor}: {str(error).partition('. Falling back')[0]}")
    for own in algorithms.values() if warps else ():
        own.prepare(geometry)
    algorithms |= warps
    kinds = ray_sets(build(geometry, device="cpu"), FAST if device.is_cuda else SLOW) if warps else {}
    for kind, rays in kinds.items():
        jobs = {name: each.search(rays, thread_count(None)) for name, each in algorithms.items()}
        seconds = alternate_on(device, jobs, RUNS)
        first = seconds[next(iter(algorithms))]
        out += [Row(who=name, kind=kind, rays=len(rays), mrays=(len(rays) / taken / 1e6).tolist(),
                    first_over_it=float(np.median(taken / first))) for name, taken in seconds.items()]
    return out, "; ".join(skipped)


@dataclass(frozen=True)
class Result:
    """Result of `run`. machine: description of the device; rows: comparisons; speed, skipped: results of `speed_rows`."""

    machine: str
    rows: list[Row]
    speed: list[Row]
    skipped: str

    @property
    def differ(self) -> int:
        return sum(each.differ for each in self.rows)

    def text(self) -> str:
        verdict = f"{self.differ or 'No'} result{'s' if self.differ > 1 else ''} differ{'' if self.differ > 1 else 's'}."
        parts = [tabled(COLUMNS, self.rows, "Bits", f"Machine: {self.machine}\n\n{verdict}\n\n{LEGEND}"),
                 tabled(SPEED, self.speed, "Speed", "\n\n".join(filter(None, [
                     TIMED if self.speed else "", f"Skipped: {self.skipped}" if self.skipped else ""])))]
        return markdown(parts)

    def as_dict(self) -> JsonObject:
        return {"machine": self.machine, "differ": self.differ, "rows": [each.as_dict() for each in self.rows],
                "speed": [each.as_dict() for each in self.speed], "speed_skipped": self.skipped or None}


def run(plan: Check, report: Callable[[str], None] = lambda line: None) -> Result:
    """Compare and measure; `report` receives lines of progress."""
    machine = machine_line(f"{thread_count(None)} threads for the CPU", f"Warp {wp.__version__}", platform(), instruction_sets(),
                           device=plan.device)
    compared = []
    for each in rows(plan, report):
        compared.append(each)
        if each.differ:
            report(f"{each.part} of {each.what}: {each.differ} of {each.count} differ")
    report("speed")
    speed, skipped = speed_rows(plan)
    return Result(machine, compared, speed, skipped)
