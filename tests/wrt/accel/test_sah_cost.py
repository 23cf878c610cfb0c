"""The SAH cost equals the mean number of steps of random lines, as counted by the traversal itself.

A uniformly random line through a convex region meets a convex part of it with a probability equal to the ratio of surface areas.
(Crofton; MacDonald and Booth 1990, "Heuristics for ray tracing using space subdivision".) So the mean number of inner nodes and leaf
primitives on a line is `stats.sah_cost`, if traversal and builder agree on every region.

The lines are a scrambled Sobol sequence, and sigma is the standard error of as many independent lines. The error of the sequence is
much smaller, so that it does not exceed 2 sigma by chance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import data_path
from wrt.accel.bvh.builders import BVH_BUILDERS
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import Counters
from wrt.accel.scenes.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.scene.shapes import icosphere, torus

REAL = ["small/suzanne.obj", "small/legocar.obj", "medium/stanford_bunny.ply", "medium/sponza_dabrovic.obj",
        "large/dragon_871k.ply"]
BATCH = 1 << 16


def lines_through_box(accel: Accelerator, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return n uniformly random lines through the box of the geometry, as rays that begin before the box. n: a power of 2. A line has
    a random point on the box's surface and a cosine-distributed direction inwards."""
    from scipy.stats import qmc

    lo, hi = accel.geometry.bounds()
    lo, hi = lo.min(axis=0).astype(np.float64), hi.max(axis=0).astype(np.float64)
    which, x, y, radius, angle = qmc.Sobol(5, seed=seed).random(n).T
    e = hi - lo
    areas = e[[1, 2, 0]] * e[[2, 0, 1]]
    face = np.minimum(np.searchsorted(np.cumsum(np.repeat(areas, 2)) / (2.0 * areas.sum()), which, side="right"), 5)
    axis, upper = face // 2, face % 2
    point, direction = np.empty((n, 3)), np.empty((n, 3))
    row, side, other = np.arange(n), (axis + 1) % 3, (axis + 2) % 3
    point[row, axis] = np.where(upper == 1, hi[axis], lo[axis])
    point[row, side], point[row, other] = lo[side] + x * e[side], lo[other] + y * e[other]
    direction[row, axis] = np.where(upper == 1, -1.0, 1.0) * np.sqrt(1.0 - radius)
    direction[row, side] = np.sqrt(radius) * np.cos(2.0 * np.pi * angle)
    direction[row, other] = np.sqrt(radius) * np.sin(2.0 * np.pi * angle)
    origin = point - direction * np.linalg.norm(e)
    return origin.astype(np.float32), direction.astype(np.float32)


@dataclass(frozen=True)
class Case:
    """How to test a structure. options: its options. inner: function from counters to the number of inner nodes. lines: function that
    makes lines through the root's region, if that is not the box of the geometry. share: lowest and highest mean number of steps, as
    shares of the SAH cost. If a node's region is not in its parent's, the cost is only a bound, because a line may meet a node but not its
    parent. The cost of a BSP tree is an estimate by the boxes of cells, and that of 14-DOPs is the cost of their boxes."""

    options: dict[str, Any] = field(default_factory=dict)
    inner: Callable[[Counters], np.ndarray] = lambda counters: counters.nodes
    lines: Callable[[Accelerator, int, int], tuple[np.ndarray, np.ndarray]] = lines_through_box
    share: tuple[float, float] = (1.0, 1.0)


