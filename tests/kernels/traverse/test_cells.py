"""Hard cases of walks through cells: far and grazing rays, rays in planes and through corners of cells. The octree visits few nodes."""


import numpy as np
import pytest

from tests.kernel_tools import rounded, unit  # isort: skip (starts Warp)

from tests.cell_cases import assert_rays_at_corners_agree, assert_same, grazing, soup
from tests.rewalk import PRIMITIVES
from wrt.accel.scenes.build import build
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere


def corner_planes(grid):
    """Return the coordinates of the planes between cells, one array for each axis."""
    layout = grid.data
    return [np.append(np.float32(layout.lo[a]) + np.arange(layout.n[a], dtype=np.float32) * np.float32(layout.size[a]),
                      np.float32(layout.hi[a])) for a in range(3)]


@pytest.mark.parametrize("mailbox", [True, False])
@pytest.mark.parametrize("name", ["grid", "octree"])
def test_rays_in_faces_and_through_edges_and_corners_of_cells(name, mailbox):
    rng = np.random.default_rng(1)
    geometry = soup(rng)
    accel = build(geometry, name, mailbox=mailbox)
    if name == "grid":
        size, corner = np.array(accel.data.size), np.stack([rng.choice(plane, 20_000) for plane in corner_planes(accel)], axis=1)
    else:
        lo, hi = np.array(accel.data.lo, np.float32), np.array(accel.data.hi, np.float32)
        size = np.float32(accel.data.size) * np.float32(1 << int(accel.data.levels) - 4)
        corner = np.minimum(lo + rng.integers(0, 17, (20_000, 3)).astype(np.float32) * size, hi)
    assert_rays_at_corners_agree(accel, geometry, corner, size, rng)


def test_a_hit_in_a_later_cell_does_not_end_the_walk():
    # A long triangle begins in the first cell and is hit in the last cell. A short triangle between them is nearer.
    long = [[-1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [9.0, 0.0, 9.0]]
    short = [[6.0, -1.0, 5.0], [6.0, 1.0, 5.0], [6.0, 0.0, 9.0]]
    rest = [[[x, 20.0, z], [x + 1.0, 20.0, z], [x, 20.0, z + 1.0]] for x in range(9) for z in range(9)]
    vertices = np.array([long, short, *rest]).reshape(-1, 3)
    mesh = Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))
    grid = build(mesh, "grid", density=50.0)
    hits = grid.closest_hit([[-1.0, 0.0, 7.0]], [[1.0, 0.0, 0.0]], counters=True)
    assert hits.prim_id[0] == 1 and hits.t[0] == 7.0


def test_rays_in_planes_visit_the_cells_that_the_box_test_enters():
    rng = np.random.default_rng(2)
    geometry = soup(rng, 200)
    octree = build(geometry, "octree", max_leaf=2)
    lo, size = np.array(octree.data.lo, np.float32), np.float32(octree.data.size)
    corner = lo + (rng.integers(0, 17, (80, 3)) * (1 << int(octree.data.levels) - 4)).astype(np.float32) * size
    direction = rng.choice([-1.0, -0.0, 0.0, 1.0], (80, 3))
    direction[~direction.any(axis=1), 0] = 1.0
    origin = rounded(corner - 0.5 * direction)
    counters = octree.closest_hit(origin, direction, trace=True).counters
    low, high = cells(octree)
    assert counters.nodes.mean() > 10
    for i in range(len(origin)):
        fetched = slice(counters.first[i], counters.first[i + 1])
        node = counters.address[fetched][counters.address[fetched] < PRIMITIVES] // octree.data.nodes.numpy().itemsize
        assert len(set(node)) == len(node)  # No node is visited twice.
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = [(plane[node] - origin[i]) / direction[i] for plane in (low - 1e-5, high + 1e-5)]
        enter, leave = np.fmax.reduce(np.minimum(*ends), axis=1), np.fmin.reduce(np.maximum(*ends), axis=1)
        assert (np.maximum(enter, -1e-5) <= leave).all()


def cells(octree):
    """Return the lowest and the highest corner of every node's cell, (N, 3) float64 each."""
    nodes, n = octree.data.nodes.numpy(), 1 << int(octree.data.levels)
    low, size = np.zeros((len(nodes), 3)), np.full(len(nodes), float(n))
    for i, (first, count) in enumerate(zip(nodes["first"], nodes["count"], strict=True)):  # A node precedes its children.
        octants = [k for k in range(8) if count < 0 and -count >> k & 1]
        for child, k in enumerate(octants, first):
            size[child] = size[i] / 2
            low[child] = low[i] + size[child] * (k >> np.arange(3) & 1)
    begin, step = np.array(octree.data.lo, np.float64), float(octree.data.size)
    return begin + step * low, begin + step * (low + size[:, None])


