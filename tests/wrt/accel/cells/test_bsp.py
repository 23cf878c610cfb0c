"""The BSP tree: options, limits, lists of primitives, costs, and rays that lie in its splitting planes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused

from tests.kernel_tools import rounded, unit  # isort: skip (starts Warp)

from tests.kernels.traverse.test_common import GEOMETRIES, assert_same_hits, triangles
from wrt.accel.cells.trees import Bsp
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.kernels.traverse.plane_layouts import LEAF, PLANE
from wrt.kernels.traverse.planes import STACK_SIZE
from wrt.scene.shapes import icosphere


@pytest.mark.parametrize(("option", "value"), [
    ("cost_intersection", 0.0), ("samples", -1), ("max_depth", -1), ("max_depth", 61),
    ("max_depth", 3.5), ("max_growth", 0.5), ("max_growth", np.nan), ("progress", 1)])
def test_options_out_of_range_are_refused(option: str, value: float) -> None:
    with refused(option):
        build(icosphere(0), "bsp", **{option: value})


def test_a_mesh_that_is_too_large_is_refused_with_a_way_out() -> None:
    with refused("max_triangles", "max_triangles=19"):
        build(icosphere(0), "bsp", max_triangles=19)
    assert len(build(icosphere(0), "bsp", max_triangles=20).geometry) == 20


def test_threads_change_nothing() -> None:
    one, two = (build(icosphere(4), "bsp", threads=threads).built for threads in (1, 2))  # more primitives than KEEP
    for name, array in one.arrays.items():
        assert np.array_equal(array, two.arrays[name])
    assert np.array_equal(one.order, two.order)


def test_samples_decide_whether_there_are_tilted_planes() -> None:
    tree, kd = build(icosphere(3), "bsp"), build(icosphere(3), "bsp", samples=0)
    inner, of_kd = (each.built.arrays["nodes"]["axis"] for each in (tree, kd))
    assert (inner == PLANE).sum() > 0.3 * (inner < LEAF).sum() and not (of_kd == PLANE).any()


@pytest.mark.parametrize("kind", ["all_equal", "coincident", "progression", "flat", "tiny_and_huge", "long_thin"])
def test_depth_is_bounded(kind: str) -> None:
    for options in ({}, {"max_depth": 3}):
        stats = build(GEOMETRIES[kind](np.random.default_rng(2)), "bsp", **options).stats
        assert stats.depth <= options.get("max_depth", STACK_SIZE - 4) + 1


@pytest.mark.parametrize("max_growth", [1.0, 2.5, 16.0])
def test_references_are_bounded(max_growth: float) -> None:
    # Many triangles cover each point, so that ever more splits seem to pay.
    geometry = GEOMETRIES["flat"](np.random.default_rng(2))
    stats = build(geometry, "bsp", max_growth=max_growth).stats
    assert len(geometry) <= stats.references <= max_growth * len(geometry)


# --- where primitives are listed --------------------------------------------------------------------------------------


def leaves_of(tree: Bsp, point: np.ndarray) -> set[int]:
    """Return the primitives of all leaves that contain a point, to within the tolerance of a plane, in float64."""
    nodes, order = tree.built.arrays["nodes"], tree.built.order
    todo, found = [0], set()
    while todo:
        node = nodes[todo.pop()]
        axis, first, count = (int(node[name]) for name in ("axis", "first", "count"))
        if axis == LEAF:
            found |= set(order[first : first + count].tolist())
            continue
        value = point[axis] if axis < PLANE else np.dot(node["normal"].astype(np.float64), point)
        value += float(node["offset"])
        if value <= node["tolerance"] and count & 1:
            todo.append(first)
        if value >= -node["tolerance"] and count & 2:
            todo.append(first + (count & 1))
    return found


@pytest.mark.parametrize("kind", ["soup", "long_thin", "coincident", "flat", "progression", "tiny_and_huge", "mixed"])
def test_every_point_of_a_primitive_is_in_a_leaf_that_lists_it(kind: str) -> None:
    rng = np.random.default_rng(3)
    geometry = GEOMETRIES[kind](rng)
    tree = build(geometry, "bsp")
    assert isinstance(tree, Bsp)
    for _ in range(400):
        i = int(rng.integers(len(geometry)))
        if i < len(geometry.faces):
            weights = rng.dirichlet(np.full(3, 0.3))
            if rng.random() < 0.4:  # on an edge, or at a corner
                weights = np.roll([1.0 - (s := rng.choice([0.0, rng.random()])), s, 0.0], rng.integers(3))
            point = weights @ geometry.vertices[geometry.faces[i]].astype(np.float64)
        else:
            sphere = geometry.spheres[i - len(geometry.faces)].astype(np.float64)
            point = sphere[:3] + sphere[3] * unit(rng.normal(size=3))
        assert i in leaves_of(tree, point)


# --- rays in splitting planes -----------------------------------------------------------------------------------------


def rays_in_planes(geometry: Geometry, rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rays in the planes of faces, along edges and towards corners, where the tree has its splitting planes."""
    corner = geometry.vertices[geometry.faces].astype(np.float64)[rng.integers(len(geometry.faces), size=n)]
    a, b, c = (corner[np.arange(n), (rng.integers(3, size=n) + k) % 3] for k in range(3))
    inside = np.einsum("ni,nij->nj", rng.dirichlet(np.ones(3), n), corner)
    kind = (np.arange(n) % 4)[:, None]
    target = np.where(kind == 0, inside, np.where(kind == 1, a + rng.random((n, 1)) * (b - a), a))
    along = np.where(kind == 2, b - a, rng.normal(size=(n, 1)) * (b - a) + rng.normal(size=(n, 1)) * (c - a))
    along = np.where(kind == 3, rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-9, 0, (n, 3)), along)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / np.where(length > 0.0, length, 1.0) * (np.abs(geometry.vertices).max() + 1e-30)
    origin = rounded(target - along * rng.choice([0.0, 0.3, 3.0], (n, 1)))
    direction = rounded(np.where(rng.random((n, 1)) < 0.5, along, target + along - origin))
    direction[~direction.any(axis=1), 0] = 1.0
    return origin, direction


