"""BVHs of spheres and 14-DOPs: volumes contain their subtrees and are tight."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kernels.traverse.test_common import GEOMETRIES
from wrt.accel.bvh.builders import BVH_BUILDERS
from wrt.accel.bvh.volumes import cuts, project
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.scene.shapes import icosphere

BALL = icosphere(3)
KINDS = ["soup", "coincident", "flat", "progression", "mixed", "only_spheres", "one", "one_sphere"]


def below(nodes: np.ndarray, order: np.ndarray) -> list[tuple[int, str, np.ndarray]]:
    """Return (node, side, primitives in the subtree) for every existing child."""
    out, inside = [], {}
    for i in reversed(range(len(nodes))):
        for side in "01":
            first, count = int(nodes[i]["first_" + side]), int(nodes[i]["count_" + side])
            members = order[first : first + count] if count else np.concatenate([inside.get((first, s), []) for s in "01"])
            if first > i or count:
                inside[i, side] = members.astype(int)
                out.append((i, side, inside[i, side]))
    return out


def of_all_sizes(rng: np.random.Generator) -> Geometry:
    """Return triangles for which the builder "refined" moves some subtrees."""
    n = 2000
    corners = rng.uniform(-1.0, 1.0, (n, 1, 3)) + rng.uniform(-1.0, 1.0, (n, 3, 3)) * 10.0 ** rng.uniform(-3.0, 0.0, (n, 1, 1))
    faces = np.arange(3 * n, dtype=np.int32).reshape(-1, 3)
    return Geometry(corners.reshape(-1, 3).astype(np.float32), faces, np.zeros((0, 4), np.float32))


@pytest.mark.parametrize("kind", [*KINDS, "of_all_sizes"])
@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_spheres_hold_the_boxes_below_them(kind: str, builder: str) -> None:
    geometry = {**GEOMETRIES, "of_all_sizes": of_all_sizes}[kind](np.random.default_rng(1))
    accel = build(geometry, "bvh2_sphere", builder=builder)
    lo, hi = (b.astype(np.float64) for b in geometry.bounds())
    nodes = accel.built.arrays["nodes"]
    for i, side, members in below(nodes, accel.built.order):
        sphere = nodes[i]["sphere_" + side].astype(np.float64)
        farthest = np.maximum(np.abs(lo[members] - sphere[:3]), np.abs(hi[members] - sphere[:3]))
        assert np.sqrt((farthest**2).sum(axis=1)).max() <= sphere[3]


@pytest.mark.parametrize("kind", KINDS)
def test_planes_hold_the_triangles_and_spheres_below_them(kind: str) -> None:
    geometry = GEOMETRIES[kind](np.random.default_rng(1))
    accel = build(geometry, "bvh2_kdop")
    nodes, middle = accel.built.arrays["nodes"], accel.built.arrays["middle"].astype(np.float64)
    corners = project(geometry.vertices - middle)[geometry.faces]
    centers, reach = project(geometry.spheres[:, :3] - middle), np.sqrt(3.0) * geometry.spheres[:, 3:].astype(np.float64)
    lo, hi = np.concatenate([corners.min(axis=1), centers - reach]), np.concatenate([corners.max(axis=1), centers + reach])
    for i, side, members in below(nodes, accel.built.order):
        assert (nodes[i]["cut_lo_" + side] < lo[members].min(axis=0)).all()
        assert (nodes[i]["cut_hi_" + side] > hi[members].max(axis=0)).all()


def test_a_sphere_around_a_ball_is_hardly_larger_than_the_ball() -> None:
    # Each child has half of the ball, and the smallest sphere around half a ball is the whole ball.
    nodes = build(icosphere(4), "bvh2_sphere").built.arrays["nodes"]
    for side in "01":
        assert 0.98 < nodes[0]["sphere_" + side][3] < 1.06


@pytest.mark.parametrize("name", ["bvh2_sphere", "bvh2_kdop"])
def test_refit_follows_the_vertices(name: str) -> None:
    rng = np.random.default_rng(4)
    geometry = Geometry(BALL.vertices, BALL.faces, np.array([[0.0, 0.0, 3.0, 0.5]], np.float32))
    accel = build(geometry, name)
    assert accel.refit(BALL.vertices).growth == pytest.approx(1.0)
    moved = (BALL.vertices * [1.0, 0.5, 2.0] + 0.1 * rng.normal(size=BALL.vertices.shape)).astype(np.float32)
    accel.refit(moved)
    origins, directions = rng.normal(size=(2, 3000, 3)).astype(np.float32)
    truth = build(Geometry(moved, BALL.faces, geometry.spheres), "brute_force").closest_hit(origins, directions)
    hits = accel.closest_hit(origins, directions)
    for field in ("prim_id", "t", "u", "v"):
        np.testing.assert_array_equal(getattr(hits, field), getattr(truth, field))


def test_planes_beyond_float32_keep_nothing_out() -> None:
    corners = np.array([[3e37, 0, 0], [0, 3e37, 0], [0, 0, 3e37]], np.float32)
    geometry = Geometry(corners, np.array([[0, 1, 2]], np.int32), np.zeros((0, 4), np.float32))
    lo, hi = cuts(geometry, np.array([-3e38, -3e38, -3e38], np.float32))
    assert (lo == -np.inf).all() and (hi == np.inf).all()


@pytest.mark.parametrize("name", ["bvh2_sphere", "bvh2_kdop"])
def test_denormal_meshes_are_hit_as_by_brute_force(name: str) -> None:
    rng = np.random.default_rng(2)
    corners = rng.integers(-90, 91, (300, 3)) * np.float32(2.0**-149)
    geometry = Geometry(corners.astype(np.float32), rng.integers(0, 300, (100, 3)).astype(np.int32), np.zeros((0, 4), np.float32))
    origins = (rng.integers(-90, 91, (2000, 3)) * np.float32(2.0**-149)).astype(np.float32)
    directions = corners[rng.integers(0, 300, 2000)] - origins
    directions[~directions.any(axis=1)] = 1.0
    expected, hits = (build(geometry, each).closest_hit(origins, directions) for each in ("brute_force", name))
    assert (expected.prim_id >= 0).mean() > 0.5
    np.testing.assert_array_equal(hits.t, expected.t)
    np.testing.assert_array_equal(hits.prim_id, expected.prim_id)
