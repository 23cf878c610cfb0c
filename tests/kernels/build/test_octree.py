"""The octree's builder: for any input, every leaf lists the primitives in it, and the tree stays within its limits."""


import numpy as np
import pytest

from tests.cell_cases import CASES, assert_damage_is_refused, points_of, triangles
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.scene.shapes import icosphere


def cells_of(octree):
    """Return the lowest and highest corner, (N, 3) float32, and the level of each node, by walking down from the root."""
    data, nodes = octree.data, octree.data.nodes.numpy()
    corner, level = np.zeros((len(nodes), 3), np.int64), np.zeros(len(nodes), np.int64)
    for i in np.nonzero(nodes["count"] < 0)[0]:
        octants = np.array([k for k in range(8) if -nodes["count"][i] >> k & 1])
        children = nodes["first"][i] + np.arange(len(octants))
        level[children] = level[i] + 1
        half = 1 << int(data.levels) - int(level[i]) - 1
        corner[children] = corner[i] + half * (octants[:, None] >> np.arange(3) & 1)
    lo, hi, size = np.array(data.lo, np.float32), np.array(data.hi, np.float32), np.float32(data.size)
    ends = corner, corner + (1 << int(data.levels) - level)[:, None]
    low, high = (np.minimum(lo + end.astype(np.float32) * size, hi) for end in ends)
    high[0] = hi
    return low, high, level


def listed(octree):
    """Return the leaf and the primitive of each reference."""
    nodes = octree.data.nodes.numpy()
    leaf = np.nonzero(nodes["count"] >= 0)[0]
    leaf = leaf[np.argsort(nodes["first"][leaf], kind="stable")]
    first, count = nodes["first"][leaf], nodes["count"][leaf]
    assert np.array_equal(first, np.cumsum(count) - count) and octree.stats.leaves == len(leaf)
    return np.repeat(leaf, count), octree.data.references.numpy()


@pytest.mark.parametrize("case", CASES)
def test_points_of_a_primitive_are_in_a_leaf_that_lists_it(case):
    rng = np.random.default_rng(2)
    geometry = CASES[case](rng)
    octree = build(geometry, "octree", max_leaf=2, by_cost=False, max_growth=30.0)
    leaf, primitive = listed(octree)
    lo, hi, level = cells_of(octree)
    assert octree.stats.references == len(leaf) == len(set(zip(leaf.tolist(), primitive.tolist(), strict=True)))
    assert octree.stats.depth == level.max() + 1 and (case in ("point", "huge", "subnormal", "none")) == (octree.stats.depth == 1)
    if len(geometry):
        assert (octree.data.nodes.numpy()["count"] != 0).all()  # Octants without primitives have no record.
    for _ in range(5):
        point = points_of(geometry, rng)[primitive]
        inside = ((lo[leaf] <= point) & (point <= hi[leaf])).all(axis=1)
        assert np.array_equal(np.unique(primitive[inside]), np.arange(len(geometry)))


def test_leaves_do_not_depend_on_threads_and_are_in_ascending_order():
    one, two = (build(icosphere(5), "octree", threads=threads) for threads in (1, 2))
    assert np.array_equal(one.data.nodes.numpy(), two.data.nodes.numpy())
    assert np.array_equal(one.data.references.numpy(), two.data.references.numpy())
    leaf, primitive = listed(one)
    same = leaf[1:] == leaf[:-1]
    assert (np.diff(primitive)[same] > 0).all() and same.sum() > 1000


def test_cells_that_only_the_box_of_a_triangle_meets_do_not_list_it():
    # A triangle across a cube, on x + y + z = 8 in units of the cells at level three.
    corners = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    octree = build(triangles(np.repeat(corners[None], 20, axis=0)), "octree", max_depth=3, by_cost=False, max_growth=1000.0)
    leaf, _ = listed(octree)
    lo, hi, _ = cells_of(octree)
    cells = np.unique(leaf)
    assert np.allclose(hi[cells] - lo[cells], 0.125, atol=1e-5)
    low = np.round(8.0 * lo[cells]).astype(int).sum(axis=1)
    assert ((low <= 8) & (low + 3 >= 8)).all()
    inside = ((low < 8) & (low + 3 > 8)).sum()
    x, y, z = np.indices((8, 8, 8))
    assert inside == ((x + y + z < 8) & (x + y + z + 3 > 8)).sum()