@pytest.mark.parametrize("name", ["grid", "octree"])
def test_mailboxing_saves_tests_and_no_cells(name):
    rng = np.random.default_rng(4)
    geometry = soup(rng, 300, 0.6)
    origin = rounded(4.0 * unit(rng.normal(size=(2000, 3))))
    direction = rounded(rng.uniform(-0.5, 0.5, (2000, 3)) - origin)
    with_it, without = (build(geometry, name, mailbox=m).closest_hit(origin, direction, counters=True) for m in (True, False))
    assert_same(with_it, without)
    assert np.array_equal(with_it.counters.nodes, without.counters.nodes)
    assert (with_it.counters.primitives <= without.counters.primitives).all()
    assert with_it.counters.primitives.sum() < 0.95 * without.counters.primitives.sum()


def test_the_walk_of_a_grid_ends_at_the_hit_and_at_t_max():
    ball = build(icosphere(4), "grid")
    outside = ball.closest_hit([[-5.0, 0.01, 0.02]], [[1.0, 0.0, 0.0]], counters=True).counters
    through = ball.closest_hit([[-0.5, 0.01, 0.02]], [[1.0, 0.0, 0.0]], counters=True).counters
    n = ball.data.n[0]
    assert outside.nodes[0] <= 3 and n / 2 < through.nodes[0] <= n
    near = ball.closest_hit([[-0.5, 0.01, 0.02]], [[1.0, 0.0, 0.0]], 0.0, 0.001, counters=True).counters
    assert near.nodes[0] <= 2


def test_the_walk_ends_at_the_hit_and_at_t_max_and_passes_over_empty_space():
    ball = build(icosphere(4), "octree")
    depth = ball.stats.depth
    outside = ball.closest_hit([[-5.0, 0.01, 0.02]], [[1.0, 0.0, 0.0]], counters=True).counters
    through = ball.closest_hit([[-0.5, 0.01, 0.02]], [[1.0, 0.0, 0.0]], counters=True).counters
    assert outside.nodes[0] <= depth + 2 and through.nodes[0] <= 2 * depth and outside.leaves[0] <= 2
    near = ball.closest_hit([[-0.5, 0.01, 0.02]], [[1.0, 0.0, 0.0]], 0.0, 0.001, counters=True).counters
    assert near.leaves[0] == 0 and near.nodes[0] <= 3


# --- far and grazing rays, whose rounding errors are as large as cells -------------------------------------------------


FINE = {"grid": {"density": 100.0}, "octree": {"max_leaf": 1, "by_cost": False, "max_growth": 100.0}, "kdtree": {"cost_traversal": 0.1},
        "bsp": {"cost_intersection": 10.0}}


@pytest.mark.parametrize("name", FINE)
@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6, 1e8])
def test_far_origins(distance, name):
    # From a distance of 1e6 on, rounding is as wide as a cell. The walk then visits more cells, up to all cells.
    rng = np.random.default_rng(2)
    geometry = soup(rng, size=0.3)
    cells, brute = build(geometry, name), build(geometry, "brute_force")
    away = distance * unit(rng.normal(size=(3000, 3)))
    away[::5] *= [1.0, 0.0, 0.0]
    origin = rounded(rng.uniform(-1.0, 1.0, (3000, 3)) + away)
    direction = rounded(rng.uniform(-1.0, 1.0, (3000, 3)) - origin)
    direction[~direction.any(axis=1), 0] = 1.0
    expected = brute.closest_hit(origin, direction)
    assert_same(cells.closest_hit(origin, direction), expected)
    assert (expected.prim_id >= 0).sum() > 300


@pytest.mark.parametrize("name", FINE)
def test_grazing_rays_find_the_same(name):
    geometry, origin, direction = grazing(np.random.default_rng(3), 50_000)
    cells, brute = build(geometry, name, **FINE[name]), build(geometry, "brute_force")
    expected = brute.closest_hit(origin, direction)
    assert (expected.prim_id >= 0).sum() > 5000
    assert_same(cells.closest_hit(origin, direction), expected)
    hit = expected.prim_id >= 0
    at = expected.t[hit]
    assert_same(cells.closest_hit(origin[hit], direction[hit], at, at), brute.closest_hit(origin[hit], direction[hit], at, at))
