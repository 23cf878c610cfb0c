"""Hard cases of the grid's walk: rays in the planes and through the corners of cells, far rays, and grazing rays."""


import numpy as np
import pytest

from tests.kernel_tools import rounded, unit  # isort: skip (starts Warp)

from tests.cell_cases import assert_rays_at_corners_agree, assert_same, soup
from wrt.accel.scenes.build import build
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere


def corner_planes(grid):
    """Return the coordinates of the planes between cells, one array for each axis."""
    layout = grid.data
    return [np.append(np.float32(layout.lo[a]) + np.arange(layout.n[a], dtype=np.float32) * np.float32(layout.size[a]),
                      np.float32(layout.hi[a])) for a in range(3)]


@pytest.mark.parametrize("mailbox", [True, False])
def test_rays_in_faces_and_through_edges_and_corners_of_cells(mailbox):
    rng = np.random.default_rng(1)
    geometry = soup(rng)
    grid = build(geometry, "grid", mailbox=mailbox)
    corner = np.stack([rng.choice(plane, 20_000) for plane in corner_planes(grid)], axis=1)
    assert_rays_at_corners_agree(grid, geometry, corner, np.array(grid.data.size), rng)


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


def test_mailboxing_saves_tests_and_no_cells():
    rng = np.random.default_rng(4)
    geometry = soup(rng, 300, 0.6)
    origin = rounded(4.0 * unit(rng.normal(size=(2000, 3))))
    direction = rounded(rng.uniform(-0.5, 0.5, (2000, 3)) - origin)
    with_it, without = (build(geometry, "grid", mailbox=m).closest_hit(origin, direction, counters=True) for m in (True, False))
    assert_same(with_it, without)
    assert np.array_equal(with_it.counters.nodes, without.counters.nodes)
    assert (with_it.counters.primitives <= without.counters.primitives).all()
    assert with_it.counters.primitives.sum() < 0.95 * without.counters.primitives.sum()


def test_the_walk_ends_at_the_hit_and_at_t_max():
    ball = build(icosphere(4), "grid")
    outside = ball.closest_hit([[-5.0, 0.01, 0.02]], [[1.0, 0.0, 0.0]], counters=True).counters
    through = ball.closest_hit([[-0.5, 0.01, 0.02]], [[1.0, 0.0, 0.0]], counters=True).counters
    n = ball.data.n[0]
    assert outside.nodes[0] <= 3 and n / 2 < through.nodes[0] <= n
    near = ball.closest_hit([[-0.5, 0.01, 0.02]], [[1.0, 0.0, 0.0]], 0.0, 0.001, counters=True).counters
    assert near.nodes[0] <= 2
