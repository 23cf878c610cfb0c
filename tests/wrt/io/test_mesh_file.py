from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.data import DATA, data_path
from tests.refused import refused
from wrt.core.errors import SceneWarning
from wrt.io.mesh_file import load_mesh

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def write(folder: Path, text: str, name: str = "a.obj") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_faces_without_area_are_dropped_and_counted(tmp_path: Path) -> None:
    text = TRIANGLE + "v 2 0 0\nv 9 9 9\nusemtl a\nf 1 2\nf 1 2 4\nf 1 1 2\nusemtl b\nf 1 2 3\n"
    mesh = load_mesh(write(tmp_path, text))
    assert mesh.dropped == 3 and len(mesh.faces) == 1 and len(mesh.vertices) == 3
    assert mesh.face_group is not None and [mesh.groups[i] for i in mesh.face_group] == ["b"]


@pytest.mark.parametrize(("text", "says"), [
    (TRIANGLE, "no triangles (3 positions"), ("", "no triangles"), (TRIANGLE + "f 1 2\n", "1 faces with fewer"),
    (TRIANGLE + "f 1 2 2\nf 3 3 3\n", "none of its 2 triangles has an area"),
])
def test_meshes_without_area_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = write(tmp_path, text)
    with refused(None, says, path=path):
        load_mesh(path)


def test_paths_that_are_no_mesh_file(tmp_path: Path) -> None:
    (tmp_path / "folder.ply").mkdir()
    write(tmp_path, "x", "a.fbx")
    for name, says in (("none.obj", "no such file"), ("folder.ply", "no regular file"), ("a.fbx", ".npz, .obj, .off, .ply, .stl")):
        with refused(None, says, path=name):
            load_mesh(tmp_path / name)


def test_normals_become_unit_and_bad_ones_zero(tmp_path: Path) -> None:
    path = write(tmp_path, TRIANGLE + "vn 0 3 4\nvn 0 0 0\nvn nan 0 1\nf 1//1 2//2 3//3\n")
    with pytest.warns(SceneWarning, match="1 normals are not finite"):
        mesh = load_mesh(path)
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals[mesh.faces[0]], [[0, 0.6, 0.8], [0, 0, 0], [0, 0, 0]], atol=1e-7)


def test_parts_count_the_triangles_of_the_file(tmp_path: Path) -> None:
    # Triangle 1 has no area: later triangles keep their index in the file.
    path = write(tmp_path, TRIANGLE + "v 0 0 1\nusemtl x\nf 1 2 3\nf 1 1 2\nf 1 2 4\nf 1 3 4\n")
    mesh = load_mesh(path, parts=[(2, 1), (0, 2)])
    assert mesh.groups == ("0", "1", "rest") and mesh.face_group is not None
    assert mesh.face_group.tolist() == [1, 0, 2] and mesh.dropped == 1
    with refused(what="triangles 3 to 4", place="part 1"):
        load_mesh(path, parts=[(0, 1), (3, 2)])


def test_duplicate_positions_stay() -> None:
    mesh = load_mesh(data_path("meshes/large/dragon_871k.ply"))
    different = np.unique(mesh.vertices.view(np.uint32).reshape(-1, 3), axis=0)
    assert len(mesh.vertices) - len(different) >= 2000


def test_large_binary_ply_is_quick() -> None:
    path = data_path("scenes/bitterli_kitchen/kitchen_1443k.ply")
    begin = time.perf_counter()
    mesh = load_mesh(path)
    assert len(mesh.faces) + mesh.dropped == 1_443_517
    assert time.perf_counter() - begin < 8.0  # about 0.5 s on an idle machine


@pytest.mark.parametrize("path", sorted(p for p in DATA.glob("odd/*") if p.suffix.lower() in (".obj", ".ply", ".stl")),
                         ids=lambda path: path.name)
def test_odd_files_load_or_are_refused(path: Path) -> None:
    without_faces = {"empty.obj", "empty.ply", "empty.stl", "stl_empty_bin.stl", "ply_empty_header.ply", "obj_points.obj",
                     "obj_wireframe.obj", "ply_points_bin.ply", "points_emptyface.ply", "face_in_group_name.obj"}
    if path.name in without_faces:
        with refused(path=path):
            load_mesh(path)
        return
    mesh = load_mesh(path)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert len(mesh.faces) and (area > 0.0).all()
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    if mesh.normals is not None:
        length = np.linalg.norm(mesh.normals, axis=1)
        assert (np.isclose(length, 1.0, atol=1e-6) | (length == 0.0)).all()


@pytest.mark.parametrize("suffix", [".glb", ".GLTF", ".toml"])
def test_a_scene_file_gets_a_hint(suffix: str, tmp_path: Path) -> None:
    with refused(hint="load_scene and wrt"):
        load_mesh(tmp_path / f"a{suffix}")
    with refused(what="mesh file: its suffix"):
        load_mesh(tmp_path / "a.xyz")
