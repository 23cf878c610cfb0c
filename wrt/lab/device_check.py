"""`python -m wrt devices --check`: compare a device's hits and pictures with the CPU's, bit for bit.

A GPU is compared with the default structure on the CPU, since all structures find the same hits. A CPU is compared with itself by other
structures; `tests/test_bits.py` compares it with the recorded bits of x86-64."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
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
from wrt.core.device import load_kernel, start
from wrt.core.threads import run_all, thread_count
from wrt.io.load import load_scene
from wrt.lab.bench.rays import RaySet, ray_sets, terrain
from wrt.lab.bench.report import Columns, Row, machine_line, markdown, tabled
from wrt.lab.hard_cases.cases import HARD_CASES, generate
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import compile_queries
from wrt.renderer.render import render
from wrt.scene import shapes
from wrt.scene.backgrounds import GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

FOLDER = Path(__file__).parents[2] / "scenes"  # exists in a checkout, not in an installed package
PICTURE: dict[str, Any] = {"size": (64, 36), "spp": 4, "seed": 3}
MESHES: dict[str, Callable[[], Mesh]] = {
    "ball": partial(shapes.icosphere, 3), "torus": partial(shapes.torus, 1.0, 0.4, 64, 32), "terrain": partial(terrain, 48),
    "teapot": partial(shapes.teapot, 32), "teapot in a ring": lambda: shapes.merged([shapes.torus(500.0), shapes.teapot(16)], "")}
TESTS = 10_000_000  # most ray-triangle tests of brute force for each mesh and kind of ray
HARD_RAYS = 2000  # of each hard case
DEFAULT, OTHER = "bvh8", "bvh2"  # on a CPU, results of the default structure are compared with those of the other
COLUMNS: Columns = {"results": "{part}", "of": "{what}", "compared with": "{against}", "compared": "{count}", "differ": "{differ}",
                    "places": lambda row: ", ".join(row.where[:4]) + (", ..." if len(row.where) > 4 else "")}
LEGEND = """\
compared: number of results. differ: results whose bits are others. places: meshes and rays of these results. Each difference is a fault:
please report it with this table."""


def scenes(files: Sequence[Path] = ()) -> dict[str, Scene]:
    """Return the scenes of these files, by default those of a checkout; an installed package has a glass teapot."""
    teapot = Scene(objects=(Object(shapes.teapot(16), (Material("glass"),)),), cameras=(Camera.look_at((1.0, 2.0, 4.0), (0.0, 0.5, 0.0)),),
                   background=GradientBackground((0.5, 0.7, 0.9), (0.1, 0.2, 0.5)))
    return {path.stem: load_scene(path) for path in files or sorted(FOLDER.glob("*.toml"))} or {"glass teapot": teapot}


def structures() -> list[str]:
    return list(dict.fromkeys(kind.name for kind in ACCELERATORS.values()))


def compile_all(device: str, pictures: dict[str, Scene]) -> None:
    """Compile all kernels for the device, on all cores."""
    jobs: list[Callable[[], Any]] = [partial(compile_queries, name, device) for name in structures()]
    jobs += [partial(load_kernel, kernel, start(device)) for scene in pictures.values()
             for kernel in plan_of(scene, Options(device=device)).kernels]
    run_all(jobs, thread_count(None))


def rows(device: str, pictures: dict[str, Scene], rays: int, report: Callable[[str], None]) -> Iterator[Row]:
    """Yield a row after each comparison; `report` receives the name of the next comparison. rays: of each kind, for each mesh."""
    on_gpu = start(device).is_cuda
    other, against = (DEFAULT, "the CPU") if on_gpu else (OTHER, DEFAULT)
    report("compiling")
    compile_all(device, pictures)
    report("hits")
    geometries = {name: Geometry.of(make()) for name, make in MESHES.items()}
    on_cpu = {name: build(geometry, device="cpu") for name, geometry in geometries.items()}
    sets = {name: ray_sets(accel, rays) for name, accel in on_cpu.items()}
    for structure in structures() if on_gpu else [name for name in structures() if name != DEFAULT]:
        differ = dict[str, np.ndarray]()
        for mesh, geometry in geometries.items():
            accel = build(geometry, structure, device=device)
            n = TESTS // len(geometry) if structure == "brute_force" else rays
            differ |= {f"{mesh}, {kind}": compare(accel, on_cpu[mesh], each.part(slice(0, n))) for kind, each in sets[mesh].items()}
        yield row("hits", structure, against, differ)
    report("hard cases")
    differ = {}
    for name in HARD_CASES:
        case = generate(name, HARD_RAYS)
        if not case.refused:
            accel = build(case.geometry, other, device=device)
            differ[name] = compare(accel, build(case.geometry, device="cpu"), RaySet(name, case.origins, case.directions, case.t_max))
    yield row("hits", f"{other}, {len(differ)} hard cases", against, differ)
    for name, scene in pictures.items():
        report(f"picture of {name}")
        truth, pixels = (render(scene, device=each, accel=accel, **PICTURE).pixels.reshape(-1, 3)
                         for each, accel in (("cpu", other), (device, DEFAULT)))
        yield row("pixels", name, "the CPU" if on_gpu else OTHER, {"": different(truth, pixels)})


def compare(accel: Accelerator, truth: Accelerator, rays: RaySet) -> np.ndarray:
    """Return flags of the rays whose hits in `accel` and `truth` differ in a bit, (N,)."""
    found, expected = (each.any_hit(rays.origins, rays.directions, 0.0, rays.t_max) if rays.any_hit else
                       each.closest_hit(rays.origins, rays.directions, 0.0, rays.t_max) for each in (accel, truth))
    if not (isinstance(found, Hits) and isinstance(expected, Hits)):
        return different(np.asarray(found), np.asarray(expected))
    return np.logical_or.reduce([different(getattr(found, name), getattr(expected, name)) for name in ("t", "u", "v", "prim_id")])


def different(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return flags of the rows of two arrays whose bits differ, (N,)."""
    a, b = (np.ascontiguousarray(each).reshape(len(each), -1).view(np.uint8) for each in (a, b))
    return (a != b).any(axis=1)


def row(part: str, what: str, against: str, differ: dict[str, np.ndarray]) -> Row:
    """Return the row that counts the differences. differ: name of meshes or rays -> flags of their results that differ."""
    return Row(part=part, what=what, against=against, count=sum(map(len, differ.values())),
               differ=sum(int(each.sum()) for each in differ.values()),
               where=[place for place, each in differ.items() if each.any() and place])


def run(device: str, files: Sequence[Path] = (), rays: int = 20_000, report: Callable[[str], None] = lambda line: None) -> Row:
    """Compare a device with the CPU. Return the machine, the rows, and the number of results that differ."""
    start(device)
    pictures, rays = scenes(files), as_integer(rays, "rays", 1, 2**26)
    machine = machine_line(f"{thread_count(None)} threads for the CPU", f"Warp {wp.__version__}", platform(), device=device)
    compared = list[Row]()
    for each in rows(device, pictures, rays, report):
        compared.append(each)
        if each.differ:
            report(f"{each.part} of {each.what}: {each.differ} of {each.count} differ")
    return Row(machine=machine, differ=sum(each.differ for each in compared), rows=compared)


def text(result: Row) -> str:
    verdict = f"{result.differ or 'No'} result{'s' if result.differ > 1 else ''} differ{'' if result.differ > 1 else 's'}."
    return markdown([tabled(COLUMNS, result.rows, "Bits", f"Machine: {result.machine}\n\n{verdict}\n\n{LEGEND}")])