HEAPS = {
    "equal": np.broadcast_to([[0.0, 0.0, 0.1], [1.0, 0.0, 0.0], [0.0, 1.0, 0.2]], (50_000, 3, 3)),
    "tiny_equal": np.concatenate([np.broadcast_to([[0.3, 0.3, 0.3], [0.301, 0.3, 0.3], [0.3, 0.301, 0.3]], (50_000, 3, 3)),
                                  [[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 1.0]]]]),
    "progression": 3.0 ** np.arange(-30.0, 30.0)[:, None, None] * [[1.0, 0.0, 0.1], [1.0, 0.2, 0.0], [1.1, 0.0, 0.0]],
}


@pytest.mark.parametrize("heap", HEAPS)
@pytest.mark.parametrize("by_cost", [True, False])
def test_depth_and_size_are_bounded(heap, by_cost):
    geometry = triangles(HEAPS[heap])
    stats = build(geometry, "octree", by_cost=by_cost, max_leaf=1).stats
    assert stats.depth <= 21 and stats.references <= 16 * len(geometry) and stats.nodes <= 2 * stats.references
    if by_cost and heap == "equal":
        assert stats.references <= len(geometry)  # No split separates them.
    assert build(geometry, "octree", max_depth=2, by_cost=by_cost).stats.depth <= 3


def test_references_are_limited_in_every_part_alike():
    # Beside a soup that could use up all references, a ball's leaves are as small as without the soup.
    rng = np.random.default_rng(6)
    soup = triangles(rng.uniform(-1.0, 1.0, (2000, 1, 3)) + 0.3 * rng.normal(size=(2000, 3, 3)))
    ball = icosphere(3)
    both = Geometry(np.concatenate([ball.vertices * np.float32(0.001) + np.float32(5.0), soup.vertices]),
                    np.concatenate([ball.faces, soup.faces + len(ball.vertices)]), soup.spheres)
    largest = []
    for growth in (1.0, 4.0, 16.0):
        octree = build(both, "octree", max_growth=growth)
        leaf, primitive = listed(octree)
        assert octree.stats.references <= growth * len(both)
        largest.append(np.bincount(leaf[primitive < len(ball.faces)]).max())
    assert largest[0] >= 8 * largest[1] and largest[2] <= 12


@pytest.mark.parametrize("options", [{"max_leaf": 0}, {"max_depth": -1}, {"max_depth": 21}, {"max_growth": 0.5},
                                     {"max_growth": float("nan")}])
def test_invalid_options_are_refused(options):
    with refused(next(iter(options))):
        build(icosphere(0), "octree", **options)


@pytest.mark.parametrize(("name", "change"), [
    ("nodes", lambda a: a["first"].__setitem__(0, 0)), ("nodes", lambda a: a["first"].__setitem__(0, 1 << 30)),
    ("nodes", lambda a: a["count"].__setitem__(0, -256)), ("nodes", lambda a: a["count"].__setitem__(0, -1)),
    ("nodes", lambda a: a["count"].__setitem__(-1, 1 << 30)), ("nodes", lambda a: a["first"].__setitem__(-1, -1)),
    ("references", lambda a: a.__setitem__(3, 320)), ("references", lambda a: a.__setitem__(3, -1)),
    ("levels", lambda a: a.__setitem__((), 2)), ("levels", lambda a: a.__setitem__((), 21)),
    ("size", lambda a: a.__setitem__((), np.nan)), ("size", lambda a: a.__setitem__((), 1e-9)),
    ("extent", lambda a: a.__setitem__((), np.nan)), ("mailbox", lambda a: a.__setitem__((), 2)),
])
def test_arrays_from_a_file_are_checked(name, change):
    assert_damage_is_refused(build(icosphere(2), "octree"), name, change)
