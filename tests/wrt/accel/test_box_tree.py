"""Trees as plain arrays: exported, walked in NumPy, read back with the same hits and counts, and refused when they are no tree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from wrt.accel.box_tree import BoxTree
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

FAR = np.float32(1.0 + 2.0 * (7.0 * 2.0**-24) / (1.0 - 7.0 * 2.0**-24))  # as in the box unit
BOXES = ("bvh2", "bvh4", "bvh8")  # whose nodes hold boxes in float32
BVHS = (*BOXES, "bvh2_sphere", "bvh2_kdop", "bvh8c", "bvh6")
BITS = ("t", "u", "v", "prim_id")


def aimed(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(n, 3))
    origins *= 3.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    return origins.astype(np.float32), (0.6 * rng.normal(size=(n, 3)) - origins).astype(np.float32)


def plain_walk(tree: Any, origin: np.ndarray, direction: np.ndarray, hits: dict[int, np.float32]) -> tuple[np.float32, int, int, int]:
    """Walk an exported binary tree in plain NumPy: t and prim_id of the closest hit, nodes visited, primitives tested.
    hits: t of every primitive that the line meets."""
    with np.errstate(divide="ignore"):
        inverse = np.float32(1.0) / direction
    best, nodes, tests = (np.float32(3.4028234663852886e38), 1 << 31), 0, 0

    def enter(lo: np.ndarray, hi: np.ndarray) -> np.float32:
        backwards = inverse < 0.0
        with np.errstate(invalid="ignore", over="ignore"):
            near = np.fmax.reduce((np.where(backwards, hi, lo) - origin) * inverse, initial=np.float32(0.0))
            far = np.fmin.reduce((np.where(backwards, lo, hi) - origin) * inverse, initial=np.float32(np.inf)) * FAR
        return near if near <= min(np.float32(far), best[0]) else np.float32(np.inf)

    stack = [(np.float32(0.0), 0, 0)]
    while stack:
        t, child, count = stack.pop()
        if t > best[0]:
            continue
        for i in range(child, child + count):
            tests += 1
            prim_id = int(tree["primitives"][i])
            if prim_id in hits:
                best = min(best, (hits[prim_id], prim_id))
        if count == 0:
            nodes += 1
            found = [(enter(tree["lo"][child, k], tree["hi"][child, k]), k) for k in range(2) if tree["count"][child, k] >= 0]
            for t, k in sorted((each for each in found if each[0] < np.inf), reverse=True):
                stack.append((t, int(tree["child"][child, k]), int(tree["count"][child, k])))
    return (best[0], best[1], nodes, tests) if best[1] < 1 << 31 else (np.float32(np.inf), -1, nodes, tests)


def test_an_exported_tree_is_walked_in_plain_numpy(tmp_path: Path) -> None:
    mesh = icosphere(3)
    accel = wrt.build(mesh, "bvh2")
    accel.tree().save(tmp_path / "tree.npz")
    found = accel.closest_hit(*aimed(150), counters=True)
    every = wrt.all_hits(accel, *aimed(150))
    assert found.counters is not None
    with np.load(tmp_path / "tree.npz") as tree:
        arrays = dict(tree)
    for i, ray in enumerate(zip(*aimed(150), strict=True)):
        rows = slice(every.first[i], every.first[i + 1])
        expected = (found.t[i], found.prim_id[i], found.counters.nodes[i], found.counters.primitives[i])
        assert plain_walk(arrays, *ray, dict(zip(every.prim_id[rows].tolist(), every.t[rows], strict=True))) == expected
    assert 20 < (found.prim_id >= 0).sum() < 150


@pytest.mark.parametrize("name", BVHS[:-1])
def test_a_tree_comes_back(name: str, tmp_path: Path) -> None:
    mesh = icosphere(2)
    accel = wrt.build(mesh, name)
    tree = accel.tree()
    tree.save(tmp_path / "tree.npz")
    back = wrt.accel_from_tree(mesh, tmp_path / "tree.npz", name)
    hits, again = (each.closest_hit(*aimed(400), counters=True) for each in (accel, back))
    for field in BITS:
        assert np.array_equal(getattr(hits, field), getattr(again, field))
    assert hits.counters is not None and again.counters is not None and type(back) is type(accel)
    if name in BOXES:  # the order of the nodes changes, and decides between children that a ray enters at the same distance
        assert abs(hits.counters.primitives.mean() / again.counters.primitives.mean() - 1.0) < 0.02
        assert np.array_equal(np.unique(back.tree().lo.reshape(-1, 3), axis=0), np.unique(tree.lo.reshape(-1, 3), axis=0))
    back.save(tmp_path / "back.accel")
    assert np.array_equal(wrt.load_accel(tmp_path / "back.accel", mesh).closest_hit(*aimed(400)).t, hits.t)


def median_tree(mesh: Mesh) -> dict[str, np.ndarray]:
    """Another builder's tree: median splits, boxes without padding, children before parents."""
    corners = mesh.vertices[mesh.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    rows: list[Any] = [None]
    primitives: list[int] = []

    def part(items: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, int]:
        lo, hi = low[items].min(axis=0), high[items].max(axis=0)
        if len(items) <= 3:
            primitives.extend(items.tolist())
            return lo, hi, len(primitives) - len(items), len(items)
        return lo, hi, node(items, None), 0

    def node(items: np.ndarray, at: int | None) -> int:
        axis = int(np.argmax(np.ptp(corners[items].mean(axis=1), axis=0)))
        order = items[np.argsort(corners[items].mean(axis=1)[:, axis], kind="stable")]
        children = [part(order[len(order) // 2 :]), part(order[: len(order) // 2])]
        if at is None:
            rows.append(children)
            return len(rows) - 1
        rows[at] = children
        return at

    node(np.arange(len(mesh.faces)), 0)
    names = ("lo", "hi", "child", "count")
    return {name: np.array([[child[k] for child in row] for row in rows]) for k, name in enumerate(names)} | {
        "primitives": np.array(primitives)}


@pytest.mark.parametrize("name", BVHS[:-1])
def test_another_builders_tree_gives_the_hits_of_wrts_own(name: str) -> None:
    mesh = icosphere(3)
    tree = median_tree(mesh)
    assert (tree["child"] < np.arange(len(tree["child"]))[:, None])[tree["count"] == 0].any()  # some children come first
    found = wrt.accel_from_tree(mesh, tree, name).closest_hit(*aimed(2000, 3), counters=True)
    expected = wrt.build(mesh, name).closest_hit(*aimed(2000, 3))
    for field in BITS:
        assert np.array_equal(getattr(found, field), getattr(expected, field))
    assert found.counters is not None and found.counters.primitives.mean() < 40


def chain(mesh: Mesh, ends: list[int]) -> dict[str, np.ndarray]:
    """Return a tree of nodes with up to two children: node i has a leaf of the primitives ends[i] .. ends[i + 1] - 1, and node i + 1."""
    n, corners = len(ends) - 1, mesh.vertices[mesh.faces]
    last, first = np.arange(n) == n - 1, np.array(ends[:-1])
    low, high = (np.broadcast_to(end(corners, axis=(0, 1)), (n, 2, 3)) for end in (np.min, np.max))
    return {"lo": low, "hi": high, "child": np.stack([first, np.where(last, 0, np.arange(n) + 1)], axis=1),
            "count": np.stack([np.where(np.diff(ends) > 0, np.diff(ends), -1), np.where(last, -1, 0)], axis=1),
            "primitives": np.arange(ends[-1])}


@pytest.mark.parametrize("name", BVHS[:-1])
def test_binary_trees_with_missing_children_and_long_chains(name: str) -> None:
    mesh, (origins, directions) = icosphere(1), aimed(500)
    expected = wrt.build(mesh).closest_hit(origins, directions)
    accel = wrt.accel_from_tree(mesh, chain(mesh, [0, 0, 1, 3, 3, 10, 40, 80]), name)
    assert all(np.array_equal(getattr(accel.closest_hit(origins, directions), each), getattr(expected, each)) for each in BITS)
    ball = icosphere(3)
    with pytest.raises(wrt.InputError, match=r"levels|stack"):
        wrt.accel_from_tree(ball, chain(ball, [*range(len(ball.faces) + 1)]), name)


def test_spatial_splits_are_allowed_if_the_caller_says_so() -> None:
    rng = np.random.default_rng(2)
    corners = rng.uniform(-1, 1, (60, 3, 3)) * (1.0, 1.0, 0.1)
    mesh = Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(180, dtype=np.int32).reshape(-1, 3))
    accel = wrt.build(mesh, "bvh2", builder="sbvh", split_budget=2.0, split_alpha=0.0)
    tree = accel.tree()
    assert len(tree.primitives) > 60
    with pytest.raises(wrt.InputError, match=r"is in the leaves \d+ times.*spatial_splits"):
        wrt.accel_from_tree(mesh, tree)
    back = wrt.accel_from_tree(mesh, tree, spatial_splits=True)
    assert np.array_equal(back.closest_hit(*aimed(300)).t, accel.closest_hit(*aimed(300)).t)


def damage(tree: BoxTree, how: int) -> dict[str, np.ndarray]:
    """Damage a tree, in a way that makes it no tree over its mesh."""
    out = {name: np.array(array) for name, array in vars(tree).items()}
    inner, leaf = np.argwhere(out["count"] == 0), np.argwhere(out["count"] > 0)
    (i, k), (j, m) = inner[len(inner) // 2], leaf[len(leaf) // 3]
    n, r = len(out["child"]), len(out["primitives"])
    name, place, value = [("child", (i, k), -1), ("child", (i, k), n), ("child", (i, k), i), ("child", (i, k), 0),
                          ("child", (i, k), (out["child"][i, k] + 1) % n), ("lo", (j, m, 1), np.nan), ("primitives", 3, -1),
                          ("primitives", 3, 10**6), ("primitives", 3, out["primitives"][4]), ("count", (j, m), out["count"][j, m] - 1 or 2),
                          ("count", (j, m), -7), ("count", (j, m), 65), ("count", (i, k), -1), ("child", (j, m), -5),
                          ("child", (j, m), r)][how]
    out[name][place] = value
    return out


@pytest.mark.parametrize("how", range(15))
@pytest.mark.parametrize("name", BOXES)
def test_arrays_that_are_no_tree_are_one_error_with_a_place(how: int, name: str) -> None:
    mesh = icosphere(2)
    with pytest.raises(wrt.InputError) as caught:
        wrt.accel_from_tree(mesh, damage(wrt.build(mesh, name).tree(), how))
    assert str(caught.value.place).startswith("tree") and len(str(caught.value)) < 250


def test_boxes_that_are_too_small_grow() -> None:
    mesh, tree = icosphere(2), wrt.build(icosphere(2), "bvh2").tree()
    point = replace(tree, lo=np.zeros_like(tree.lo), hi=np.zeros_like(tree.lo))
    hits, truth = (each.closest_hit(*aimed(500)) for each in (wrt.accel_from_tree(mesh, point), wrt.build(mesh)))
    assert all(np.array_equal(getattr(hits, each), getattr(truth, each)) for each in BITS)


def test_other_mistakes_are_reported(tmp_path: Path) -> None:
    mesh = icosphere(1)
    tree = wrt.build(mesh, "bvh4").tree()
    (tmp_path / "text.npz").write_text("no archive")
    cases: list[tuple[Any, str | None]] = [
        (tree, "bvh2"), (tree, "grid"), (tree, "nonsense"), ({"lo": tree.lo}, None), (tmp_path / "none.npz", None), (tree, "bvh6"),
        (replace(tree, child=np.zeros((0, 4), int)), None), (replace(tree, lo=tree.lo.astype(str)), None), (tmp_path / "text.npz", None)]
    for given, name in cases:
        with pytest.raises(wrt.InputError):
            wrt.accel_from_tree(mesh, given, name)
    with pytest.raises(wrt.InputError, match="use a BVH"):
        wrt.build(mesh, "grid").tree()
    with pytest.raises(wrt.InputError, match=r"suffix \.npz"):
        tree.save(tmp_path / "tree.txt")