# Structures that are not listed are tested with their default options.
CASES: dict[str, list[Case]] = {
    "brute_force": [Case(lines=lambda accel, n, seed: lines_through_box(accel, 64, seed))],  # each line has the same number of steps
    "bvh2_sphere": [Case(share=(0.8, 1.0))],
    "bvh2_kdop": [Case(share=(0.6, 1.0))],
    "bvh2": [Case({"builder": builder}) for builder in BVH_BUILDERS],
    # Without mailbox, because the SAH cost counts a primitive in every cell.
    "grid": [Case({"mailbox": False})],
    "octree": [Case({"mailbox": False})],
    "bsp": [Case(inner=lambda counters: counters.nodes - counters.leaves, share=(0.8, 1.3))],
    "kdtree": [Case(options, inner=lambda counters: counters.nodes - counters.leaves)  # leaves count as nodes, too
               for options in ({}, {"clip": False, "empty_bonus": 0.8}, {"max_leaf": 8})],
}
ALL = [pytest.param(name, case, id="-".join([name, *map(str, case.options.values())]))
       for name in sorted({cls.name for cls in ACCELERATORS.values()}) for case in CASES.get(name, [Case()])]


def let_through(accel: Accelerator) -> None:
    """Replace all primitives by primitives that no ray hits, so that every ray traverses the structure to its end."""
    records = accel.data.primitives.numpy()
    if records.dtype.names is None:
        records[...] = np.nan
    for name in records.dtype.names or ():
        if records.dtype[name].base.kind == "f":
            records[name] = np.nan
    accel.data.primitives.assign(records)


def check(geometry: Geometry, name: str, case: Case, n: int, most: float) -> None:
    """Check that the mean of n lines is the SAH cost within 2 sigma, and that sigma is at most the share `most` of the cost."""
    try:
        accel = build(geometry, name, **case.options)
    except InputError as error:
        pytest.skip(str(error))  # a BSP tree has a limit on size
    if np.isnan(accel.stats.sah_cost):
        pytest.skip(f"{name} tells no SAH cost")
    origins, directions = case.lines(accel, n, 7)
    let_through(accel)
    n = len(origins)
    steps = np.zeros(n)
    for first in range(0, n, BATCH):
        hits = accel.closest_hit(origins[first : first + BATCH], directions[first : first + BATCH], counters=True)
        assert hits.counters is not None and (hits.prim_id < 0).all()
        steps[first : first + BATCH] = case.inner(hits.counters) + hits.counters.primitives
    cost, mean, sigma = accel.stats.sah_cost, steps.mean(), steps.std(ddof=1) / np.sqrt(n)
    told = f"SAH cost {cost:.4f}, measured {mean:.4f}, sigma {sigma:.4f} ({(mean - cost) / max(sigma, 1e-30):+.2f} sigma)"
    print(told)
    assert sigma <= most * cost, told
    low, high = case.share
    assert low * cost - 2.0 * sigma - 1e-6 * cost <= mean <= high * cost + 2.0 * sigma + 1e-6 * cost, told


def soup() -> Geometry:
    """Return triangles of all sizes and shapes, some of them axis-aligned."""
    rng = np.random.default_rng(3)
    corners = rng.uniform(-1.0, 1.0, (500, 1, 3)) + 10.0 ** rng.uniform(-3.0, -0.3, (500, 1, 1)) * rng.normal(size=(500, 3, 3))
    corners[::7, :, 0] = corners[::7, :1, 0]
    return Geometry(corners.reshape(-1, 3).astype(np.float32), np.arange(1500, dtype=np.int32).reshape(-1, 3),
                    np.zeros((0, 4), np.float32))


GEOMETRIES = {"icosphere": lambda: Geometry.of(icosphere(3)), "torus": lambda: Geometry.of(torus()), "soup": soup}


@pytest.mark.parametrize("kind", GEOMETRIES)
@pytest.mark.parametrize("name, case", ALL)
def test_random_lines_take_as_many_steps_as_the_sah_says(name: str, case: Case, kind: str) -> None:
    check(GEOMETRIES[kind](), name, case, 1 << 15, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("mesh", REAL)
@pytest.mark.parametrize("name, case", ALL)
def test_random_lines_on_real_meshes(name: str, case: Case, mesh: str) -> None:
    check(Geometry.of(wrt.load_mesh(data_path(f"meshes/{mesh}"))), name, case, 1 << 18, 0.005)
