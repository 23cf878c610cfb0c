"""The grid's builder: every cell lists the primitives in it, for any input."""


import numpy as np
import pytest

from tests.cell_cases import CASES, assert_damage_is_refused, points_of, triangles
from tests.refused import refused
from wrt.accel.scenes.build import build
from wrt.scene.shapes import icosphere


def lists(grid):
    """Return the cell (x, y, z) and the primitive of each reference."""
    cells = grid.data.cells.numpy()
    where = np.repeat(np.arange(len(cells)), cells["count"])
    assert np.array_equal(cells["first"], np.cumsum(cells["count"]) - cells["count"])
    n = np.array(grid.data.n)
    return np.stack([where % n[0], where // n[0] % n[1], where // (n[0] * n[1])], axis=1), grid.data.references.numpy()


def planes(layout, axis):
    """Return the planes between cells along an axis, rounded as the device rounds them."""
    lo, size, n = np.float32(layout.lo[axis]), np.float32(layout.size[axis]), layout.n[axis]
    return np.append(lo + np.arange(n, dtype=np.float32) * size, np.float32(layout.hi[axis]))


@pytest.mark.parametrize("case", CASES)
def test_points_of_a_primitive_are_in_cells_that_list_it(case):
    rng = np.random.default_rng(2)
    geometry = CASES[case](rng)
    grid = build(geometry, "grid", density=20.0)
    where, reference = lists(grid)
    listed = set(zip(*where.T.tolist(), reference.tolist(), strict=True))
    assert len(listed) == len(reference) == grid.stats.references  # No cell lists a primitive twice.
    layout = grid.data
    for _ in range(20):
        point = points_of(geometry, rng)
        cell = [np.clip(np.searchsorted(planes(layout, a), point[:, a], "right") - 1, 0, layout.n[a] - 1) for a in range(3)]
        assert all(entry in listed for entry in zip(*(c.tolist() for c in cell), range(len(point)), strict=True))


def test_primitives_of_a_cell_are_in_ascending_order_on_any_number_of_threads():
    corners = icosphere(5)
    one, two = build(corners, "grid", threads=1), build(corners, "grid", threads=2)
    assert np.array_equal(one.data.references.numpy(), two.data.references.numpy())
    assert np.array_equal(one.data.cells.numpy(), two.data.cells.numpy())
    where, reference = lists(one)
    same = (where[1:] == where[:-1]).all(axis=1)
    assert (np.diff(reference)[same] > 0).all() and same.sum() > 1000


def test_cells_that_only_the_box_of_a_triangle_meets_do_not_list_it():
    # A triangle across a cube of n^3 cells meets about as many cells as a plane does, not all cells.
    corners = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    grid = build(triangles(np.repeat(corners[None], 20, axis=0)), "grid", density=50.0)
    n = np.array(grid.data.n)
    assert (n == 10).all()
    where, _ = lists(grid)
    # In units of cells, the triangle is on x + y + z = n. A cell meets it if its lowest corner is below and its highest above.
    lowest = where.sum(axis=1)
    assert (lowest <= 10).all() and (lowest + 3 >= 10).all()
    x, y, z = np.indices((10, 10, 10))
    expected = ((x + y + z <= 10) & (x + y + z + 3 >= 10)).sum()  # Cells are closed and padded: cells that touch at a corner count.
    assert len(where) == 20 * expected


@pytest.mark.parametrize("density", [0.1, 1.0, 8.0])
def test_as_many_cells_as_the_density_asks_for(density):
    # Boxes have many shapes, some without height. The number of cells is as requested, and cells are almost cubes.
    rng = np.random.default_rng(3)
    for shape in ([1, 1, 1], [1, 2, 3], [30, 1, 1], [1, 0, 1], [20, 5, 0]):
        geometry = triangles((rng.uniform(-1.0, 1.0, (5000, 1, 3)) + 0.02 * rng.normal(size=(5000, 3, 3))) * shape)
        layout = build(geometry, "grid", density=density).data
        n = np.array(layout.n)
        assert 0.6 * density * 5000 <= n.prod() <= 1.001 * density * 5000
        size = np.array(layout.size)[n > 1]
        assert size.max() < 1.6 * size.min()


@pytest.mark.parametrize("density", [0.0, -1.0, 1e9, float("nan")])
def test_invalid_densities_are_refused(density):
    with refused("density"):
        build(icosphere(0), "grid", density=density)


@pytest.mark.parametrize(("name", "change"), [
    ("cells", lambda a: a["first"].__setitem__(5, -1)), ("cells", lambda a: a["count"].__setitem__(5, 1 << 30)),
    ("cells", lambda a: a["count"].__setitem__(5, -1)), ("references", lambda a: a.__setitem__(3, 320)),
    ("references", lambda a: a.__setitem__(3, -1)), ("n", lambda a: a.__setitem__(0, 100)), ("n", lambda a: a.__setitem__(1, -3)),
    ("size", lambda a: a.__setitem__(2, np.nan)), ("size", lambda a: a.__setitem__(2, 1.0)),
    ("lo", lambda a: a.__setitem__(0, 5.0)),
    ("pad", lambda a: a.__setitem__((), np.nan)), ("mailbox", lambda a: a.__setitem__((), 2)),
])
def test_arrays_from_a_file_are_checked(name, change):
    assert_damage_is_refused(build(icosphere(2), "grid"), name, change)
