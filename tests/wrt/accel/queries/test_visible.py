"""Visibility between pairs of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import vec3s
from tests.placed import place
from tests.refused import Refusal, refused
from wrt.accel.geometry import Geometry
from wrt.core.arrays import to_numpy
from wrt.scene import shapes


def pairs(n: int = 20_000, scale: float = 1.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return tuple(np.float32(scale * 1.5 * rng.normal(size=(n, 3))) for _ in range(2))  # type: ignore[return-value]


def soup(seed: int = 0) -> wrt.Mesh:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.0, 1.0, (60, 1, 3)) + 0.4 * rng.normal(size=(60, 3, 3))
    return wrt.Mesh(corners.reshape(-1, 3), np.arange(180).reshape(-1, 3))


def unit_vectors(n: int, seed: int) -> np.ndarray:
    way = np.random.default_rng(seed).normal(size=(n, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def sphere(center: float, radius: float) -> Geometry:
    return Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.float32([[center] * 3 + [radius]]))


@pytest.mark.parametrize("seed", range(3))
def test_between_points_in_space_it_is_what_testing_every_triangle_says(seed: int) -> None:
    """The reference uses Plücker coordinates in float64. Pairs closer to an edge than rounding errors are excluded."""
    mesh, (a, b) = soup(seed), pairs(2000, seed=seed)
    p, q = a.astype(np.float64)[:, None], b.astype(np.float64)[:, None]
    v = mesh.vertices[mesh.faces].astype(np.float64)

    def volume(*corners: np.ndarray) -> np.ndarray:
        return np.einsum("...i,...i->...", np.cross(corners[1] - corners[0], corners[2] - corners[0]), corners[3] - corners[0])

    ends = np.stack([volume(v[:, 0], v[:, 1], v[:, 2], p), -volume(v[:, 0], v[:, 1], v[:, 2], q)])
    sides = np.stack([volume(p, q, v[:, i], v[:, (i + 1) % 3]) for i in range(3)])
    meets = (ends > 0).all(axis=0) | (ends < 0).all(axis=0)
    meets &= (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
    clear = (np.abs(np.concatenate([ends, sides])) > 1e-4).all(axis=(0, 2))
    seen = wrt.visible(wrt.build(mesh), a, b)
    assert seen.dtype == bool and clear.mean() > 0.8
    assert np.array_equal(seen[clear], ~meets.any(axis=1)[clear]) and 0.2 < seen.mean() < 0.9


@pytest.mark.parametrize("name", ["bvh", "bvh2"])
def test_whoever_is_seen_sees(name: str) -> None:
    """Visibility is symmetric, also for points on surfaces, for pairs that touch edges and corners, and with on_a and on_b."""
    mesh = soup()
    accel = wrt.build(mesh, name)
    a, b = pairs()
    at = np.random.default_rng(1).integers(0, len(mesh.vertices), len(a))
    a[::3], b[1::5] = mesh.vertices[at[::3]], mesh.vertices[at[::-1][1::5]]
    b[::7] = a[::7]
    assert np.array_equal(wrt.visible(accel, a, b), wrt.visible(accel, b, a))
    on_a, on_b = at // 3, at[::-1] // 3
    known = wrt.visible(accel, a, b, on_a, on_b, threads=1)
    assert np.array_equal(known, wrt.visible(accel, b, a, on_b, on_a, threads=2))
    assert known[::7].all() and 0.1 < known.mean() < 0.9


@pytest.mark.filterwarnings("ignore:.* float32 vertices lie up to")
def test_points_on_a_convex_surface_see_all_outside_that_is_in_front_of_them() -> None:
    """Each point is a hit point; the other end is in front of the triangle's plane, often near the plane. Nothing may block."""
    ball = shapes.icosphere(3)
    for offset in (0.0, 3000.0):
        mesh = wrt.Mesh(ball.vertices + np.float32(offset), ball.faces)
        accel = wrt.build(mesh)
        rng = np.random.default_rng(2)
        origin = np.float32(3.0 * rng.normal(size=(20_000, 3)) + offset)
        at = rng.integers(0, len(mesh.vertices), 20_000)
        hits = accel.closest_hit(origin, np.float32(mesh.vertices[at] - origin))
        hit = hits.prim_id >= 0
        point, normal, on = hits.point[hit], hits.normal[hit].astype(np.float64), hits.prim_id[hit]
        angle = 10.0 ** rng.uniform(-2.0, 0.0, (len(on), 1))
        along = np.cross(normal, rng.normal(size=normal.shape))
        other = np.float32(point + 2.0 * along + 2.0 * angle * normal)
        way = other.astype(np.float64) - point
        # Only pairs in front of the neighbouring faces, too; no other face of a convex body can block.
        height = np.einsum("ij,ij->i", way, normal) / np.linalg.norm(way, axis=1)
        front = (height > 0.15) if offset == 0.0 else height > 0.3
        assert front.sum() > 1000 and wrt.visible(accel, point, other, on)[front].all()
        behind = np.float32(point - 0.5 * normal)
        assert wrt.visible(accel, point, behind, on)[np.linalg.norm(behind - offset, axis=1) < 0.9].all()  # also from inside
        assert not wrt.visible(accel, behind, other, None, None)[front].any()


