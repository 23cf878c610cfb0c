"""wrt.build: the arguments that it accepts, and its errors for others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import wrt
from tests.data import ROOT
from tests.refused import Refusal, refused
from wrt.accel.geometry import Geometry
from wrt.accel.instances import Instances
from wrt.accel.scenes.flatten import flatten_joined
from wrt.scene import shapes
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene

BALL = shapes.icosphere(2)
ORIGINS, DIRECTIONS = (np.random.default_rng(0).normal(size=(2, 500, 3)) * [[[3.0]], [[1.0]]]).astype(np.float32)


def forms(folder: Path) -> dict[str, Any]:
    """Return the same ball in every form that wrt.build accepts."""
    as_trimesh = BALL.to_trimesh()
    as_trimesh.export(folder / "ball.ply")
    as_trimesh.export(folder / "ball.glb")
    return {"Mesh": BALL, "Geometry": Geometry.of(BALL), "pair": (BALL.vertices.astype(np.float64), BALL.faces.astype(np.int64)),
            "trimesh": as_trimesh, "trimesh scene": trimesh.Scene(as_trimesh), "Scene": Scene((Object(BALL, (Material(),)),)),
            "file": folder / "ball.ply", "name": str(folder / "ball.ply"), "glTF": folder / "ball.glb"}


@pytest.mark.filterwarnings("ignore::wrt.SceneWarning")
def test_the_same_hits_whatever_it_is_given_as(tmp_path: Path) -> None:
    expected = wrt.build(BALL).closest_hit(ORIGINS, DIRECTIONS - ORIGINS)
    assert 0 < (expected.prim_id >= 0).sum()
    for name, given in forms(tmp_path).items():
        hits = wrt.build(given).closest_hit(ORIGINS, DIRECTIONS - ORIGINS)
        assert np.array_equal(hits.t, expected.t) and np.array_equal(hits.prim_id, expected.prim_id), name


@pytest.mark.filterwarnings("ignore::wrt.SceneWarning")
def test_over_a_scene_file_it_is_the_pictures_world() -> None:
    path = ROOT / "scenes" / "whitted.toml"
    accel, flat = wrt.build(path), flatten_joined(wrt.load_scene(path))
    assert len(accel.geometry) == len(flat.geometry) and len(accel.geometry.spheres) == len(flat.geometry.spheres)


def test_a_mesh_that_stands_in_many_places_is_kept_once() -> None:
    big = shapes.icosphere(6)
    moved = np.eye(4)
    moved[0, 3] = 3.0
    paint = Material(), Material()
    scene = Scene(tuple(Object(big, (paint[i % 2],), np.linalg.matrix_power(moved, i)) for i in range(5)))
    accel = wrt.build(scene, "bvh2")
    assert isinstance(accel, Instances) and len(accel.geometry) == 5 * len(big.faces)
    hits = accel.closest_hit([[9.0, 0.0, 5.0], [1.5, 0.0, 5.0]], [[0.0, 0.0, -1.0]] * 2)
    assert hits.object.tolist() == hits.instance.tolist() == [3, -1] and hits.material.tolist() == [1, -1]


@pytest.mark.parametrize(("arguments", "message"), [
    ((None,), ("mesh", "Mesh, a Scene")),
    ((np.zeros((3, 3)),), ("mesh", "Mesh")),
    (((np.eye(3),),), ("mesh", "vertices, faces")), ((wrt.Camera(),), ("mesh",)),
    (("nothing.glb",), (None, "no such file", None, "nothing.glb")), (("nothing.ply",), (None, "no such file", None, "nothing.ply")),
    (("scene.toml",), (None, "no such file", None, "scene.toml")), ((wrt.Mesh(np.eye(3), [[0, 1, 2]]), 5), ("accel", "str")),
    ((wrt.Mesh(np.eye(3), [[0, 1, 2]]), "bvh", 5), ("device", "str")),
], ids=str)
def test_anything_else_is_refused_by_name(arguments: tuple[Any, ...], message: Refusal) -> None:
    with refused(*message):
        wrt.build(*arguments)


@pytest.mark.parametrize(("package", "hint"), [
    ("pyvista", "wrt.compat.pyvista.to_mesh"), ("open3d", "mesh.triangles"), ("newton", "reshape(-1, 3)"), ("mujoco", "compat.md")])
def test_a_mesh_of_another_library_has_a_way_on(package: str, hint: str) -> None:
    mesh = type("Mesh", (), {"__module__": f"{package}._src.inside"})()
    with refused("mesh", f"got a{'n' if package == 'open3d' else ''} {package}.Mesh", hint=hint):
        wrt.build(mesh)


@pytest.mark.parametrize("name", ["robot.xml", "robot.urdf", "stage.usda"])
def test_a_file_of_a_robot_leads_to_the_page(name: str) -> None:
    with refused(None, "is no mesh file", path=name, hint="docs/compat.md"):
        wrt.build(name)
