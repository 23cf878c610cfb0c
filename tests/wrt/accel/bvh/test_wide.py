"""Wide BVHs on the host: files, refit, options, layout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from wrt.accel.bvh.compress import compress, decompress
from wrt.accel.bvh.wide_tree import check_wide
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.scene.shapes import icosphere

WIDE = {"bvh4": 4, "bvh8": 8, "bvh8c": 8}
BALL = icosphere(3)


def rays(n: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(n, 3)).astype(np.float32)
    return origins, (0.5 * rng.normal(size=(n, 3)) - origins).astype(np.float32)


def assert_same(accel, truth) -> None:
    hits, expected = accel.closest_hit(*rays()), truth.closest_hit(*rays())
    for field in ("t", "u", "v", "prim_id"):
        np.testing.assert_array_equal(getattr(hits, field), getattr(expected, field))
    np.testing.assert_array_equal(accel.any_hit(*rays()), expected.prim_id >= 0)


@pytest.mark.parametrize("name", [*WIDE, "bvh6"])
@pytest.mark.parametrize("builder", ["binned", "sbvh"])
def test_refit_follows_vertices_that_move(name: str, builder: str) -> None:
    spheres = np.array([[0.0, 0.5, 0.0, 0.3]], np.float32)
    accel = build(Geometry(BALL.vertices, BALL.faces, spheres), name, builder=builder)
    cost = accel.stats.sah_cost
    assert accel.refit(BALL.vertices).growth == pytest.approx(1.0, rel=1e-3 if builder == "binned" else 0.5)
    for scale in ([2.0, 0.5, 1.0], [0.1, 0.1, 3.0]):
        moved = (BALL.vertices * scale).astype(np.float32)
        done = accel.refit(moved)
        assert accel.stats.sah_cost == pytest.approx(done.growth * cost)
        assert_same(accel, build(Geometry(moved, BALL.faces, spheres), "brute_force"))
    mixed = BALL.vertices[np.random.default_rng(0).permutation(len(BALL.vertices))]
    assert accel.refit(mixed).growth > 1.5


@pytest.mark.parametrize("name", WIDE)
def test_arrays_of_a_file_are_checked(name: str) -> None:
    width = WIDE[name]
    accel = build(BALL, name)
    children = accel._tree(accel.built).children  # in units of rows
    accel._check(accel.built)
    check_wide(children, len(BALL.faces), width)
    inner = np.argwhere(children > 0)
    leaf = np.argwhere(children < 0)
    for (i, j), value, message in [
        (inner[0], 0, (None, "form a tree")), (inner[0], len(children), (None, "leads out")), (inner[-1], 1, (None, "leads out")),
        (leaf[0], 0, (None, "other primitives")), (leaf[0], children[tuple(leaf[0])] - 64, (None, "other primitives")),
        (leaf[1], -(2**31), (None, "other primitives")), (leaf[0], 1, (None, "leads out"))]:
        spoiled = children.copy()
        spoiled[i, j] = value
        with refused(*message):
            check_wide(spoiled, len(BALL.faces), width)
    with refused(what="leads out"):
        check_wide(np.zeros((0, width), np.int32), 0, width)


@pytest.mark.parametrize("name", ["bvh4", "bvh8"])
def test_a_child_that_does_not_exist_has_no_box(name: str) -> None:
    # A ray that entered a missing child would restart at the root.
    accel = build(BALL, name)
    none = accel._references(accel.built) == 0
    assert none.any()
    for k, plane in enumerate((np.inf, -np.inf) * 3):
        nodes = accel.built.arrays["nodes"].reshape(-1, 8, WIDE[name]).copy()
        assert (nodes[:, k][none] == plane).all()
        nodes[:, k][none] = 0.0
        with refused(what="damaged: a child"):
            accel._check(replace(accel.built, arrays={"nodes": nodes.reshape(-1)}))
    nodes = accel.built.arrays["nodes"].reshape(-1, 8, WIDE[name]).copy()
    nodes[:, 7] = np.nan  # not used
    accel._check(replace(accel.built, arrays={"nodes": nodes.reshape(-1)}))


def test_a_tree_too_deep_for_the_stack_is_refused() -> None:
    # A chain of nodes with 8 children each: 7 stay on the stack at every level.
    def chain(n: int) -> np.ndarray:
        children = -1 - 64 * np.arange(8 * n, dtype=np.int32).reshape(n, 8)
        children[:-1, 0] = np.arange(1, n)
        leaves = children < 0
        children[leaves] = -1 - 64 * np.arange(leaves.sum())
        return children

    check_wide(chain(9), 9 * 8 - 8, 8)
    with refused(what="64 entries"):
        check_wide(chain(10), 10 * 8 - 9, 8)


@pytest.mark.parametrize("name", [*WIDE, "bvh6"])
def test_any_number_of_threads_makes_the_same_nodes_and_rows(name: str) -> None:
    ball = icosphere(6)  # more triangles than one job of a thread
    one, *others = (build(ball, name, threads=threads).data for threads in (1, 2, 3))
    for other in others:
        assert one.nodes.numpy().tobytes() == other.nodes.numpy().tobytes()
        assert one.primitives.numpy().tobytes() == other.primitives.numpy().tobytes()


@pytest.mark.parametrize("name", WIDE)
def test_nodes_and_rows_begin_where_cache_lines_do(name: str) -> None:
    data = build(BALL, name).data
    assert data.nodes.ptr % 64 == 0 and data.primitives.ptr % 64 == 0


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1.0, 1e30])
def test_compressed_boxes_contain_what_they_held_and_little_more(scale: float) -> None:
    rng = np.random.default_rng(4)
    n = 3000
    center = np.float32(scale) * rng.normal(size=(n, 1, 3)) * 10.0 ** rng.uniform(-3, 3, (n, 1, 3))  # far from the origin, or near
    corner = center + np.float32(scale) * rng.normal(size=(n, 8, 3))
    there = rng.random((n, 8)) < 0.7
    extent = np.where(rng.random((n, 8, 3)) < 0.3, 0.0, scale * rng.exponential(size=(n, 8, 3)))
    lo = np.where(there[..., None], corner, np.inf).astype(np.float32)
    hi = np.where(there[..., None], lo + extent, -np.inf).astype(np.float32)
    out_lo, out_hi = decompress(compress(lo, hi, there), 8)
    assert (out_lo <= lo).all() and (out_hi >= hi).all() and np.array_equal((out_lo <= out_hi).all(axis=2), there)
    boxes = ((lo, 1e38), (hi, -1e38), (out_lo, 1e38), (out_hi, -1e38))
    lo, hi, out_lo, out_hi = (np.where(there[..., None], box, empty) for box, empty in boxes)
    whole_lo, whole_hi = lo.min(axis=1, keepdims=True), hi.max(axis=1, keepdims=True)
    some = there.any(axis=1)
    step = 2.0 * (whole_hi - whole_lo)[some] / 255.0 + 4.0 * 2.0**-23 * np.abs(whole_hi)[some]
    lost = np.maximum(lo - out_lo, out_hi - hi, where=there[..., None], out=np.zeros_like(lo))[some]
    assert (lost <= 1.01 * step).all() and (lost > 0.0).mean() > 0.1


def test_boxes_that_8_bits_cannot_tell_hold_nothing_back() -> None:
    lo, hi = np.full((1, 8, 3), np.inf, np.float32), np.full((1, 8, 3), -np.inf, np.float32)
    there = np.arange(8)[None] >= 5
    lo[0, 5:], hi[0, 5:] = [[-np.inf, 0.0, 1.0]], [[3.0, 0.0, np.inf]]
    lo[0, 6, 0], hi[0, 7, 1] = -3e38, 3.4e38
    out_lo, out_hi = decompress(compress(lo, hi, there), 8)
    assert (out_lo <= lo).all() and (out_hi >= hi).all() and np.array_equal((out_lo <= out_hi).all(axis=2), there)


def test_compressed_takes_less_memory() -> None:
    ball = icosphere(5)
    sizes = {name: build(ball, name).stats.bytes / len(ball.faces) for name in ("bvh2", "bvh8", "bvh8c")}
    assert 40.0 < sizes["bvh8c"] < 44.0 < 0.7 * sizes["bvh8"] < sizes["bvh2"]


def test_a_node_that_tells_of_other_children_is_refused() -> None:
    accel = build(BALL, "bvh8c")
    nodes = accel.built.arrays["nodes"].reshape(-1, 24)
    nodes[3, 3:4].view(np.uint32)[0] ^= np.uint32(1 << 31)
    with refused(what="children"):
        accel._check(accel.built)
