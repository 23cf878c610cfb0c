"""Meshes: what is refused, trimesh, smooth normals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from wrt.scene.mesh import Mesh, smooth
from wrt.scene.shapes import box, icosphere, torus


def test_mesh_refuses_what_cannot_be_traced() -> None:
    vertices, faces = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]])
    for bad in (
        {"vertices": np.full((3, 3), np.nan)}, {"vertices": np.full((3, 3), 1e39)}, {"vertices": np.eye(2)},
        {"faces": [[0, 1, 3]]}, {"faces": [[0, 1, -1]]}, {"faces": [[0.0, 1.0, 2.0]]}, {"faces": [0, 1, 2]},
        {"normals": np.eye(3)[:2]}, {"uvs": np.zeros((3, 3))}, {"uvs": np.full((3, 2), np.inf)},
        {"face_group": np.zeros(2, int)}, {"face_group": [0]}, {"face_group": [1], "groups": ("a",)},
        {"face_group": [-1], "groups": ("a",)},
    ):
        with refused(next(iter(bad)), place="thing"):
            Mesh(**{"vertices": vertices, "faces": faces, "name": "thing", **bad})
    with refused("groups[0]", place="thing"):
        Mesh(vertices, faces, groups=(1,), name="thing")  # type: ignore[arg-type]


def test_meshes_come_from_trimesh_and_go_back() -> None:
    trimesh = pytest.importorskip("trimesh")
    cuboid = trimesh.creation.box((1.0, 2.0, 3.0))
    mesh = Mesh.from_trimesh(cuboid)
    assert mesh.normals is None and mesh.uvs is None and len(mesh.faces) == 12
    np.testing.assert_allclose(mesh.vertices, cuboid.vertices)
    rounded = Mesh.from_trimesh(cuboid, smooth=True)
    np.testing.assert_allclose(rounded.normals, cuboid.vertex_normals, atol=1e-6)
    back = rounded.to_trimesh()
    assert back.is_watertight and back.volume == pytest.approx(6.0)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.vertex_normals, rounded.normals, atol=1e-6)


def test_normals_from_trimesh_get_unit_length() -> None:
    trimesh = pytest.importorskip("trimesh")
    normals = np.array([[0, 0, 127], [0, 3, 4], [0, 0, 0]], np.float32)
    mesh = Mesh.from_trimesh(trimesh.Trimesh(np.eye(3), [[0, 1, 2]], vertex_normals=normals, process=False), smooth=True)
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1], [0, 0.6, 0.8], [0, 0, 0]], atol=1e-7)


def test_a_trimesh_scene_is_taken_in_its_world() -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    for x in (0.0, 5.0):
        scene.add_geometry(trimesh.creation.icosphere(1), transform=trimesh.transformations.translation_matrix([x, 0.0, 0.0]))
    mesh = Mesh.from_trimesh(scene)
    assert len(mesh.faces) == 160
    np.testing.assert_allclose([mesh.vertices.min(axis=0)[0], mesh.vertices.max(axis=0)[0]], [-1.0, 6.0], atol=0.1)


def test_texture_coordinates_have_their_origin_where_pictures_have_it() -> None:
    trimesh = pytest.importorskip("trimesh")
    uvs = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], np.float32)
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), uvs=uvs)
    theirs = mesh.to_trimesh()
    np.testing.assert_array_equal(theirs.visual.uv, [[0.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
    np.testing.assert_array_equal(Mesh.from_trimesh(theirs).uvs, uvs)
    with refused("mesh", "trimesh.Trimesh"):
        Mesh.from_trimesh(trimesh.creation)  # type: ignore[arg-type]


# --- smooth normals ---------------------------------------------------------------------------------------------------


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
