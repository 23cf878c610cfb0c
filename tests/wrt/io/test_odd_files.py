"""Every file of the data set's folder odd/ gives a picture, or is refused with one message."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import Result, wrt
from tests.data import DATA, data_path
from wrt.io.load import load_scene
from wrt.picture.image import read_image

ODD = DATA / "odd"
FILES = sorted(path.relative_to(ODD).as_posix() for path in ODD.rglob("*") if path.is_file()) or ["missing"]
REFUSED = {
    "BoxMeshopt.glb": "the file needs 'EXT_meshopt_compression'",
    "empty.obj": "no triangles", "empty.stl": "no triangles", "stl_empty_bin.stl": "no triangles",
    "obj_points.obj": "no triangles", "obj_wireframe.obj": "no triangles", "face_in_group_name.obj": "no triangles",
    "ply_points_bin.ply": "no triangles", "points_emptyface.ply": "no triangles", "empty_nodes.glb": "no triangles",
    "empty.ply": "no vertices", "ply_empty_header.ply": "no vertices",
    "PEER_CASES.md": "no scene file", "MeshPrimitiveModes/buffer.bin": "no scene file",
}
# Numbers of triangles in the scene and of dropped triangles, if other programs agree (their sum, if those count faces).
TRIANGLES = {
    "capsule.obj": (10000, 200), "SimpleInstancing.glb": (1500, 0), "MeshPrimitiveModes/MeshPrimitiveModes.gltf": (16, 0),
    "NegativeScaleTest.glb": (7724, 0), "mode5.gltf": (2786, 0), "nested.glb": (36, 0), "busted.STL": (3878, 0),
    "no_indices_3storybuilding.glb": (72, 0), "ADIS16480.STL": (7436, 0), "teapot.stl": (894, 0), "unit_sphere.STL": (1280, 0),
    "negative_indices.obj": (12, 0), "nancolor.obj": (12, 0), "polygonfaces.obj": (3, 0), "plane.ply": (2, 0),
}


def odd(name: str) -> Path:
    if name == "missing":
        pytest.skip("needs the folder odd/ of the data set (set WRT_DATA to its folder)")
    return data_path(f"odd/{name}")


@pytest.mark.parametrize("name", FILES)
def test_it_makes_a_picture_or_one_message(name: str, tmp_path: Path) -> None:
    path, picture = odd(name), tmp_path / "picture.png"
    result = wrt("render", path, "-o", picture, "--spp", 1, "--size", "16x9")
    if name in REFUSED:
        assert_refused(result, path, picture)
        assert REFUSED[name] in result.errors[0]
        return
    assert result.code == 0 and result.errors == [] and result.out == f"{picture}\n"
    pixels = read_image(picture)
    assert pixels.shape == (9, 16, 3) and np.unique(pixels).size > 3  # more than the sky alone
    assert list(tmp_path.iterdir()) == [picture]


def assert_refused(result: Result, path: Path, picture: Path) -> None:
    assert result.code == 2 and result.out == ""
    assert len(result.err.splitlines()) == 1 and len(result.errors) == 1
    assert result.errors[0].startswith(f"error: {path}: ")
    assert list(picture.parent.iterdir()) == []


@pytest.mark.parametrize("name", sorted(TRIANGLES))
def test_no_triangle_is_lost_on_the_way(name: str) -> None:
    result = wrt("info", odd(name), "--json")
    facts = json.loads(result.out)
    assert (facts["triangles"], facts["zero_area_triangles_left_out"]) == TRIANGLES[name]


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
@pytest.mark.parametrize("name", [name for name in FILES if name not in REFUSED])
def test_the_camera_that_is_added_sees_the_whole_scene(name: str) -> None:
    path = odd(name)
    scene = load_scene(path)
    if scene.cameras[0].name != "framing":
        pytest.skip("has a camera of its own")
    points = np.concatenate([thing.mesh.vertices @ thing.transform[:3, :3].T + thing.transform[:3, 3]
                             for thing in scene.objects])
    seen = np.c_[points, np.ones(len(points))] @ np.linalg.inv(scene.cameras[0].camera_to_world).T
    for size in ((16, 9), (1, 2)):
        lens = scene.cameras[0].record(size)
        assert (seen[:, 2] < 0).all() and (np.abs(seen[:, :2]) <= np.outer(-seen[:, 2], (lens["tan_x"], lens["tan_y"]))).all()