def test_along_a_floor_of_many_triangles() -> None:
    """From hit points on a plane, no triangle of the plane blocks, at any angle."""
    n, rng = 24, np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-40.0, 60.0, n), np.linspace(-30.0, 70.0, n))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) @ turn.T
    corner = np.arange(n * n).reshape(n, n)
    faces = np.concatenate([np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:]], axis=-1).reshape(-1, 3),
                            np.stack([corner[:-1, :-1], corner[1:, 1:], corner[1:, :-1]], axis=-1).reshape(-1, 3)])
    accel = wrt.build((vertices, faces))
    above = rng.uniform(-20.0, 40.0, (5000, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 5.0]
    hits = accel.closest_hit(above @ turn.T, (rng.normal(size=(5000, 3)) * [1.0, 1.0, 0.1] - [0.0, 0.0, 1.0]) @ turn.T)
    hit = hits.prim_id >= 0
    lamp = rng.uniform(-20.0, 40.0, (int(hit.sum()), 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1e-3]
    lamp = np.float32(lamp @ turn.T)
    assert hit.sum() > 3000 and not wrt.visible(accel, hits.point[hit], lamp).all()
    assert wrt.visible(accel, hits.point[hit], lamp, hits.prim_id[hit]).all()


def test_the_ends_are_left_out() -> None:
    accel = wrt.build(shapes.quad())  # z = 0
    a, b = np.float32([[0.1, 0.2, 0.0]]), np.float32([[0.3, 0.1, 2.0]])
    for p, q, seen in ((a, b, True), (-b, a, True), (-b, b, False), (a, a, True), (b, b, True),
                       (b, b * [1, 1, 0.5], True), (a + np.float32([0, 0, 1e-3]), -b, False)):
        assert wrt.visible(accel, p, q).tolist() == [seen] == wrt.visible(accel, q, p).tolist()
    assert wrt.visible(accel, np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("far", [1e3, 3e5, 1e6, 1e12, 1e30])
def test_an_end_far_away_takes_nothing_from_what_is_near_the_other(far: float) -> None:
    """A ball between two points blocks, and a ball beside their segment does not, however far away one point is."""
    ball, rng = shapes.icosphere(3), np.random.default_rng(4)
    accels = [wrt.build(ball), wrt.build(place((Geometry.of(ball), np.eye(4)))), wrt.build(sphere(0.0, 1.0))]
    near, way = np.float32(2.0 * unit_vectors(500, 5)), unit_vectors(500, 6)
    aside = way - (way * near).sum(axis=1, keepdims=True) * near / 4.0
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    through = np.float32(far * (-near / 2.0 + 0.3 * rng.random((500, 1)) * aside))  # within 20 degrees of the centre: it is 30 wide
    past = np.float32(far * (-near / 2.0 + 0.8 * aside))
    for accel in accels:
        for p, q, seen in ((near, through, False), (near, past, True)):
            assert (wrt.visible(accel, p, q) == seen).all() and (wrt.visible(accel, q, p) == seen).all()


@pytest.mark.parametrize("far", [2.0, 1e3, 1e6])
@pytest.mark.parametrize("name", ["ball", "floor", "patch"])
def test_a_hit_sees_where_it_was_seen_from(name: str, far: float) -> None:
    """This holds also near the coordinate origin on a large triangle whose corners are far away."""
    turn = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    floor = shapes.quad()
    mesh = shapes.icosphere(3) if name == "ball" else wrt.Mesh(floor.vertices @ turn.T, floor.faces)
    on_floor = np.random.default_rng(9).uniform(-0.9, 0.9, (5000, 3)) * [1.0, 1.0, 0.0] @ turn.T
    at = 0.9 * unit_vectors(5000, 8) if name == "ball" else on_floor
    at = np.float32(at * (1e-3 if name == "patch" else 1.0))
    eye = np.float32(at + far * unit_vectors(5000, 10))
    accel = wrt.build(mesh)
    hits = accel.closest_hit(eye, at - eye)
    cosine = np.abs((hits.normal * (at - eye)).sum(axis=1)) / np.linalg.norm(at - eye, axis=1)
    rows = np.flatnonzero((hits.prim_id >= 0) & (cosine > 0.2))
    assert len(rows) > 1000
    assert wrt.visible(accel, hits.point[rows], eye[rows]).all() and wrt.visible(accel, eye[rows], hits.point[rows]).all()


@pytest.mark.parametrize("center, radius", [(0.0, 1.0), (3.0, 1e-2), (-50.0, 2e3), (700.0, 0.1)])
def test_points_of_a_sphere_see_all_that_is_outwards_and_nothing_through_it(center: float, radius: float) -> None:
    accel, way, outwards = wrt.build(sphere(center, radius)), unit_vectors(20_000, 11), unit_vectors(20_000, 12)
    origin = np.float32(center + 3.0 * radius * way)
    hits = accel.closest_hit(origin, center - origin + 0.5 * radius * outwards)
    hit = hits.prim_id == 0
    point, normal, on = hits.point[hit], hits.normal[hit].astype(np.float64), hits.prim_id[hit]
    outwards = outwards[hit] * np.sign((outwards[hit] * normal).sum(axis=1, keepdims=True))
    other = np.float32(point + 5.0 * radius * (outwards + 0.01 * normal))
    assert hit.sum() > 10_000 and wrt.visible(accel, point, other, on).all() and wrt.visible(accel, other, point, None, on).all()
    across = np.float32(point - 3.0 * radius * normal)
    assert not wrt.visible(accel, point, across, on).any() and not wrt.visible(accel, across, point, None, on).any()
    assert wrt.visible(accel, point, np.float32(point - 0.5 * radius * normal), on).all()  # inside the sphere


def test_only_the_triangle_that_is_told_is_not_in_the_way() -> None:
    wall = shapes.quad()
    vertices = np.concatenate([wall.vertices, wall.vertices + np.float32([0, 0, 1e-6])])
    two = wrt.Mesh(vertices, np.concatenate([wall.faces, wall.faces + 4]))
    accel = wrt.build(two)
    a, b = np.float32([[0.2, 0.1, 0.0]]), np.float32([[0.2, 0.1, 1.0]])
    on = accel.closest_hit(a - np.float32([0, 0, 1]), [[0, 0, 1]]).prim_id
    first, second = int(on[0]), int(on[0]) + 2
    assert wrt.visible(accel, a - np.float32([0, 0, 1]), b, [first]).tolist() == [False]
    assert wrt.visible(accel, a - np.float32([0, 0, 1]), b, [first], [second]).tolist() == [True]


def test_spheres_and_instances_are_in_the_way() -> None:
    ball = Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.float32([[0, 0, 0, 1]]))
    moved = np.eye(4)
    moved[0, 3] = 5.0
    box = Geometry.of(shapes.box())
    a, b = np.float32([[0, 0, 3], [5, 0, 3]]), np.float32([[0, 0, -3], [5, 0, -3]])
    assert wrt.visible(wrt.build(ball), a, b).tolist() == [False, True]
    b[0] += [9.0, 9.0, 0.0]
    assert wrt.visible(wrt.build(place((box, moved), (box, np.diag([2.0, 2.0, 2.0, 1.0])))), a, b).tolist() == [True, False]


@pytest.mark.parametrize("a, b, more, said", [
    ([[np.nan, 0, 0]], [[0, 0, 1]], {}, ("a", "row 0")),
    ([[0, 0, 0]] * 3, [[0, 0, 1], [0, 0, 2]], {}, ("b", "(2,) does not with (3,)")),
    ([[0, 0, 2e37]], [[0, 0, 1]], {}, ("a", "within 1e")),
    ([[0, 0, 0]], [[0, 0, 1]], {"on_a": [60]}, ("on_a", "-1 to 59")),
    ([[0, 0, 0]], [[0, 0, 1]], {"on_b": [0.5]}, ("on_b", "whole number")),
    ([[0, 0, 0]], [[0, 0, 1]], {"on_b": wp.array([1 << 30], dtype=wp.int32, device="cpu")}, ("on_b", "-1 to 59")),
    ([[0, 0, 0]], [[0, 0, 1]], {"out": np.zeros(2, bool)}, ("out", "(1,)")),
])
def test_what_is_refused(a: Any, b: Any, more: dict[str, Any], said: Refusal) -> None:
    with refused(*said):
        wrt.visible(wrt.build(soup()), a, b, **more)


def test_points_of_any_shape_broadcast() -> None:
    """From one point to a picture of points, also with ids, `out` and worlds: the bits of rows."""
    mesh, (a, b) = soup(), pairs(60)
    accel, worlds = wrt.build(mesh), wrt.build([mesh, shapes.box()])
    eye, many = b[0], a.reshape(3, 20, 3)
    ids, world, out = np.arange(60).reshape(3, 20), np.arange(20) % 2, np.zeros((3, 20), bool)
    rows = np.tile(eye, (60, 1))
    for seen, expected in ((wrt.visible(accel, eye, many), wrt.visible(accel, rows, a)),
                           (wrt.visible(accel, many, eye, ids), wrt.visible(accel, a, rows, ids.reshape(-1))),
                           (wrt.visible(accel, many, eye, ids[:, :1]), wrt.visible(accel, a, rows, ids[:, :1].repeat(20))),
                           (wrt.visible(accel, many, eye, 5), wrt.visible(accel, a, rows, np.full(60, 5))),
                           (wrt.visible(worlds, many, eye, world=world), wrt.visible(worlds, a, rows, world=np.tile(world, 3))),
                           (wrt.visible(accel, vec3s(a).reshape((3, 20)), vec3s(eye[None])), wrt.visible(accel, a, rows))):
        assert seen.shape == (3, 20) and np.array_equal(to_numpy(seen).reshape(-1), expected) and 0 < expected.sum() < 60
    assert wrt.visible(accel, many, eye, out=out) is out and np.array_equal(out.reshape(-1), wrt.visible(accel, a, rows))
    assert wrt.visible(accel, eye, a[0]).shape == ()


def test_what_takes_no_prim_ids() -> None:
    points = np.zeros((1, 3))
    with refused("accel", "structure"):
        wrt.visible("bvh", points, points)  # type: ignore[arg-type]
    with refused("on_a", "structures without instances"):
        wrt.visible(wrt.build(place((Geometry.of(shapes.box()), np.eye(4)))), points, points, [0])
    with refused("world", "2 worlds"):
        wrt.visible(wrt.build([shapes.box(), shapes.box()]), points, points)
    assert wrt.visible(wrt.build([shapes.box()]), points, points + 3.0).tolist() == [False]
