from __future__ import annotations

from dataclasses import replace

import numpy as np

from wrt.scene.mesh import Mesh, smooth
from wrt.scene.shapes import box, icosphere, torus


def test_close_to_the_normals_of_the_surface() -> None:
    for mesh in (icosphere(3), torus(1.0, 0.4, 96, 48)):
        made = smooth(replace(mesh, normals=None)).normals
        assert made is not None and mesh.normals is not None
        assert (np.einsum("ij,ij->i", made, mesh.normals) > np.cos(np.radians(1.0))).all()
        np.testing.assert_allclose(np.linalg.norm(made, axis=1), 1.0, atol=1e-6)


def test_corner_of_a_box_is_the_diagonal_however_it_is_cut() -> None:
    # At some corners both triangles of a side meet: weights by angle must not depend on that.
    mesh = box((-1, -1, -1), (1, 1, 1))
    normals = smooth(mesh).normals
    np.testing.assert_allclose(normals, mesh.vertices / np.sqrt(3.0), atol=1e-6)


def test_welds_equal_positions_only() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    normals = smooth(Mesh(points, np.array([[0, 1, 2], [3, 4, 5]]))).normals
    assert normals is not None
    np.testing.assert_allclose(normals[[0, 3, 2, 4]], np.array([[1, 0, 1]] * 4) / np.sqrt(2.0), atol=1e-6)
    np.testing.assert_allclose(normals[[1, 5]], [[0, 0, 1], [1, 0, 0]], atol=1e-6)


def test_faces_that_cancel_out_are_flat() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
    assert (smooth(Mesh(points, np.array([[0, 1, 2], [0, 2, 1]]))).normals == 0.0).all()


def test_sizes_far_from_one() -> None:
    for scale in (1e-18, 1e18):
        mesh = icosphere(1)
        made = smooth(Mesh(mesh.vertices * np.float32(scale), mesh.faces)).normals
        np.testing.assert_allclose(made, mesh.normals, atol=0.05)


def test_own_normals_stay() -> None:
    mesh = icosphere(1)
    assert smooth(mesh) is mesh
