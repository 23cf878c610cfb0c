"""The k-d tree's builder: its trees keep their invariants for any input, and its splits are the cheapest."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.kernel_tools import rounded
from tests.kernels.build.test_bvh2 import CASES, geometry_of
from tests.kernels.build.test_clip import polygon_in
from tests.kernels.traverse.test_common import GEOMETRIES, assert_same_hits, rays_for
from tests.refused import refused
from wrt.accel.cells.common import bounds_of
from wrt.accel.cells.trees import KdOptions
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.kernels.traverse.plane_layouts import KD_LEAF as LEAF
from wrt.kernels.traverse.planes import STACK_SIZE
from wrt.scene.shapes import icosphere, torus


def make(geometry, threads=1, **options):
    built = build(geometry, "kdtree", threads=threads, **options).built
    return SimpleNamespace(**built.arrays, order=built.order, depth=built.depth, leaves=built.leaves, cost=built.sah_cost)


def cells(tree):
    """Yield (lo, hi, depth, word & 3, members or None) of each node once, the root first."""
    met = np.zeros(len(tree.nodes), int)
    todo = [(0, tree.lo.astype(np.float64), tree.hi.astype(np.float64), 1)]
    while todo:
        index, lo, hi, depth = todo.pop()
        met[index] += 1
        split, word = tree.nodes[index]
        axis, first = int(word) & 3, int(word) >> 2
        if axis == LEAF:
            yield lo, hi, depth, axis, tree.order[first : first + int(split)]
            continue
        yield lo, hi, depth, axis, None
        assert lo[axis] < split < hi[axis]
        left_hi, right_lo = hi.copy(), lo.copy()
        left_hi[axis] = right_lo[axis] = split
        todo += [(first + 1, right_lo, hi, depth + 1), (first, lo, left_hi, depth + 1)]
    assert (met == 1).all()


def check_tree(geometry, tree, max_depth, growth):
    """Check that a leaf holds each primitive that reaches into it once, and no primitive whose padded box is outside."""
    box_lo, box_hi = bounds_of(geometry)
    size = np.maximum(np.abs(box_lo), np.abs(box_hi)).max(axis=1, keepdims=True).astype(np.float64)
    margin = 1e-5 * size
    corners = geometry.vertices[geometry.faces].astype(np.float64)
    deepest = leaves = references = 0
    left_out = []
    for lo, hi, depth, _, members in cells(tree):
        deepest = max(deepest, depth)
        if members is None:
            continue
        leaves, references = leaves + 1, references + len(members)
        assert len(np.unique(members)) == len(members)
        near = (box_lo < hi).all(axis=1) & (box_hi > lo).all(axis=1)
        assert (box_lo[members] < hi + margin[members]).all() and (box_hi[members] > lo - margin[members]).all()
        left_out += [(i, lo, hi) for i in np.setdiff1d(np.nonzero(near)[0], members)]
    for i, lo, hi in left_out[:: 1 + len(left_out) // 500]:
        assert i < len(corners) and not len(polygon_in(corners[i], lo, hi)), f"{i} is missing in a leaf"
    assert (deepest, leaves, references) == (tree.depth, tree.leaves, len(tree.order))
    assert deepest <= max_depth + 1 <= STACK_SIZE + 1
    assert np.array_equal(np.unique(tree.order), np.arange(len(geometry)))
    assert references <= growth * len(geometry) + 64


OPTIONS = [{"max_leaf": 8}, {"cost_intersection": 20.0, "max_growth": 3.0}]


@pytest.mark.parametrize("kind, options", [(kind, {}) for kind in GEOMETRIES if kind != "none"] + [
    (kind, options) for kind in ("soup", "flat", "mixed") for options in OPTIONS], ids=str)
def test_leaves_hold_all_that_reaches_into_them(kind, options):
    geometry = GEOMETRIES[kind](np.random.default_rng(1))
    chosen = KdOptions(**options)
    check_tree(geometry, make(geometry, **options), chosen.depth(len(geometry)), chosen.max_growth)


@pytest.mark.parametrize("case", CASES)
def test_boxes_of_all_kinds(case):
    lo, hi = CASES[case](np.random.default_rng(1))
    geometry = geometry_of(lo, hi)
    chosen = KdOptions()
    check_tree(geometry, make(geometry), chosen.depth(len(geometry)), chosen.max_growth)


def half_area(e):
    return e[..., 0] * e[..., 1] + e[..., 1] * e[..., 2] + e[..., 2] * e[..., 0]


@pytest.mark.parametrize("kind", ["soup", "long_thin", "flat", "mixed"])
def test_the_cost_is_the_sum_over_the_cells(kind):
    geometry = GEOMETRIES[kind](np.random.default_rng(2))
    tree = make(geometry)
    total = sum(half_area(hi - lo) * (1 if members is None else len(members)) for lo, hi, _, _, members in cells(tree))
    assert tree.cost == pytest.approx(total / half_area(tree.hi.astype(np.float64) - tree.lo), rel=1e-9)


def expected_cost(tree, options, plane, geometry):
    """Return the cost of a split of the root by the primitives' boxes, by definition, without a sweep."""
    lo, hi = geometry.bounds()
    axis, position = plane
    left, right = np.count_nonzero(lo[:, axis] < position), np.count_nonzero(hi[:, axis] > position)
    cell_lo, cell_hi = tree.lo.astype(np.float64), tree.hi.astype(np.float64)
    left_hi, right_lo = cell_hi.copy(), cell_lo.copy()
    left_hi[axis] = right_lo[axis] = position
    cost = half_area(left_hi - cell_lo) * left + half_area(cell_hi - right_lo) * right
    cost = options.cost_traversal + options.cost_intersection * cost / half_area(cell_hi - cell_lo)
    return cost * (1.0 - options.empty_bonus if left == 0 or right == 0 else 1.0)


