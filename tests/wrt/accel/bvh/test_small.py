"""Wide trees over few primitives, which are built in Python."""

from __future__ import annotations

import numpy as np
import pytest

from tests.refused import refused

from tests.kernel_tools import cpu_only  # isort: skip
import wrt
from wrt.accel.bvh import wide
from wrt.accel.bvh.small import SMALL, small_tree
from wrt.accel.bvh.tree import BvhOptions
from wrt.accel.bvh.wide_tree import WideTree, check_wide
from wrt.accel.scenes.build import build
from wrt.kernels.wide.references import EMPTY, leaf_count, leaf_first
from wrt.scene.shapes import icosphere

pytestmark = cpu_only


def soup(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes of very different sizes; some are flat, and some are equal."""
    rng = np.random.default_rng(seed)
    lo = rng.normal(size=(n, 3)).astype(np.float32)
    size = np.exp(rng.normal(-2.0, 2.0, (n, 3))) * (rng.random((n, 3)) > 0.2)
    lo[n // 2 : n // 2 + 5], size[n // 2 : n // 2 + 5] = 0.5, 0.25
    return lo, (lo + size).astype(np.float32)


def options_for(width: int, max_leaf: int | None = None, costs: tuple[float, float] = (1.0, 1.0)) -> BvhOptions:
    return BvhOptions("refined", width if max_leaf is None else max_leaf, *costs, row=width)


def assert_is_tree(tree: WideTree, lo: np.ndarray, hi: np.ndarray, options: BvhOptions) -> None:
    check_wide(tree.children, len(lo), options.row)
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.arange(len(lo)))
    assert tree.leaves == (tree.children < 0).sum()

    def below(node: int) -> tuple[list[int], int]:
        """Return the primitives and the height of a subtree; check that each box is the box around the subtree."""
        found, height = [], 0
        for place, reference in enumerate(tree.children[node]):
            if reference == EMPTY:
                assert (tree.lo[node, place] == np.inf).all() and (tree.hi[node, place] == -np.inf).all()
                assert (tree.children[node, :place] == EMPTY).all()
                continue
            if reference < 0:
                first, count = int(leaf_first.func(reference)), int(leaf_count.func(reference))
                items, deeper = tree.order[first : first - (-count // options.row)].reshape(-1)[:count].tolist(), 0
                assert 1 <= count <= options.max_leaf
            else:
                items, deeper = below(int(reference))
            assert np.array_equal(tree.lo[node, place], lo[items].min(axis=0))
            assert np.array_equal(tree.hi[node, place], hi[items].max(axis=0))
            found, height = found + items, max(height, deeper)
        there = tree.children[node] != EMPTY  # any-hit queries visit the last child first: leaves before inner nodes, the largest first
        keys = list(zip(tree.children[node][there] < 0, tree.areas[node][there], strict=True))
        assert keys == sorted(keys)
        return found, height + 1

    assert below(0)[1] == tree.depth


@pytest.mark.parametrize("n", [0, 1, 2, 7, 8, 9, 33, SMALL])
@pytest.mark.parametrize(("width", "max_leaf", "costs"), [
    (8, None, (1.0, 1.0)), (4, None, (1.0, 1.0)), (8, 1, (1.0, 1.0)), (8, 64, (0.1, 2.0)), (4, 3, (5.0, 0.0)), (8, 5, (0.0, 0.0))])
def test_it_is_a_tree_over_the_boxes(n: int, width: int, max_leaf: int | None, costs: tuple[float, float]) -> None:
    options = options_for(width, max_leaf, costs)
    for seed in range(3):
        lo, hi = soup(n, seed)
        assert_is_tree(small_tree(lo, hi, options), lo, hi, options)
    same = np.ones((n, 3), np.float32)
    assert_is_tree(small_tree(same, same, options), same, same, options)
    assert_is_tree(small_tree(-3e38 * same, 3e38 * same, options), -3e38 * same, 3e38 * same, options)


@pytest.mark.filterwarnings("error")
def test_costs_and_boxes_beyond_all_numbers() -> None:
    space = np.full((40, 3), np.inf, np.float32)
    for (lo, hi), costs in (((-space, space), (1.0, 1.0)), (soup(40), (1e308, 1e308)), (soup(40), (1e308, 0.0))):
        for max_leaf in (1, 8, 64):
            options = options_for(8, max_leaf, costs)
            assert_is_tree(small_tree(lo, hi, options), lo, hi, options)
    lo, hi = soup(40)
    lo[7] = np.nan  # a Geometry may hold NaN: the build must still end
    check_wide(small_tree(lo, hi, options_for(8)).children, 40, 8)


def cost(tree: WideTree, width: int) -> float:
    """Return the expected number of nodes and rows that a random line through the root's box visits."""
    count = np.where(tree.children < 0, leaf_count.func(tree.children), 0)
    return 1.0 + float((tree.areas * np.where(tree.children > 0, 1, -(-count // width))).sum()) / tree.root_area


def test_two_clusters_are_two_leaves() -> None:
    lo = np.repeat([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]], 8, axis=0).astype(np.float32)
    tree = small_tree(lo, lo + 1.0, options_for(8))
    assert tree.leaves == 2 and len(tree.children) == 1
    assert sorted(sorted(row) for row in tree.order.tolist()) == [[*range(8)], [*range(8, 16)]]
    # Half the surface areas of the two cubes, and of the box around both.
    assert cost(tree, 8) == pytest.approx(1.0 + 2.0 * 3.0 / (11.0 + 11.0 + 1.0))


@pytest.mark.parametrize("name", ["bvh4", "bvh8"])
def test_it_costs_about_what_the_kernels_trees_do(name: str) -> None:
    for seed in range(4):
        lo, hi = soup(SMALL, seed)
        corners = np.stack([lo, np.stack([hi[:, 0], lo[:, 1], hi[:, 2]], axis=1), hi], axis=1).reshape(-1, 3)
        accel = build((corners, np.arange(3 * SMALL).reshape(-1, 3)), name)
        options = options_for(accel.width)
        kernels, ours = accel._collapsed(options), small_tree(*accel.geometry.bounds(), options)
        assert cost(ours, accel.width) < 1.1 * cost(kernels, accel.width)


def test_few_primitives_need_no_kernel_but_where_another_builder_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class CalledError(Exception):
        pass

    def called(*arguments: object) -> None:
        raise CalledError

    monkeypatch.setattr(wide, "build_binary", called)
    ball = icosphere(1)
    few, many = (np.resize(ball.faces, (n, 3)) for n in (SMALL, SMALL + 1))
    assert build((ball.vertices, few), "bvh8").stats.leaves > 1
    for faces, options in ((many, {}), (few, {"builder": "binned"})):
        with pytest.raises(CalledError):
            build((ball.vertices, faces), "bvh8", **options)


@pytest.mark.parametrize("n", [0, 1, 2, 100])
def test_options_are_refused_as_ever(n: int) -> None:
    ball = icosphere(1)
    mesh = ball.vertices, np.resize(ball.faces, (n, 3))
    for options, message in (({"builder": "sbvh", "split_budget": 9.0}, ("split_budget",)),
                             ({"builder": "none"}, ("builder", "no builder")),
                             ({"cost_traversal": np.inf}, ("cost_traversal",)), ({"max_leaf": 0}, ("max_leaf",))):
        with refused(*message):
            build(mesh, "bvh8", **options)


def nested(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles, each half as large as the previous triangle, so that a tree over them is a chain."""
    size = np.float32(0.5) ** np.arange(n, dtype=np.float32)
    corners = size[:, None, None] * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], np.float32)
    return corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)


def test_a_chain_that_no_stack_holds_is_left_to_the_builder() -> None:
    vertices, faces = nested(SMALL)
    accel = build((vertices, faces), "bvh8", max_leaf=1)
    assert small_tree(*accel.geometry.bounds(), options_for(8, 1)).stack > wide.STACK_SIZE
    check_wide(accel._tree(accel.built).children, SMALL, 8)
    truth = build((vertices, faces), "brute_force")
    origins = np.repeat(np.float32([[2.0, 2.0, 2.0]]), 300, axis=0)
    directions = (np.random.default_rng(0).random((300, 3)) * 0.4 - 2.0).astype(np.float32)
    hits, expected = accel.closest_hit(origins, directions), truth.closest_hit(origins, directions)
    assert (expected.prim_id >= 0).any()
    assert np.array_equal(hits.prim_id, expected.prim_id) and np.array_equal(hits.t, expected.t)


@pytest.mark.parametrize("name", ["bvh8", "bvh8c", "bvh2"])
def test_a_list_of_meshes_gets_the_trees_of_single_builds(name: str) -> None:
    rng = np.random.default_rng(4)
    meshes = [wrt.Mesh(rng.normal(size=(3 * n, 3)), np.arange(3 * n).reshape(-1, 3)) for n in (1, 2, 20, 20, SMALL, SMALL + 1)]
    worlds = wrt.build(meshes, name)
    for part, mesh in zip(worlds.geometry.part, meshes, strict=True):
        one = worlds.bottoms[part]
        alone = wrt.build(mesh, name).built
        assert np.array_equal(one.built.order, alone.order) and one.built.sah_cost == alone.sah_cost
        for key, values in alone.arrays.items():
            assert np.asarray(one.built.arrays[key]).tobytes() == np.asarray(values).tobytes()
