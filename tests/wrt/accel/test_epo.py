"""End-point overlap agrees with its definition in exact arithmetic, and with cases computed by hand."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import pytest

from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.scenes.build import build
from wrt.kernels.wide.references import leaf_count, leaf_first
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

Node = tuple[np.ndarray, np.ndarray, int, set[int]]  # low and high corner, cost, primitives in the subtree


def binary_nodes(accel: Accelerator, index: int = 0) -> Iterator[Node]:
    """Yield all boxes of a bvh2 below an inner node."""
    node, order = accel.data.nodes.numpy()[index], accel.built.order
    for side in "01":
        lo, hi, first, count = (node[f"{part}_{side}"] for part in ("lo", "hi", "first", "count"))
        if lo[0] > hi[0]:
            continue
        below = list(binary_nodes(accel, int(first))) if count == 0 else []
        own = set(order[first : first + count].tolist()).union(*(node[3] for node in below))
        yield from below
        yield lo, hi, max(int(count), 1), own


def wide_nodes(accel: Accelerator, index: int = 0) -> Iterator[Node]:
    """Yield all boxes of a wide BVH below an inner node."""
    tree = accel._tree(accel.built)  # type: ignore[attr-defined]
    for lo, hi, code in zip(tree.lo[index], tree.hi[index], tree.children[index].tolist(), strict=True):
        if code == 0:
            continue
        below = list(wide_nodes(accel, code)) if code > 0 else []
        first, count = (leaf_first.func(code), leaf_count.func(code)) if code < 0 else (0, 1)
        own = set(tree.order[first:].reshape(-1)[:count].tolist() if code < 0 else ()).union(*(node[3] for node in below))
        yield lo, hi, count, own
        yield from below


def share_inside(triangle: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> Fraction:
    """Return the exact share of a triangle's area that is inside a box."""
    corners = [[Fraction(float(x)) for x in corner] for corner in triangle]
    a, b = ([y - x for x, y in zip(corners[0], corners[i], strict=True)] for i in (1, 2))
    normal = [abs(a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2]) for i in range(3)]
    along = max(range(3), key=lambda i: normal[i])
    polygon = corners
    for axis in range(3):
        for end, sign in ((float(lo[axis]), 1), (float(hi[axis]), -1)):
            inside = [sign * (p[axis] - Fraction(end)) if math.isfinite(end) else 1 for p in polygon]
            out = []
            for i, p in enumerate(polygon):
                if inside[i - 1] * inside[i] < 0:
                    t = inside[i - 1] / (inside[i - 1] - inside[i])
                    out.append([x + t * (y - x) for x, y in zip(polygon[i - 1], p, strict=True)])
                if inside[i] >= 0:
                    out.append(p)
            polygon = out
    x, y = along - 2, along - 1
    doubled = sum((polygon[i - 1][x] * p[y] - polygon[i - 1][y] * p[x] for i, p in enumerate(polygon)), Fraction(0))
    return abs(doubled) / normal[along]


def by_definition(accel: Accelerator) -> float:
    geometry = accel.geometry
    corners = geometry.vertices[geometry.faces]
    edges = np.where(np.isfinite(corners).all(axis=(1, 2), keepdims=True), corners[:, 1:].astype(np.float64) - corners[:, :1], 0.0)
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    nodes = binary_nodes(accel) if accel.name == "bvh2" else wide_nodes(accel)
    total = 0.0
    for lo, hi, cost, own in nodes:
        for i in np.nonzero(areas > 0.0)[0].tolist():
            if i not in own and (corners[i].min(axis=0) <= hi).all() and (corners[i].max(axis=0) >= lo).all():
                total += cost * areas[i] * float(share_inside(corners[i], lo, hi))
    return total / areas.sum()


def soup(n: int) -> Geometry:
    """Return spheres and overlapping triangles. Some triangles are axis-aligned, repeated, or without area."""
    rng = np.random.default_rng(1)
    corners = rng.uniform(-1.0, 1.0, (n, 1, 3)) + 0.4 * rng.normal(size=(n, 3, 3))
    corners[::5, :, 1] = 0.25
    corners[3], corners[7, 2] = corners[8], corners[7, 1]
    spheres = np.array([[0.0, 0.0, 0.0, 0.5], [0.5, 0.0, 0.1, 0.2]], np.float32)
    return Geometry(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * n, dtype=np.int32).reshape(-1, 3), spheres)


@pytest.mark.parametrize("name, options", [
    ("bvh2", {}), ("bvh2", {"builder": "median", "max_leaf": 1}), ("bvh2", {"builder": "sbvh"}), ("bvh4", {}), ("bvh8", {})])
def test_as_defined(name: str, options: dict) -> None:
    accel = build(soup(60), name, **options)
    epo = accel.epo()
    assert epo > 0.5
    assert epo == pytest.approx(by_definition(accel), rel=1e-9)
    assert epo == pytest.approx(build(soup(60), name, threads=1, **options).epo(), rel=1e-12)


@pytest.mark.parametrize("name", ["bvh2", "bvh8"])
def test_faces_that_are_not_finite_have_no_surface(name: str) -> None:
    of = soup(60)
    vertices = np.concatenate([of.vertices, np.float32([[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]])])
    accel = build(Geometry(vertices, np.concatenate([of.faces, np.int32([[0, 1, 180], [181, 2, 3]])]), of.spheres), name)
    assert accel.epo() == pytest.approx(by_definition(accel), rel=1e-9)


def test_by_hand() -> None:
    # Two squares of two triangles each, one above the other: no box contains surface of the other square.
    square = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    apart = Mesh(np.concatenate([square, square + [0, 0, 1]]), np.concatenate([faces, faces + 4]))
    assert build(apart, "bvh2", max_leaf=2).epo() == pytest.approx(0.0, abs=1e-5)
    # Two overlapping squares in one plane, one leaf each: half of each is in the box of the other, at the cost of two tests.
    moved = Mesh(np.concatenate([square, square + [1, 0, 0]]), np.concatenate([faces, faces + 4]))
    accel = build(moved, "bvh2", builder="median", max_leaf=2)
    assert len({tuple(sorted(p // 2 for p in own)) for _, _, _, own in binary_nodes(accel)}) == 2
    assert accel.epo() == pytest.approx(0.5 * 2.0, rel=1e-5)


def test_of_nothing_and_of_what_is_no_bvh() -> None:
    only_spheres = Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), soup(9).spheres)
    assert build(only_spheres, "bvh2").epo() == 0.0
    for name in ("brute_force", "kdtree"):
        with refused(what="no tree of boxes"):
            build(icosphere(0), name).epo()
