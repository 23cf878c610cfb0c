"""The binary BVH's builders: invariants of every tree over any input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.data import data_path
from tests.refused import refused

from tests.kernel_tools import ints, launch, rounded, zeros  # isort: skip (starts Warp)
import warp as wp

from tests.kernels.traverse.test_common import GEOMETRIES, assert_same_hits, rays_for
from wrt.accel.bvh.builders import BVH_BUILDERS, BvhOptions, build_binary, sah_cost
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.io.mesh_file import load_mesh
from wrt.kernels.build.records import balanced_depth
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import STACK_SIZE
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, torus


def geometry_of(lo, hi):
    """Return a triangle in each box, between two opposite corners and a third corner of the box."""
    lo, hi = np.asarray(lo, np.float32).reshape(-1, 3), np.asarray(hi, np.float32).reshape(-1, 3)
    third = np.where([True, False, True], lo, hi)
    vertices = np.stack([lo, third, hi], axis=1).reshape(-1, 3)
    return Geometry(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), np.zeros((0, 4), np.float32))


def make(lo, hi, builder="binned", threads=1, **changes):
    return build_binary(geometry_of(lo, hi), BvhOptions(builder, **changes), threads)


def check_tree(lo, hi, tree, max_leaf=4):
    """Check that each primitive is in a leaf, boxes nest, and the depth is right and within the stack; return the number of leaves.
    Without spatial splits, each primitive must be in one leaf, and boxes must be tight."""
    lo, hi = geometry_of(lo, hi).bounds()
    nodes, order, depth = tree.nodes, tree.order, tree.depth
    assert np.array_equal(np.unique(order), np.arange(len(lo)))
    once = len(order) == len(lo)
    seen = np.zeros(len(order), int)
    visited = np.zeros(len(nodes), int)
    deepest, leaves = 0, 0
    todo = [(0, 1, np.full(3, -np.inf), np.full(3, np.inf))]
    while todo:
        index, level, outer_lo, outer_hi = todo.pop()
        visited[index] += 1
        deepest = max(deepest, level)
        for side in "01":
            node = nodes[index]
            box_lo, box_hi = node["lo_" + side], node["hi_" + side]
            first, count = int(node["first_" + side]), int(node["count_" + side])
            if (box_lo > box_hi).any():
                assert count == 0 and len(lo) < 2, "an empty child"
                continue
            assert (box_lo >= outer_lo).all() and (box_hi <= outer_hi).all()
            if count == 0:
                todo.append((first, level + 1, box_lo, box_hi))
                continue
            leaves += 1
            assert count <= max_leaf
            seen[first : first + count] += 1
            members = order[first : first + count]
            assert len(np.unique(members)) == count
            assert (box_lo >= lo[members].min(axis=0)).all() and (box_hi <= hi[members].max(axis=0)).all()
            if once:
                assert np.array_equal(box_lo, lo[members].min(axis=0)) and np.array_equal(box_hi, hi[members].max(axis=0))
    assert (seen == 1).all() and (visited == 1).all()
    assert deepest == depth <= STACK_SIZE
    return leaves


def boxes(rng, n):
    center = rng.uniform(-1.0, 1.0, (n, 3))
    size = 0.02 * rng.random((n, 3))
    return rounded(center - size), rounded(center + size)


def points(values):
    values = np.asarray(values, np.float32)
    return values, values


def progression(rng):
    """Return boxes in geometric progression, of ratio 16 and up: bins can only split off the largest box."""
    return points(16.0 ** np.arange(-29, 15)[:, None] * np.array([1.0, 0.0, 0.0]))


def crowded_progression(rng):
    """Return a progression along three axes with many boxes at each step. Without the depth limit, its tree overflows the stack."""
    steps = [np.eye(3)[axis] * 4.0**k for axis in range(3) for k in range(-60, 31) for _ in range(3)]
    return points(np.concatenate([steps, np.zeros((500, 3))]))


CASES = {
    "random": lambda rng: boxes(rng, 2000),
    "clustered": lambda rng: points(rng.normal(size=(1000, 3)) ** 9),
    "all_equal": lambda rng: points(np.ones((777, 3))),
    "flat": lambda rng: points(rng.random((800, 3)) * [1.0, 0.0, 1.0]),
    "line": lambda rng: points(rng.random((1000, 3)) * [0.0, 1.0, 0.0]),
    "grid": lambda rng: points(np.stack(np.meshgrid(*[np.arange(9.0)] * 3), axis=-1).reshape(-1, 3)),
    "progression": progression,
    "crowded_progression": crowded_progression,
    "huge": lambda rng: points(rng.uniform(-3e38, 3e38, (500, 3))),
    "subnormal": lambda rng: points(rng.uniform(-1e-40, 1e-40, (500, 3))),
    "two": lambda rng: boxes(rng, 2),
    "three": lambda rng: boxes(rng, 3),
    "nested": lambda rng: (-np.arange(1.0, 300.0)[:, None] * np.ones(3), np.arange(1.0, 300.0)[:, None] * np.ones(3)),
}


@pytest.mark.parametrize("max_leaf", [1, 4, 64])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_every_primitive_in_one_leaf_and_boxes_nested(builder, case, max_leaf):
    lo, hi = CASES[case](np.random.default_rng(1))
    tree = make(lo, hi, builder, max_leaf=max_leaf)
    leaves = check_tree(lo, hi, tree, max_leaf)
    assert leaves == tree.leaves == len(tree.nodes) + 1  # True for every binary tree.
    assert leaves >= len(lo) / max_leaf


special = st.sampled_from([0.0, 1.0, 1.0 + 2.0**-23, 2.0**-100, 2.0**127, -(2.0**127)])
coordinate = st.floats(-(2.0**100), 2.0**100, width=32) | special


@pytest.mark.parametrize("builder", BVH_BUILDERS)
@settings(max_examples=100, deadline=None)
@given(st.integers(2, 40).flatmap(lambda n: arrays(np.float32, (n, 3), elements=coordinate)), st.sampled_from([1, 3, 8]))
def test_any_points_make_a_valid_tree(builder, values, max_leaf):
    check_tree(values, values, make(values, values, builder, max_leaf=max_leaf), max_leaf)


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_nothing_and_a_single_primitive(builder, n):
    lo, hi = boxes(np.random.default_rng(2), n)
    tree = make(lo, hi, builder)
    assert len(tree.nodes) == 1 and tree.depth == 1
    check_tree(lo, hi, tree)


def same(one, two):
    return np.array_equal(one.nodes, two.nodes) and np.array_equal(one.order, two.order) and one.depth == two.depth


@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_one_and_two_threads_build_the_same_tree(builder):
    lo, hi = boxes(np.random.default_rng(3), 9000)
    one, two = make(lo, hi, builder, threads=1), make(lo, hi, builder, threads=2)
    assert same(one, two)
    assert same(two, make(lo, hi, builder, threads=2))


def test_no_subtree_is_forgotten_however_many_are_deferred():
    # Clusters larger than one thread's share, each inside shells that are split off one after another. The top defers hundreds of
    # small ranges; for an ordinary scene it defers some dozens.
    parts = []
    for crowd in range(32):
        base = np.full(3, (crowd + 1.0) * 2**19)
        parts.append(np.tile(base, (4200, 1)))
        for axis in range(3):
            for k in range(0, 18, 3):
                shell = np.tile(base, (6, 1))
                shell[:, axis] += 2.0 ** (17 - k)
                parts.append(shell)
    lo, hi = points(np.concatenate(parts))
    assert same(make(lo, hi, threads=1), make(lo, hi, threads=2))


@pytest.mark.parametrize("kind", GEOMETRIES)
@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_every_builder_gives_the_same_bits_as_brute_force(builder, kind):
    rng = np.random.default_rng(5)
    geometry = GEOMETRIES[kind](rng)
    origin, direction = rays_for(geometry, rng, 4000)
    expected = build(geometry, "brute_force").closest_hit(origin, direction)
    assert_same_hits(build(geometry, "bvh2", builder=builder).closest_hit(origin, direction), expected)


def test_splits_follow_the_surface_area():
    # The root must separate two distant clusters. Then the expected cost is far below the cost of a median split.
    rng = np.random.default_rng(4)
    center = np.where(np.arange(1000)[:, None] < 100, [-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]) + rng.random((1000, 3))
    tree = make(center, center + 0.01)
    nodes, order = tree.nodes, tree.order
    sides = [nodes[0]["lo_0"][0], nodes[0]["lo_1"][0]]
    assert min(sides) < -40.0 and max(sides) > 40.0
    left = (center[order[: 100 if sides[0] < 0.0 else 900], 0] < 0.0).mean()
    assert left in (0.0, 1.0)


def test_builders_rank_as_the_literature_says():
    # Two intersecting shells, triangles of very different sizes and a long sliver make spatial splits useful.
    ball, ring = icosphere(3), torus()
    slivers = np.random.default_rng(6).uniform(-2.0, 2.0, (300, 3, 3)) * [1.0, 1.0, 0.02]
    vertices = np.concatenate([ball.vertices, 1.5 * ring.vertices, slivers.reshape(-1, 3)])
    offset = len(ball.vertices) + len(ring.vertices)
    faces = np.concatenate([ball.faces, ring.faces + len(ball.vertices), offset + np.arange(900).reshape(-1, 3)])
    geometry = Geometry.of(Mesh(vertices, faces))
    cost = {name: build(geometry, "bvh2", builder=name).stats.sah_cost for name in BVH_BUILDERS}
    assert cost["reinsertion"] < 0.98 * cost["binned"] and cost["sbvh"] < 0.9 * cost["sweep"]
    assert 0.9 * cost["binned"] < cost["sweep"] < 1.01 * cost["binned"]
    assert max(cost["binned"], cost["sweep"]) < min(cost["lbvh"], cost["median"])


@pytest.mark.parametrize(("builder", "published"), [("binned", 30.27), ("sweep", 30.07), ("sbvh", 29.58)])
def test_trees_are_as_good_as_those_of_tinybvh(builder, published):
    mesh = load_mesh(data_path("meshes/small/legocar.obj"))
    assert build(mesh, "bvh2", builder=builder).stats.sah_cost < 1.05 * published


def test_spatial_splits_stay_within_their_budget():
    rng = np.random.default_rng(7)
    ends = rng.uniform(-1.0, 1.0, (400, 2, 3))  # Needles, whose boxes are almost empty.
    corners = np.concatenate([ends, ends[:, :1] + 0.01 * rng.normal(size=(400, 1, 3))], axis=1)
    geometry = Geometry.of(Mesh(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3)))
    references = [build(geometry, "bvh2", builder="sbvh", split_budget=b).stats.references for b in (0.0, 0.3, 2.0)]
    assert references[0] == 400 < references[1] <= 520 and references[1] < references[2] <= 1200
    assert build(geometry, "bvh2", builder="sbvh", split_alpha=1.0).stats.references == 400  # No overlap is as large as the root.
    with refused("split_budget", "0 to 8"):
        build(geometry, "bvh2", builder="sbvh", split_budget=9.0)


def test_sah_cost_by_hand():
    # Two unit cubes side by side with one primitive each. The cost is 1 node and 2 * 6/10 tests: the areas are 6 and 10.
    nodes = make([[0, 0, 0], [1, 0, 0]], [[1, 1, 1], [2, 1, 1]]).nodes
    assert sah_cost(nodes) == pytest.approx(1.0 + 2.0 * 6.0 / 10.0, rel=1e-5)


@pytest.mark.parametrize("options, message", [
    ({"builder": "guess"}, ("builder", "no builder 'guess'", None, None, "binned")),
    ({"cost_traversal": -1.0}, ("cost_traversal",)),
    ({"cost_intersection": np.inf}, ("cost_intersection",)), ({"max_leaf": 0}, ("max_leaf",)), ({"max_leaf": 65}, ("max_leaf",))])
def test_invalid_options_are_refused(options, message):
    with refused(*message):
        build(icosphere(0), "bvh2", **options)


def test_the_deepest_tree_still_finds_everything():
    lo, _ = CASES["crowded_progression"](None)
    n = len(lo)
    size = np.maximum(np.abs(lo).max(axis=1, keepdims=True) * 0.01, 1e-36)
    corners = lo[:, None].astype(np.float64) + size[:, None] * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    geometry = Geometry(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * n, dtype=np.int32).reshape(-1, 3),
                        np.zeros((0, 4), np.float32))
    tree = build(geometry, "bvh2", max_leaf=1)
    assert 40 < tree.stats.depth <= STACK_SIZE
    keep = np.abs(corners).max(axis=(1, 2)) > 1e-30
    target = corners.mean(axis=1)[keep]
    direction = np.broadcast_to([1.0, 1.0, 1.0], target.shape)
    origin = rounded(target - 3.0 * size[keep] * direction)
    found = tree.closest_hit(origin, direction)
    expected = build(geometry, "brute_force").closest_hit(origin, direction)
    assert np.array_equal(found.prim_id, expected.prim_id) and np.array_equal(found.t, expected.t)
    assert (found.prim_id >= 0).all()


@kernel
def levels_kernel(n: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = balanced_depth(n[i])


def test_levels_end_for_every_number():
    n = np.array([1, 2, 3, 4, 5, 2**20, 2**30 - 1, 2**30, 2**30 + 1, 2**31 - 1])
    out = zeros(len(n), wp.int32)
    launch(levels_kernel, len(n), ints(n), out)
    assert out.numpy().tolist() == [0, 1, 2, 2, 3, 20, 30, 30, 31, 31]


@pytest.mark.parametrize("builder", BVH_BUILDERS)
@pytest.mark.parametrize("power", [-80, 66])
def test_a_tree_does_not_depend_on_the_scale(builder, power):
    # 2^-80 is about 1e-24, 2^66 about 1e20: areas are beyond the range of float32. The padding scales with the boxes.
    mesh = torus(segments=24, tube_segments=12)
    lo, hi = (corner.astype(np.float64) for corner in Geometry.of(mesh).bounds())
    reference, scaled = (make(lo * scale, hi * scale, builder) for scale in (1.0, 2.0**power))
    assert np.array_equal(reference.order, scaled.order) and len(reference.nodes) == len(scaled.nodes)
    assert sah_cost(scaled.nodes) == pytest.approx(sah_cost(reference.nodes), rel=1e-6)
