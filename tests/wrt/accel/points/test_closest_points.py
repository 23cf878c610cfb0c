"""Closest points agree with float64, and do not depend on the tree."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

import wrt
from tests.refused import refused
from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.geometry import Geometry
from wrt.scene.clean import has_area
from wrt.scene.shapes import icosphere, torus


def oracle(mesh: Any, points: np.ndarray) -> np.ndarray:
    """Return the distance to each triangle, (N, F) in long double: to its plane if the point projects into it, else to its sides.
    For a triangle without area, the sides are the whole triangle."""
    p = points.astype(np.longdouble)[:, None]
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.longdouble) for i in range(3))
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(axis=1)
    above, nearest = np.tile(area > 0.0, (len(points), 1)), np.full((len(points), len(a)), np.longdouble(np.inf))
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        above &= (np.cross(edge, p - start) * normal).sum(axis=2) >= 0
        size = (edge * edge).sum(axis=1)
        t = np.clip(((p - start) * edge).sum(axis=2) / np.where(size > 0.0, size, 1.0), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm((p - start - t[..., None] * edge).astype(float), axis=2))
    height = np.abs(((p - a) * normal).sum(axis=2)) / np.sqrt(np.where(area > 0.0, area, 1.0))
    return np.where(above, height, nearest)


def slenderness(mesh: Any) -> float:
    """Return the largest ratio of a triangle's length to its height."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    longest = np.max([np.linalg.norm(edge, axis=1) for edge in (b - a, c - b, a - c)], axis=0)
    return float((longest / np.linalg.norm(np.cross((b - a) / longest[:, None], c - a), axis=1)).max())


