from __future__ import annotations

import inspect

import numpy as np
import pytest

import wrt
from wrt.core.errors import InputError
from wrt.scene import shapes
from wrt.scene.mesh import Mesh

BALL = [(np.sin(a), -np.cos(a)) for a in np.linspace(0.0, np.pi, 65)]
BALL[0], BALL[-1] = (0.0, -1.0), (0.0, 1.0)

CLOSED = {  # name: mesh, its exact volume, and how much less a mesh of flat triangles may have
    "box": (shapes.box((1, 2, 3), (2, 4, 6)), 6.0, 1e-5),
    "icosphere": (shapes.icosphere(4, 2.0), 32.0 / 3.0 * np.pi, 0.005),
    "torus": (shapes.torus(1.0, 0.25), 2.0 * np.pi**2 * 0.25**2, 0.02),
    "cylinder": (shapes.lathe([(0, 0), (1, 0), (1, 0), (1, 2), (1, 2), (0, 2)]), 2.0 * np.pi, 0.005),
    "lathed ball": (shapes.lathe(BALL), 4.0 / 3.0 * np.pi, 0.005),
    "prism": (shapes.prism(3, 1.0, 2.0), 0.75 * 3.0**0.5 * 2.0, 1e-6),
    "hexagonal prism": (shapes.prism(6, 1.0, 1.0), 1.5 * 3.0**0.5, 1e-6),
    "tube": (shapes.tube([(0, 0, 0), (0, 0, 1), (0, 0, 3)], 0.5, 64), 0.75 * np.pi, 0.005),
    "cone": (shapes.tube([(0, 0, 0), (3, 0, 0)], [1.0, 0.5], 64), np.pi * (1.0 + 0.5 + 0.25), 0.005),
}


def test_a_box_is_six_quads_that_face_out() -> None:
    low, high = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 6.0])
    mesh = shapes.box(low, high)
    sides = mesh.vertices.reshape(6, 4, 3)
    for axis in range(3):
        for far in (0, 1):
            side = sides[2 * axis + far]
            assert (side[:, axis] == (low, high)[far][axis]).all()
            normal = np.cross(side[1] - side[0], side[3] - side[0])
            expected = np.zeros(3)
            expected[axis] = (2 * far - 1) * 6.0 / (high - low)[axis]
            assert normal.tolist() == expected.tolist()
            assert np.array_equal(side[2] - side[1], side[3] - side[0])
    assert np.array_equal(mesh.uvs.reshape(6, 4, 2), np.broadcast_to([[0, 1], [1, 1], [1, 0], [0, 0]], (6, 4, 2)))


def corners(mesh: Mesh) -> np.ndarray:
    return mesh.vertices.astype(np.float64)[mesh.faces]


def open_edges(mesh: Mesh) -> int:
    """Return the directed edges, by position, that have no opposite edge."""
    _, place = np.unique(mesh.vertices + np.float32(0.0), axis=0, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    edges = {(a, b) for face in faces.tolist() for a, b in zip(face, face[1:] + face[:1], strict=True)}
    return sum((b, a) not in edges for a, b in edges)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_shapes_are_closed_and_face_out(name: str) -> None:
    mesh, volume, tolerance = CLOSED[name]
    points = corners(mesh)
    measured = np.einsum("ij,ij->i", points[:, 0], np.cross(points[:, 1], points[:, 2])).sum() / 6.0
    assert open_edges(mesh) == 0
    assert volume * (1.0 - tolerance) <= measured <= volume * (1.0 + 1e-5)


def test_teapot_parts_are_closed() -> None:
    mesh = shapes.teapot(32)
    assert open_edges(mesh) == 0
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert low[1] == 0.0 and 0.9 < high[1] < 1.1 and 1.8 < high[0] - low[0] < 2.2


@pytest.mark.parametrize(("side", "height"), [(-1.0, 0.186), (-1.0, 0.629), (1.0, 0.2)])
def test_handle_and_spout_end_in_the_body(side: float, height: float) -> None:
    accel = wrt.build(shapes.teapot(32), "bvh2")
    start = [[0.0, height, 0.0]] * 2
    towards_the_end, wall = accel.closest_hit(start, [[side, 0.0, 0.0], [0.0, 0.0, 1.0]]).t
    assert towards_the_end < wall - 0.02


@pytest.mark.parametrize("mesh", [*(m for m, _, _ in CLOSED.values() if m.normals is not None), shapes.teapot()],
                         ids=lambda mesh: mesh.name)
def test_normals_are_unit_and_on_the_side_of_the_face(mesh: Mesh) -> None:
    points = corners(mesh)
    face = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    assert mesh.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)
    assert np.einsum("ij,ikj->ik", face, mesh.normals[mesh.faces].astype(np.float64)).min() > 0.5


def test_exact_normals() -> None:
    ball, ring = shapes.icosphere(2, 3.0), shapes.torus(2.0, 0.5)
    np.testing.assert_allclose(ball.normals, ball.vertices / 3.0, atol=1e-6)
    flat = ring.vertices * (1.0, 0.0, 1.0)
    center = 2.0 * flat / np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose(ring.normals, (ring.vertices - center) / 0.5, atol=1e-5)
    lathed = shapes.lathe(BALL)
    np.testing.assert_allclose(lathed.normals, lathed.vertices, atol=2e-3)


def test_quad_shows_a_picture_upright() -> None:
    quad = shapes.quad((1, 0, 0), (2, 0, 0), (0, 3, 0))
    assert quad.uvs is not None
    at = {tuple(v): tuple(uv) for v, uv in zip(quad.vertices.tolist(), quad.uvs.tolist(), strict=True)}
    assert at == {(1, 0, 0): (0, 1), (3, 0, 0): (1, 1), (3, 3, 0): (1, 0), (1, 3, 0): (0, 0)}
    points = corners(quad)
    assert (np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]) == (0, 0, 6)).all()


@pytest.mark.parametrize("make", [
    lambda: shapes.quad((0, 0, 0), (1, 0, 0), (2, 0, 0)), lambda: shapes.box((0, 0, 0), (1, 0, 1)),
    lambda: shapes.icosphere(10), lambda: shapes.icosphere(-1), lambda: shapes.torus(1.0, 2.0),
    lambda: shapes.torus(0.0), lambda: shapes.torus(segments=2), lambda: shapes.lathe([(1, 0)]),
    lambda: shapes.lathe([(-1, 0), (1, 1)]),
    lambda: shapes.lathe([(1, 0), (1, 0)]), lambda: shapes.lathe([(1, 0), (np.nan, 1)]), lambda: shapes.prism(2),
    lambda: shapes.prism(3, 0.0), lambda: shapes.tube([(0, 0, 0)]), lambda: shapes.tube([(0, 0, 0), (0, 0, 0)]),
    lambda: shapes.tube([(0, 0, 0), (0, 0, 1)], 0.0), lambda: shapes.tube([(0, 0, 0), (0, 0, 1)], [1, 2, 3]),
    lambda: shapes.teapot(1),
])
def test_senseless_parameters_are_refused(make) -> None:
    with pytest.raises(InputError):
        make()


def test_every_shape_can_stand_in_a_scene_file() -> None:
    from wrt.io.toml.schema import SHAPE_KEYS

    assert {kind: list(keys) for kind, keys in SHAPE_KEYS.items()} == {
        kind: list(inspect.signature(shape).parameters) for kind, shape in shapes.SHAPES.items()}
