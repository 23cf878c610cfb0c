"""Points inside closed meshes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.device import NAME as DEVICE
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.scene import shapes


def lattice(low: float, high: float, n: int) -> np.ndarray:
    """Return a lattice of points along the axes, so that many rays pass through edges."""
    return np.stack(np.meshgrid(*[np.linspace(low, high, n)] * 3), axis=-1).reshape(-1, 3)


def test_of_a_box_every_point_of_a_lattice() -> None:
    points = lattice(-1.45, 1.45, 24)
    inside = wrt.contains(wrt.build(shapes.box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))), points, threads=2)
    assert np.array_equal(inside, (np.abs(points) < 1.0).all(axis=1)) and inside.any()


def test_of_a_ball() -> None:
    ball = shapes.icosphere(4)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1.2, 1.2, (20_000, 3)), 0.99 * ball.vertices, 1.01 * ball.vertices, [[0.0, 0.0, 0.0]]])
    radius = np.linalg.norm(np.float32(points).astype(np.float64), axis=1)
    clear = (radius < 0.995) | (radius > 1.0)  # the mesh is inscribed
    inside = wrt.contains(wrt.build(ball), points)
    assert np.array_equal(inside[clear], radius[clear] < 1.0) and 0.1 < inside.mean() < 0.9


def test_shells_within_each_other_are_counted() -> None:
    shells = shapes.merged([shapes.icosphere(3, 1.0), shapes.icosphere(3, 0.5)], "shells")
    points = np.linspace(0.0, 1.2, 49)[:, None] * np.array([0.6, 0.64, 0.48])
    inside, radius = wrt.contains(wrt.build(shells), points), np.linalg.norm(points, axis=1)
    clear = (np.abs(radius - 1.0) > 0.02) & (np.abs(radius - 0.5) > 0.02)
    assert np.array_equal(inside[clear], ((radius < 1.0) & (radius > 0.5))[clear])


def test_a_mesh_whose_corners_are_there_twice_is_closed() -> None:
    box = shapes.box()
    apart = wrt.Mesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert wrt.contains(wrt.build(apart), [[0.1, 0.2, 0.3], [0.6, 0.0, 0.0]]).tolist() == [True, False]


def test_after_a_refit_it_is_the_new_mesh() -> None:
    accel = wrt.build(shapes.icosphere(2))
    points = np.array([[0.0, 1.5, 0.1]])
    assert not wrt.contains(accel, points)[0]
    accel.refit(2.0 * accel.geometry.vertices)
    assert wrt.contains(accel, points)[0]


@pytest.mark.parametrize("corner", range(3))
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_face_with_a_corner_that_is_not_finite_is_not_there(corner: int, number: float) -> None:
    box, points = shapes.box(), lattice(-1.45, 1.45, 12)
    vertices = np.concatenate([box.vertices, np.full((1, 3), number, np.float32)])
    faces = np.concatenate([box.faces, np.roll(np.int32([[len(box.vertices), 0, 1]]), corner)])
    accel = wrt.build(Geometry(vertices, faces, np.zeros((0, 4), np.float32)))
    assert np.array_equal(wrt.contains(accel, points), wrt.contains(wrt.build(box), points))
    assert np.array_equal(wrt.signed_distance(accel, points), wrt.signed_distance(wrt.build(box), points))
    nothing = wrt.build(Geometry(vertices, faces[-1:], np.zeros((0, 4), np.float32)))
    assert not wrt.contains(nothing, points).any()


def points_of(array: np.ndarray) -> Any:
    return wp.array(array, dtype=wp.vec3, device=DEVICE)


def test_a_mesh_that_a_refit_in_place_opens_is_open() -> None:
    box = shapes.box()
    corners = box.vertices[box.faces].reshape(-1, 3)
    accel = wrt.build((corners, np.arange(36).reshape(-1, 3)), "bvh2", DEVICE)
    for scale in (1.0, 3.0):  # the bounds are computed again, too
        accel.refit(points_of(scale * corners), in_place=True)
        assert wrt.contains(accel, [[0.1, 0.2, 0.3], [0.6, 0.0, 0.0]]).tolist() == [True, scale == 3.0]
    corners[:3] += np.float32(0.1)
    accel.refit(points_of(corners), in_place=True)
    with refused(what="6 edges"):
        wrt.contains(accel, [[0.1, 0.2, 0.3]])


def test_what_is_refused_and_what_is_empty() -> None:
    ball, none = wrt.build(shapes.icosphere(1)), np.zeros((0, 3))
    assert wrt.contains(ball, none).shape == (0,)
    assert wrt.contains(wrt.build(wrt.Mesh(none, np.zeros((0, 3), np.int32))), [[0.0, 0.0, 0.0]]).tolist() == [False]
    flat = wrt.build(shapes.quad())
    for accel, points, said in ((flat, [[0.0, 0.0, 0.0]], (None, "mesh")),
                                (ball, [[0.0, np.nan, 0.0]], ("points", "finite")),
                                (ball, [0.0, 1.0], ("points", "(..., 3)")),
                                (ball, [[0.0, 1.0, 2.0], [0.0]], ("points", "(..., 3)")),
                                (ball, np.ma.zeros((1, 3)), ("points", "masked array")),
                                ("bvh", [[0.0, 0.0, 0.0]], ("accel", "structure"))):
        with refused(*said):
            wrt.contains(accel, points)  # type: ignore[arg-type]


# --- points of any leading shape --------------------------------------------------------------------------------------


QUERIES: dict[str, Callable[..., Any]] = {
    "contains": wrt.contains, "winding_number": wrt.winding_number, "signed_distance": wrt.signed_distance,
    "distance": lambda *args, **more: wrt.closest_points(*args, **more).distance,
    "point": lambda *args, **more: wrt.closest_points(*args, **more).point}


@pytest.mark.parametrize("name", QUERIES)
def test_points_of_any_shape(name: str) -> None:
    query, ball = QUERIES[name], shapes.icosphere(2)
    accel, worlds, points = wrt.build(ball), wrt.build([ball, shapes.box()]), np.float32(np.random.default_rng(0).normal(size=(4, 6, 3)))
    rows, world = query(accel, points.reshape(-1, 3)), np.arange(6) % 2
    own = rows.shape[1:]
    for given, shape in ((points, (4, 6)), (points.tolist(), (4, 6)), (wp.array(points, dtype=wp.vec3, device=DEVICE), (4, 6)),
                         (points.reshape(2, 2, 6, 3), (2, 2, 6)), (points[:0], (0, 6))):
        found = query(accel, given)
        assert found.shape == (*shape, *own) and found.tobytes() == rows[:found.size // max(1, int(np.prod(own)))].tobytes()
    assert query(accel, points[1, 2]).shape == own and np.array_equal(query(accel, points[1, 2]), rows[8])
    expected = query(worlds, points.reshape(-1, 3), world=np.tile(world, 4))
    assert np.array_equal(query(worlds, points, world=world), expected.reshape(4, 6, *own))


@pytest.mark.parametrize("name", QUERIES)
def test_tensors_of_any_shape(name: str) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: wrt does not need it")
    query, accel = QUERIES[name], wrt.build(shapes.icosphere(2))
    points = torch.linspace(-1.0, 1.0, 24).reshape(2, 4, 3)
    expected = query(accel, points.numpy())
    assert np.array_equal(np.asarray(query(accel, points)), expected)
    assert np.array_equal(np.asarray(query(accel, points[1, 2])), expected[1, 2])
