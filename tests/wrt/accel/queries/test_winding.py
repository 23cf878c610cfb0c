"""Winding numbers of meshes around points."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import wrt
from tests.device import NAME as DEVICE
from tests.refused import refused
from wrt.scene import shapes


def solid_angles(mesh: wrt.Mesh, points: np.ndarray) -> np.ndarray:
    """Return the sum of solid angles over 4 pi, with one arctangent per triangle."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64)[None] - points.astype(np.float32).astype(np.float64)[:, None]
               for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2((a * np.cross(b, c)).sum(2), below).sum(axis=1) / (2.0 * np.pi)


@pytest.mark.parametrize("mesh", [shapes.icosphere(3), shapes.torus(1.0, 0.4, 64, 32), shapes.quad(),
                                  shapes.merged([shapes.icosphere(2), shapes.icosphere(2, 0.5)], "twice")],
                         ids=lambda mesh: mesh.name)
def test_it_is_the_sum_of_the_solid_angles(mesh: wrt.Mesh) -> None:
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))
    found = wrt.winding_number(wrt.build(mesh), points, threads=2)
    np.testing.assert_allclose(found, solid_angles(mesh, points), rtol=0.0, atol=1e-12)


def test_of_a_closed_mesh_it_is_a_whole_number_and_tells_what_is_inside() -> None:
    accel = wrt.build(shapes.torus(1.0, 0.4, 64, 32))
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (2000, 3))
    found = wrt.winding_number(accel, points)
    np.testing.assert_allclose(found, np.round(found), atol=1e-9)
    assert np.array_equal(found > 0.5, wrt.contains(accel, points)) and 0.05 < (found > 0.5).mean() < 0.5


def test_parts_add_up_and_turning_faces_around_turns_the_sign() -> None:
    ball = shapes.icosphere(2)
    points = [[0.0, 0.1, 0.2], [3.0, 0.0, 0.0]]
    many = wrt.build(shapes.merged([shapes.icosphere(2, 1.0 + 0.1 * i) for i in range(9)], "many"))
    assert np.round(wrt.winding_number(many, points), 9).tolist() == [9.0, 0.0]
    inside_out = wrt.build(wrt.Mesh(ball.vertices, ball.faces[:, ::-1]))
    assert np.round(wrt.winding_number(inside_out, points), 9).tolist() == [-1.0, 0.0]


def test_an_open_mesh_is_told_by_half() -> None:
    square = wrt.build(shapes.quad((-1.0, -1.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0)))
    below, above = wrt.winding_number(square, [[0.0, 0.0, -1e-6], [0.0, 0.0, 1e-6]])
    assert below == pytest.approx(0.5, abs=1e-5) and above == pytest.approx(-0.5, abs=1e-5)


def test_triangles_with_a_corner_that_is_not_finite_are_left_out() -> None:
    ball = shapes.icosphere(1)
    faces = wp.array(ball.faces.reshape(-1), dtype=wp.int32, device=DEVICE)
    expected = wrt.winding_number(wrt.build((ball.vertices, ball.faces[(ball.faces != 7).all(axis=1)])), [[0.1, 0.2, 0.3]])
    for value in (np.nan, np.inf):
        points = ball.vertices.copy()
        points[7, 1] = value
        accel = wrt.build(wrt.DeviceGeometry(wp.array(points, dtype=wp.vec3, device=DEVICE), faces), "bvh2", DEVICE)
        assert wrt.winding_number(accel, [[0.1, 0.2, 0.3]]) == pytest.approx(expected, abs=1e-12)


def test_corners_nothing_and_what_is_refused() -> None:
    ball = wrt.build(shapes.icosphere(1))
    assert np.isfinite(wrt.winding_number(ball, ball.geometry.vertices)).all()
    edges = wrt.winding_number(wrt.build(shapes.box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))), [[1.0, 1.0, 0.25], [-1.0, 0.5, 1.0]])
    assert ((edges > -1e-9) & (edges < 1.0 + 1e-9)).all()
    assert wrt.winding_number(ball, np.zeros((0, 3))).shape == (0,)
    for accel, points, said in ((ball, [[np.nan, 0.0, 0.0]], ("points", "finite")), (ball, [0.0], ("points", "(N, 3)")),
                                ("bvh", [[0.0, 0.0, 0.0]], ("accel", "structure over one mesh"))):
        with refused(*said):
            wrt.winding_number(accel, points)  # type: ignore[arg-type]
