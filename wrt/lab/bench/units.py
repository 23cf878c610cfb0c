"""`python -m wrt bench units`: what the default intersection tests cost beside the others, as ratios with their spread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrt.accel.build import build
from wrt.accel.geometry import Geometry
from wrt.accel.structures import ACCELERATORS
from wrt.io.mesh_file import load_mesh
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench.report import check_plan, table
from wrt.lab.bench.report import machine as machine_line
from wrt.lab.bench.timing import Quartiles, alternate, quartiles, shown
from wrt.lab.bench.visibility import terrain
from wrt.lab.hard_cases.common import soup, unit_vectors
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, teapot

ALONE = 64  # triangles without a structure: the triangle unit by itself


@dataclass(frozen=True)
class Plan:
    """meshes: files; none: a sphere, a terrain and a teapot. rays: of each kind; runs: of each unit, by turns."""

    meshes: tuple[Path, ...] = ()
    rays: int = 2**17
    runs: int = 9
    accel: str = "bvh"
    seed: int = 0

    def __post_init__(self) -> None:
        check_plan(self, {"structure": ([self.accel], ACCELERATORS)}, rays=(1, 2**28), runs=(1, 1000))


@dataclass(frozen=True)
class Price:
    """One unit on one mesh with one kind of rays, on one thread. price: how many times as long the default takes, run by run
    (quartiles), and lowest and highest; above 1 the default is dearer."""

    mesh: str
    triangles: int
    rays: str
    unit: str
    mrays: Quartiles
    price: Quartiles
    extremes: tuple[float, float]
    bytes_per_triangle: float


def run(plan: Plan, progress: Callable[[str], None] = lambda line: None) -> list[Price]:
    """Every triangle test with the default boxes, then every box test with the default triangles; triangle tests alone last."""
    rows = []
    triangles = [{"triangle": name} for name in RAY_TRIANGLE]
    boxes = [{"box": name} for name in list(RAY_AABB)[1:]]
    for name, geometry in surfaces(plan):
        for kind in ("primary", "random"):
            progress(f"{name}, {kind} rays")
            rows += _measure(plan, (name, kind), geometry, [(plan.accel, options) for options in triangles + boxes])
    rng = np.random.default_rng(plan.seed)
    few = soup(rng.uniform(-1.0, 1.0, (ALONE, 1, 3)) + 0.3 * rng.normal(size=(ALONE, 3, 3)))
    progress("triangle tests alone")
    return rows + _measure(plan, (f"{ALONE} triangles, no structure", "random"), few,
                           [("brute_force", options) for options in triangles])


def surfaces(plan: Plan) -> Iterator[tuple[str, Geometry]]:
    """Names and geometries."""
    meshes: list[tuple[str, Mesh]] = [(path.name, load_mesh(path)) for path in plan.meshes]
    if not meshes:
        meshes = [("sphere", icosphere(6)), ("terrain", terrain(300)), ("teapot", teapot(64))]
    for name, mesh in meshes:
        yield name, Geometry.of(mesh)


def rays_at(geometry: Geometry, kind: str, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (n, 3) float32. "primary": from one point through the pixels of a square picture that the mesh
    fills, row by row; "random": from all around at points in the mesh's box, in no order."""
    corners = geometry.vertices[geometry.faces].reshape(-1, 3).astype(np.float64)
    low, high = corners.min(axis=0), corners.max(axis=0)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    rng = np.random.default_rng(seed)
    if kind == "random":
        origins = center + 2.0 * radius * unit_vectors(rng, n)
        return origins.astype(np.float32), (rng.uniform(low, high, (n, 3)) - origins).astype(np.float32)
    forward = np.array([-0.5, -0.6, -0.62])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    side = int(np.ceil(np.sqrt(n)))
    i = np.arange(n)
    x, y = (0.6 * radius * (2.0 * (index + 0.5) / side - 1.0) for index in (i % side, i // side))
    directions = 3.0 * radius * forward + x[:, None] * right + y[:, None] * np.cross(right, forward)
    return np.broadcast_to(center - 3.0 * radius * forward, (n, 3)).astype(np.float32), directions.astype(np.float32)


def _measure(plan: Plan, place: tuple[str, str], geometry: Geometry, units: list[tuple[str, dict[str, str]]]) -> list[Price]:
    """All units by turns; the first is the default."""
    name, kind = place
    origins, directions = rays_at(geometry, kind, plan.rays, plan.seed)
    jobs: dict[str, Any] = {}
    sizes = {}
    for accel, options in units:
        structure = build(geometry, accel, threads=1, **options)
        unit = " ".join(f"{value}{' boxes' if key == 'box' else ''}" for key, value in options.items())
        jobs[unit] = partial(structure.closest_hit, origins, directions, threads=1)
        sizes[unit] = structure.stats.bytes / len(geometry)
    seconds = alternate(jobs, plan.runs)
    default = seconds[next(iter(jobs))]
    return [Price(name, len(geometry), kind, unit, quartiles(plan.rays / taken / 1e6), quartiles(default / taken),
                  (float((default / taken).min()), float((default / taken).max())), sizes[unit])
            for unit, taken in seconds.items()]


def machine() -> str:
    return machine_line("one used")


def text(rows: list[Price], plan: Plan, told: str) -> str:
    """Markdown: the machine, how to repeat, and the table."""
    head = ("mesh", "triangles", "rays", "unit", "Mray/s", "default's price", "from", "to", "B/tri")
    lines = [(row.mesh, f"{row.triangles}", row.rays, row.unit, shown(row.mrays), shown(row.price), f"{row.extremes[0]:.3g}",
              f"{row.extremes[1]:.3g}", f"{row.bytes_per_triangle:.0f}") for row in rows]
    command = " ".join(["python -m wrt bench units", *map(str, plan.meshes), f"--rays {plan.rays}", f"--runs {plan.runs}"])
    return (f"# The price of the default intersection tests\n\nMachine: {told}\n\nTo repeat: `{command}`\n\n"
            f"Structure {plan.accel}, one thread, {plan.runs} runs of each by turns: median [quartiles], lowest and highest. The "
            "default is watertight triangles in conservative boxes; its price is how many times as long it takes as the unit of "
            f"the row, run by run.\n\n{table(head, lines)}\n")