@pytest.mark.parametrize("seed", range(6))
def test_the_split_is_the_cheapest_of_all_faces(seed):
    rng = np.random.default_rng(seed)
    center, size = rng.uniform(-1.0, 1.0, (60, 3)) * [1.0, 2.0, 3.0], 0.2 * rng.random((60, 3))
    geometry = geometry_of(rounded(center - size), rounded(center + size))
    lo, hi = geometry.bounds()
    options = KdOptions(max_depth=1)
    tree = make(geometry, max_depth=1)
    faces = [(axis, x) for axis in range(3) for x in np.concatenate([lo[:, axis], hi[:, axis]]).tolist()
             if tree.lo[axis] < x < tree.hi[axis]]
    cheapest = min(expected_cost(tree, options, plane, geometry) for plane in faces)
    chosen = int(tree.nodes["word"][0]) & 3, float(tree.nodes["split"][0])
    assert expected_cost(tree, options, chosen, geometry) == pytest.approx(cheapest, rel=1e-12)


def test_empty_space_is_cut_off():
    # Eight clusters are in the corners of a cell.
    rng = np.random.default_rng(3)
    center = rng.random((400, 3)) + 10.0 * rng.integers(0, 2, (400, 3))
    tree = make(geometry_of(rounded(center - 0.01), rounded(center + 0.01)))
    empty = sum(float(np.prod(hi - lo)) for lo, hi, _, _, members in cells(tree) if members is not None and len(members) == 0)
    assert empty > 0.95 * float(np.prod(tree.hi.astype(np.float64) - tree.lo))


def test_clipping_leaves_fewer_references():
    geometry = GEOMETRIES["soup"](np.random.default_rng(4))
    clipped, boxes = make(geometry), make(geometry, clip=False)
    assert len(clipped.order) < 0.8 * len(boxes.order) and clipped.cost < boxes.cost


def test_one_and_two_threads_build_the_same_tree():
    geometry = Geometry.of(torus(segments=96, tube_segments=32))  # More than KD_SAMPLED, and than KEEP.
    one, two = (make(geometry, threads) for threads in (1, 2))
    assert np.array_equal(one.nodes, two.nodes) and np.array_equal(one.order, two.order) and one.cost == two.cost
    check_tree(geometry, one, KdOptions().depth(len(geometry)), 16.0)


@pytest.mark.parametrize("options", [
    {"max_leaf": 4}, {"clip": False}, {"empty_bonus": 1.0}, {"max_growth": 1.0},
    {"max_depth": 0}, {"max_depth": STACK_SIZE, "cost_traversal": 0.0}], ids=str)
@pytest.mark.parametrize("kind", ["mixed", "progression", "flat"])
def test_options_change_no_answer(kind, options):
    rng = np.random.default_rng(6)
    geometry = GEOMETRIES[kind](rng)
    origin, direction = rays_for(geometry, rng, 3000)
    expected = build(geometry, "brute_force").closest_hit(origin, direction)
    assert_same_hits(build(geometry, "kdtree", **options).closest_hit(origin, direction), expected)


@pytest.mark.parametrize("options, message", [
    ({"max_leaf": 0}, ("max_leaf", "must be 1")), ({"max_depth": 65}, ("max_depth", "0 to 64")),
    ({"max_depth": "deep"}, ("max_depth", "int")), ({"max_depth": True}, ("max_depth", "int")),
    ({"empty_bonus": 1.5}, ("empty_bonus", "0 to 1")), ({"cost_traversal": float("nan")}, ("cost_traversal",)),
    ({"max_growth": 0.5}, ("max_growth", "must be 1")),
    ({"clip": "yes"}, ("clip", "bool")), ({"builder": "sah"}, ("builder", "option of kdtree"))])
def test_invalid_options_are_refused(options, message):
    with refused(*message):
        build(icosphere(0), "kdtree", **options)
