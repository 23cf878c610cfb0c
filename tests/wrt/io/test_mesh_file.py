from __future__ import annotations

import codecs
from pathlib import Path

import numpy as np
import pytest

from tests.data import data_path
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


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float nx
property float ny
property float nz
element face 1
property list uchar int vertex_indices
end_header
{} 0 0 {} 0 1
1 0 0 0 0 1
0 1 0 0 0 1
3 0 1 2
"""
TEXTS = {  # files with a word for the first coordinate of a position, and of a normal if the format has normals
    ".obj": "v {} 0 0\nv 1 0 0\nv 0 1 0\nvn {} 0 1 # a\nvn 0 0 1\nf 1//1 2//2 3//2\n", ".ply": PLY,
    ".off": "OFF 3 1 0\n{} 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    ".stl": "solid\nfacet\nouter loop\nvertex {} 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n",
}


@pytest.mark.parametrize("suffix", TEXTS)
def test_numbers_of_text(suffix: str, tmp_path: Path) -> None:
    """Each reader knows a byte order mark and NaN and infinity as C libraries print them, and names the line of what is no number."""
    path = tmp_path / f"a{suffix}"
    for word, value in (("0", 0), ("-1.25D+01", -12.5), ("-.5e0", -0.5)):
        path.write_bytes(codecs.BOM_UTF8 + TEXTS[suffix].format(word, 0).encode())
        mesh = load_mesh(path)
        assert mesh.vertices[0].tolist() == [value, 0, 0] and len(mesh.faces) == 1
    for word in ("nan", "-nan(ind)", "nan(0x8000000000000)", "NaNQ", "1.#IND", "-1.#QNAN0", "1.#J", "inf", "1.#INF00e+000"):
        path.write_text(TEXTS[suffix].format(word, 0))
        with refused(None, "finite", path=path):
            load_mesh(path)
        if suffix in (".obj", ".ply"):
            path.write_text(TEXTS[suffix].format(0, word))
            with pytest.warns(SceneWarning, match="1 normals are not finite"):
                mesh = load_mesh(path)
            assert mesh.normals.tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 1]]
    for word in ("0,5", "x", "1.#", "1.5f", "nan(", "1..5"):
        path.write_text(TEXTS[suffix].format(word, 0))
        with refused(None, "is not a number", path=path, hint="decimal point" if "," in word else "") as caught:
            load_mesh(path)
        assert caught.value.place.startswith("line ")
    path.write_bytes(TEXTS[suffix].format(0, 0).encode("utf-16"))
    with refused(path=path):
        load_mesh(path)


@pytest.mark.parametrize("suffix", [".glb", ".GLTF", ".toml"])
def test_a_scene_file_gets_a_hint(suffix: str, tmp_path: Path) -> None:
    with refused(hint="load_scene and wrt"):
        load_mesh(tmp_path / f"a{suffix}")
    with refused(what="mesh file: its suffix"):
        load_mesh(tmp_path / "a.xyz")