def turned_grid(rng: np.random.Generator) -> Geometry:
    """Return a curved, rotated sheet of squares. Neighbours share corners and are nearly coplanar."""
    n = 12
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    vertices = np.stack([i, j, 0.02 * (i - j) ** 2], axis=-1).reshape(-1, 3) / n
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    faces = np.concatenate([first + np.array([0, n, n + 1]), first + np.array([0, n + 1, 1])])
    return triangles((vertices @ turn.T)[faces])


HARD = {**{kind: GEOMETRIES[kind] for kind in ("soup", "long_thin", "flat", "progression", "tiny_and_huge")},
        "turned_grid": turned_grid, "ball": lambda rng: Geometry.of(icosphere(3))}


@pytest.mark.parametrize("kind", HARD)
def test_rays_within_the_trees_planes_lose_nothing(kind: str) -> None:
    rng = np.random.default_rng(4)
    geometry = HARD[kind](rng)
    tree, brute = build(geometry, "bsp"), build(geometry, "brute_force")
    origin, direction = rays_in_planes(geometry, rng, 8000)
    expected = brute.closest_hit(origin, direction)
    assert_same_hits(tree.closest_hit(origin, direction), expected)
    # A segment that begins and ends at the hit: the tree may not cut off the cell where the hit's triangle is listed.
    on = expected.prim_id >= 0
    t = expected.t[on]
    assert on.sum() > 100
    assert_same_hits(tree.closest_hit(origin[on], direction[on], t, t), brute.closest_hit(origin[on], direction[on], t, t))
    assert tree.any_hit(origin[on], direction[on], t, t).all()


# --- arrays from a file -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("field", "row", "value", "message"), [
    ("first", 0, 0, "form a tree"), ("first", 0, 10**8, "form a tree"), ("count", 0, 0, "axis or count"), ("count", 0, 4, "axis or count"),
    ("count", 0, 1, "form a tree"), ("axis", 2, 5, "axis or count"), ("axis", 2, -1, "axis or count"), ("axis", 0, LEAF, "form a tree"),
    ("first", -1, -1, "leads out"), ("count", -1, 10**8, "leads out")])
def test_a_damaged_tree_is_refused(field: str, row: int, value: int, message: str) -> None:
    tree = build(icosphere(2), "bsp")
    nodes = tree.built.arrays["nodes"].copy()
    assert nodes["count"][0] == 3 and nodes["axis"][-1] == LEAF
    nodes[field][row] = value
    spoiled = replace(tree.built, arrays=tree.built.arrays | {"nodes": nodes})
    with refused(what=message):
        Bsp.restore(spoiled, tree.geometry)
    assert isinstance(Bsp.restore(tree.built, tree.geometry), Bsp)