def around(mesh: Any, n: int, seed: int = 0) -> np.ndarray:
    """Return points inside, on, near and far from a mesh, also above corners and sides."""
    rng = np.random.default_rng(seed)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    out = rng.uniform(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, (n, 3))
    out[: n // 8] = mesh.vertices[rng.integers(0, len(mesh.vertices), n // 8)]
    corners = mesh.vertices[mesh.faces[rng.integers(0, len(mesh.faces), n // 4)]]
    out[n // 8 : n // 8 + n // 4] = (corners * rng.dirichlet((0.3, 0.3, 0.3), n // 4)[..., None]).sum(axis=1)
    out[-8:] += 100.0 * (high - low)
    return out.astype(np.float32)


def needles() -> wrt.Mesh:
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(200, 1, 3)) + np.float64([1.0, 1.0, 1e-5])[None, :, None] * rng.normal(size=(200, 3, 3))
    corners[:, 2] = corners[:, 0] + 0.5 * (corners[:, 1] - corners[:, 0]) + 1e-5 * rng.normal(size=(200, 3))
    return wrt.Mesh(corners.reshape(-1, 3), np.arange(600).reshape(-1, 3))


def turned(mesh: wrt.Mesh, scale: float, *far: float) -> wrt.Mesh:
    matrix = scale * Rotation.random(random_state=3).as_matrix()
    return wrt.Mesh(np.float32(mesh.vertices @ matrix.T + np.float64(far or 0.0)), mesh.faces)


MESHES = {"ball": icosphere(2), "ring": turned(torus(segments=16, tube_segments=8), 0.7, 3.0, -2.0, 1.0), "needles": needles(),
          "tiny": turned(icosphere(1), 1e-28), "huge": turned(icosphere(1), 1e27), "far": turned(icosphere(1), 1.0, 1e4, 0.0, 1e4)}


@pytest.mark.filterwarnings("ignore:.* float32 vertices lie up to")
@pytest.mark.parametrize("name", MESHES)
def test_distances_are_those_of_float64(name: str) -> None:
    mesh = MESHES[name]
    points, coordinates = around(mesh, 600), np.abs(mesh.vertices).max()
    rounding = 1e-15 * coordinates * slenderness(mesh)
    found, distances = wrt.closest_points(wrt.build(mesh, "bvh8"), points), oracle(mesh, points)
    error = np.abs(found.distance - distances.min(axis=1))
    assert (error <= 2.0**-23 * distances.min(axis=1) + rounding).all()
    own = np.take_along_axis(distances, found.prim_id[:, None].astype(np.int64), axis=1)[:, 0]
    assert (own <= distances.min(axis=1) * (1 + 1e-9) + rounding).all()
    corners = mesh.vertices[mesh.faces[found.prim_id]].astype(np.float64)
    weights = np.stack([1.0 - found.u - found.v, found.u, found.v], axis=1).astype(np.float64)
    size = np.abs(corners - corners[:, :1]).max(axis=(1, 2), initial=0.0)
    assert np.abs((corners * weights[..., None]).sum(axis=1) - found.point).max() < 4e-7 * (coordinates + size.max())
    apart = np.linalg.norm(found.point.astype(np.float64) - points, axis=1)
    assert (np.abs(apart - found.distance) <= 2.0**-22 * (coordinates + found.distance)).all()
    assert (weights >= -1e-7).all() and found.point.dtype == np.float32 and found.prim_id.dtype == np.int32


def test_every_tree_says_the_same() -> None:
    for name in ("ring", "needles"):
        mesh, points = MESHES[name], around(MESHES[name], 2000, 5)
        answers = set()
        for kind, options in (("bvh8", {}), ("bvh8", {"builder": "median", "max_leaf": 3}), ("bvh4", {}), ("bvh8c", {})):
            found = wrt.closest_points(wrt.build(mesh, kind, **options), points, threads=1)
            answers.add(tuple(array.tobytes() for array in (found.distance, found.point, found.u, found.v, found.prim_id)))
        assert len(answers) == 1


def test_of_equal_ones_the_lowest_is_told() -> None:
    """Outside of a ball, above a corner or an edge, all faces there are at the same distance."""
    ball = icosphere(2)
    found = wrt.closest_points(wrt.build(ball, "bvh8"), 2.0 * ball.vertices)
    first = np.array([np.flatnonzero((ball.faces == i).any(axis=1)).min() for i in range(len(ball.vertices))])
    assert np.array_equal(found.prim_id, first) and np.array_equal(found.point, ball.vertices)
    edges, face = np.sort(ball.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), np.repeat(np.arange(len(ball.faces)), 3)
    edges, first = np.unique(edges, axis=0, return_index=True)
    above = wrt.closest_points(wrt.build(ball, "bvh8"), ball.vertices[edges].sum(axis=1))
    assert np.array_equal(above.prim_id, face[first])
    twice = wrt.Mesh(ball.vertices, np.concatenate([ball.faces, ball.faces[::-1]]))
    points = around(ball, 500)
    mine, other = (wrt.closest_points(wrt.build(mesh, "bvh8"), points) for mesh in (ball, twice))
    assert (other.prim_id < len(ball.faces)).all() and np.array_equal(mine.prim_id, other.prim_id)


@pytest.mark.parametrize("alike", ((), (0,), (0, 1)))
def test_at_a_common_edge_both_faces_are_equally_close(alike: tuple[int, ...]) -> None:
    """alike: the coordinates in which the edge's ends agree. Whichever way a face runs along the edge, the lowest face is the answer."""
    rng = np.random.default_rng(len(alike))
    for _ in range(20):
        a, b = rng.normal(size=(2, 3)).astype(np.float32)
        b[list(alike)] = a[list(alike)]
        out = np.cross(b - a, rng.normal(size=3))
        out /= np.linalg.norm(out)
        side = np.cross(b - a, out)
        middle = 0.5 * (a + b)
        mesh = wrt.Mesh(np.stack([a, b, middle - out + side, middle - out - side]).astype(np.float32), np.array([[0, 1, 2], [1, 0, 3]]))
        points = middle + rng.uniform(-0.4, 0.4, (500, 1)) * (b - a) + rng.uniform(0.1, 2.0, (500, 1)) * out
        found = wrt.closest_points(wrt.build(mesh, "bvh8"), points.astype(np.float32))
        assert (found.prim_id == 0).all()


def test_signed_distances() -> None:
    box = wrt.build(wrt.Mesh.from_trimesh(trimesh.creation.box()), "bvh8")
    found = wrt.signed_distance(box, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.4], [0.0, 0.0, 2.0], [1.5, 1.5, 0.0]])
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [-0.5, -0.1, 1.5, np.sqrt(2.0)], rtol=1e-6)


def half_flat(n: int, seed: int) -> wrt.Mesh:
    """Return triangles on a lattice. Every second triangle is a segment or a point. A segment has its corners in any order, and two
    of them may be equal."""
    rng = np.random.default_rng(seed)
    start, step = rng.integers(-64, 65, (n, 3)), rng.integers(-3, 4, (n, 3))
    along = rng.permuted(np.array([[0, 0, 0], [0, 0, 4], [0, 1, 3], [0, 3, 7]])[rng.integers(0, 4, n)], axis=1)
    flat = start[:, None] + along[..., None] * step[:, None]
    corners = np.where((np.arange(n) % 2 == 0)[:, None, None], flat, start[:, None] + rng.integers(-16, 17, (n, 3, 3)))
    return wrt.Mesh(corners.reshape(-1, 3) / 32.0, np.arange(3 * n).reshape(-1, 3))


@pytest.mark.parametrize("seed", range(3))
def test_a_face_without_area_is_the_segment_or_the_point_that_it_is(seed: int) -> None:
    mesh = half_flat(400, seed)
    flat, points = ~has_area(mesh.vertices, mesh.faces), around(mesh, 1000, seed)
    distances = oracle(mesh, points)
    nearest = distances.min(axis=1)
    assert 200 <= flat.sum() < 250 and 0.2 < flat[distances.argmin(axis=1)].mean() < 0.8
    answers = set()
    for kind in ("bvh8", "bvh4", "bvh8c"):
        accel = wrt.build(mesh, kind)
        found = wrt.closest_points(accel, points)
        assert (np.abs(found.distance - nearest) <= 2.0**-23 * nearest + 1e-13).all()
        own = np.take_along_axis(distances, found.prim_id[:, None].astype(np.int64), axis=1)[:, 0]
        assert (own <= nearest * (1 + 1e-9) + 1e-13).all()
        weights = np.stack([1.0 - found.u - found.v, found.u, found.v], axis=1)
        assert np.abs((mesh.vertices[mesh.faces[found.prim_id]] * weights[..., None]).sum(axis=1) - found.point).max() < 2e-6
        answers.add(tuple(array.tobytes() for array in (found.distance, found.point, found.u, found.v, found.prim_id)))
        assert not flat[accel.closest_hit(points, mesh.vertices[:1000] - points + np.float32(1e-3)).prim_id].any()
    assert len(answers) == 1


def spoilt(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (F, 3, 3) of triangles, and the mask (F,) of triangles with one or more corners that are not finite."""
    rng = np.random.default_rng(seed)
    corners = np.float32(rng.uniform(-1.0, 1.0, (60, 1, 3)) + 0.3 * rng.normal(size=(60, 3, 3)))
    bad = rng.random((60, 3, 3)) < 0.02
    bad[::11, seed % 3, 1] = True
    corners[bad] = rng.choice(np.float32([np.nan, np.inf, -np.inf]), int(bad.sum()))
    return corners, bad.any(axis=(1, 2))


@pytest.mark.parametrize("seed", range(3))
def test_a_face_with_a_corner_that_is_not_finite_is_in_no_answer(seed: int) -> None:
    """A face is ignored if any corner is not finite. The values of a Geometry and of arrays on a device are not checked."""
    corners, bad = spoilt(seed)
    vertices, faces = corners.reshape(-1, 3), np.arange(180, dtype=np.int32).reshape(-1, 3)
    none = np.zeros((0, 4), np.float32)
    rest, number = wrt.build(Geometry(vertices, faces[~bad], none), "bvh8"), np.append(np.flatnonzero(~bad), -1)
    points = np.random.default_rng(seed).uniform(-2.0, 2.0, (400, 3))
    expected, hits = wrt.closest_points(rest, points), rest.closest_hit(points, points[::-1] - points)
    turns, crossings = wrt.winding_number(rest, points), wrt.count_hits(rest, points, points[::-1] - points)
    on_device = wp.array(vertices, dtype=wp.vec3, device="cpu"), wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu")
    for geometry in (Geometry(vertices, faces, none), DeviceGeometry(*on_device)):
        for kind in ("bvh8", "bvh4", "bvh8c"):
            accel = wrt.build(geometry, kind)
            found = wrt.closest_points(accel, points)
            assert np.array_equal(found.prim_id, number[expected.prim_id]) and np.array_equal(found.distance, expected.distance)
            assert np.array_equal(accel.closest_hit(points, points[::-1] - points).prim_id, number[hits.prim_id])
            assert np.array_equal(wrt.count_hits(accel, points, points[::-1] - points), crossings)
            assert np.array_equal(wrt.winding_number(accel, points), turns)


def test_no_faces_and_no_points() -> None:
    empty = wrt.build((np.zeros((1, 3)), np.zeros((0, 3), np.int32)), "bvh8")
    found = wrt.closest_points(empty, np.zeros((2, 3)))
    assert np.isinf(found.distance).all() and found.prim_id.tolist() == [-1, -1] and not found.point.any()
    assert len(wrt.closest_points(wrt.build(icosphere(1), "bvh8"), np.zeros((0, 3)))) == 0


def test_what_is_refused() -> None:
    ball = icosphere(1)
    for accel, points, told in (
            (wrt.build(ball, "kdtree"), np.zeros((1, 3)), (None, "bvh4, bvh8")),
            (wrt.build(ball, "bvh8", triangle="plane"), np.zeros((1, 3)), (None, "bvh8 with 'plane'")),
            (wrt.build([ball, ball]), np.zeros((1, 3)), ("world", "2 worlds")), (5, np.zeros((1, 3)), ("accel", "got 5")),
            (wrt.build(ball), np.zeros((1, 2)), ("points", "(..., 3)")),
            (wrt.build(ball), [[np.nan, 0, 0]], ("points", "finite"))):
        with refused(*told):
            wrt.closest_points(accel, points)  # type: ignore[arg-type]
