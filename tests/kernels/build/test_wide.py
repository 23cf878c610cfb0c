"""The collapse of binary trees into wide trees: the trees keep their invariants, and no other collapse is cheaper."""

from functools import cache

import numpy as np
import pytest

from tests.kernels.build.test_bvh2 import geometry_of
from tests.kernels.traverse.test_common import GEOMETRIES, assert_same_hits, rays_for
from wrt.accel.bvh.builders import BVH_BUILDERS, BvhOptions, build_binary
from wrt.accel.bvh.wide_tree import collapse, stack_need
from wrt.accel.scenes.build import build
from wrt.kernels.wide.layout import STACK_SIZE
from wrt.scene.shapes import icosphere


def leaf(reference):
    """Return the first row and the number of primitives of a leaf reference."""
    return (-1 - reference) // 64, (-1 - reference) % 64 + 1


def check_tree(tree, geometry, width, max_leaf):
    """Check that each primitive is in a leaf, all rows of a leaf but the last are full, boxes are tight, and totals are right. After
    spatial splits, boxes need only be within the primitives' boxes."""
    lo, hi = geometry.bounds()
    assert np.array_equal(np.unique(tree.order[tree.order >= 0]), np.arange(len(lo)))
    split = (tree.order >= 0).sum() > len(lo)
    visited = np.zeros(len(tree.children), int)
    rows = np.zeros(len(tree.order), int)
    leaves = deepest = 0
    todo = [(0, 1)]
    while todo:
        index, level = todo.pop()
        visited[index] += 1
        deepest = max(deepest, level)
        for k in range(width):
            reference, low, high = int(tree.children[index, k]), tree.lo[index, k], tree.hi[index, k]
            if reference == 0:
                assert (low == np.inf).all() and (high == -np.inf).all()
            elif reference < 0:
                first, count = leaf(reference)
                n = -(-count // width)
                rows[first : first + n] += 1
                ids = tree.order[first : first + n].reshape(-1)
                assert count <= max_leaf and (ids[:count] >= 0).all() and (ids[count:] == -1).all()
                leaves += 1
                if not split:
                    assert np.array_equal(low, lo[ids[:count]].min(axis=0)) and np.array_equal(high, hi[ids[:count]].max(axis=0))
            else:
                assert np.array_equal(low, tree.lo[reference].min(axis=0)) and np.array_equal(high, tree.hi[reference].max(axis=0))
                todo.append((reference, level + 1))
    assert (visited == 1).all() and (rows == 1).all()
    assert (tree.leaves, tree.depth) == (leaves, deepest)
    assert stack_need(tree.children) <= STACK_SIZE


@pytest.mark.parametrize("width", [4, 8])
@pytest.mark.parametrize("kind", ["soup", "coincident", "progression", "tiny_and_huge", "mixed", "all_equal"])
@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_trees_keep_their_invariants(builder, kind, width):
    geometry = GEOMETRIES[kind](np.random.default_rng(1))
    binary = build_binary(geometry, BvhOptions(builder, 1), 1)
    for max_leaf in (1, 2 * width):
        check_tree(collapse(binary, width, max_leaf, 1.0, 1.0), geometry, width, max_leaf)


def area(lo, hi):
    e = np.maximum(hi.astype(np.float64) - lo, 0.0)
    return e[0] * e[1] + e[1] * e[2] + e[2] * e[0]


def least_cost(nodes, order_size, width, max_leaf, c_node, c_row):
    """Try every choice of roots below each wide node; return the least cost over the root's area."""

    def child(index, side):
        return index, side

    def is_leaf(code):
        return nodes[f"count_{code[1]}"][code[0]] > 0

    def below(code):
        first = int(nodes[f"first_{code[1]}"][code[0]])
        return child(first, 0), child(first, 1)

    @cache
    def size(code):
        return int(nodes[f"count_{code[1]}"][code[0]]) if is_leaf(code) else sum(size(c) for c in below(code))

    def forests(roots):
        """Yield every set of at most `width` roots that results from opening some of `roots`."""
        found = {roots}
        todo = [roots]
        while todo:
            for i, code in enumerate(now := todo.pop()):
                if not is_leaf(code) and len(now) < width:
                    new = tuple(sorted((*now[:i], *now[i + 1 :], *below(code))))
                    if new not in found:
                        found.add(new)
                        todo.append(new)
        return found

    @cache
    def one(code):
        """Return the cost of this subtree as one root."""
        a = area(nodes[f"lo_{code[1]}"][code[0]], nodes[f"hi_{code[1]}"][code[0]])
        whole = c_row * a * -(-size(code) // width) if size(code) <= max_leaf else np.inf
        if is_leaf(code):
            return c_row * a * -(-size(code) // width)
        return min(whole, c_node * a + opened(tuple(sorted(below(code)))))

    @cache
    def opened(roots):
        return min(sum(one(code) for code in roots) for roots in forests(roots))

    return opened((child(0, 0), child(0, 1)))


@pytest.mark.parametrize(("c_node", "c_row", "max_leaf"), [(1.0, 1.0, 8), (1.0, 0.3, 64), (0.2, 1.0, 2)])
@pytest.mark.parametrize("seed", range(4))
def test_no_collapse_is_cheaper(seed, c_node, c_row, max_leaf):
    rng = np.random.default_rng(seed)
    lo = rng.uniform(-1.0, 1.0, (22, 3))
    geometry = geometry_of(lo, lo + rng.exponential(0.3, (22, 3)))
    binary = build_binary(geometry, BvhOptions("binned", 1), 1)
    tree = collapse(binary, 4, max_leaf, c_node, c_row)
    found = 0.0
    for reference, a in zip(tree.children.reshape(-1).tolist(), tree.areas.reshape(-1), strict=True):
        found += a * (0.0 if reference == 0 else c_node if reference > 0 else c_row * -(-leaf(reference)[1] // 4))
    expected = least_cost(binary.nodes, len(binary.order), 4, max_leaf, c_node, c_row)
    assert found == pytest.approx(expected, rel=1e-5)


def test_a_deep_binary_tree_still_fits_on_the_stack():
    # The builder splits boxes in geometric progression off one by one. Wide nodes would then push up to 7 entries at each level.
    lo = np.repeat(2.0 ** np.arange(-60.0, 60.0)[:, None], 3, axis=1)
    geometry = geometry_of(lo, 1.01 * lo)
    for builder in BVH_BUILDERS:
        for width in (4, 8):
            tree = collapse(build_binary(geometry, BvhOptions(builder, 1), 1), width, 1, 1.0, 1.0)
            check_tree(tree, geometry, width, 1)


@pytest.mark.parametrize("width", [4, 8])
@pytest.mark.parametrize("builder", ["binned", "sweep", "reinsertion"])
def test_a_binary_tree_down_to_single_primitives_is_not_cheaper(builder, width):
    # The wide builder does not split a row if this saves no area: the collapse would join the two leaves again.
    rng = np.random.default_rng(7)
    for kind in ("mixed", "soup"):
        geometry = GEOMETRIES[kind](rng)
        wide = build(geometry, f"bvh{width}", builder=builder)
        trees = (collapse(build_binary(geometry, BvhOptions(builder, 1), 1), width, width, 1.0, 1.0), wide._tree(wide.built))
        full, stopped = ((tree.areas * np.where(tree.children < 0, ((-1 - tree.children) % 64 + width) // width, 1)).sum()
                         for tree in trees)
        assert stopped <= 1.01 * full


def test_children_are_where_any_hit_wants_them():
    tree = build(icosphere(3), "bvh8")._tree(build(icosphere(3), "bvh8").built)
    kind = np.where(tree.children == 0, 0, np.where(tree.children > 0, 1, 2))
    assert (np.diff(kind, axis=1) >= 0).all() and len(np.unique(kind)) == 3
    areas = np.where(np.diff(kind, axis=1) == 0, np.diff(tree.areas, axis=1), 0.0)
    assert (areas >= -1e-6 * tree.root_area).all()


@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_any_binary_builder_gives_the_same_answers(builder):
    rng = np.random.default_rng(3)
    geometry = GEOMETRIES["mixed"](rng)
    origin, direction = rays_for(geometry, rng)
    expected = build(geometry, "brute_force").closest_hit(origin, direction)
    assert_same_hits(build(geometry, "bvh8", builder=builder).closest_hit(origin, direction), expected)
