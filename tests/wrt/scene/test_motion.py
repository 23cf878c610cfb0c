"""Motion by keys and morphs: positions of objects at a time."""

from __future__ import annotations

import math

import numpy as np
import pytest

import wrt
from tests.refused import refused
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, digest, moves, scene_at
from wrt.scene.motion import Motion
from wrt.scene.shapes import icosphere, torus

GREY = Material()


def key(translate=(0.0, 0.0, 0.0), rotate=(0.0, 0.0, 0.0), scale=(1.0, 1.0, 1.0)) -> list:
    return [list(translate), list(rotate), list(scale)]


def test_motion_passes_its_keys_and_is_linear_between_them() -> None:
    motion = Motion(np.array([key(), key((2.0, 0.0, 0.0), (0.0, 90.0, 0.0), (3.0, 1.0, 1.0)), key((2.0, 4.0, 0.0))]))
    np.testing.assert_allclose(motion.transform(0.0), np.eye(4))
    # Scaled, turned about y (x goes to -z), moved.
    np.testing.assert_allclose(motion.transform(0.5) @ [1, 0, 0, 1], [2, 0, -3, 1], atol=1e-12)
    np.testing.assert_allclose(motion.transform(1.0) @ [0, 0, 0, 1], [2, 4, 0, 1])
    half = math.sqrt(0.5)
    np.testing.assert_allclose(motion.transform(0.25) @ [1, 0, 0, 1], [1 + 2 * half, 0, -2 * half, 1], atol=1e-12)


def test_a_morph_goes_to_its_target_and_back() -> None:
    ball = icosphere(1)
    stretched = Mesh(ball.vertices * np.float32(2.0), ball.faces)
    motion = Motion(target=stretched)
    for time, size in ((0.0, 1.0), (0.25, 1.5), (0.5, 2.0), (0.75, 1.5), (1.0, 1.0)):
        np.testing.assert_allclose(np.linalg.norm(motion.mesh(ball, time).vertices, axis=1), size, rtol=1e-6)
    smooth = Mesh(ball.vertices, ball.faces, ball.vertices)
    mixed = Motion(target=Mesh(stretched.vertices, ball.faces, -ball.vertices)).mesh(smooth, 0.4)
    assert mixed.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mixed.normals, axis=1), 1.0, rtol=1e-6)
    halfway = Motion(target=Mesh(stretched.vertices, ball.faces, -ball.vertices)).mesh(smooth, 0.25)
    assert halfway.normals is not None and not halfway.normals.any()  # opposite normals cancel: flat shading


def test_a_scene_at_a_time_has_the_same_objects_without_motion() -> None:
    still = Object(torus(), (GREY,))
    place = np.diag([2.0, 2.0, 2.0, 1.0])
    moving = Object(icosphere(1), (GREY,), place, motion=Motion(np.array([key(), key((1.0, 0.0, 0.0))])))
    scene = Scene((still, moving))
    assert moves(scene) and not moves(scene_at(scene, 0.3))
    at = scene_at(scene, 0.5)
    assert at.objects[0] is still
    np.testing.assert_allclose(at.objects[1].transform @ [0, 0, 0, 1], [1, 0, 0, 1])
    assert digest(scene) == digest(Scene((still, Object(moving.mesh, (GREY,), place))))  # a still picture is the same


@pytest.mark.parametrize(("given", "message"), [
    ({"keys": np.zeros((2, 3))}, ("keys", "(K, 3, 3)", "motion")),
    ({"keys": np.array([key()])}, ("keys", "two keys or more", "motion")),
    ({"keys": np.array([key(), key((np.nan, 0.0, 0.0))])}, ("keys", "finite", "motion")),
    ({"keys": np.array([key(), key(scale=(-1.0, 1.0, 1.0))])}, ("keys", "scale", "motion")),
    ({"target": "ball"}, ("target", "", "motion")),
])
def test_bad_motions_are_refused(given, message) -> None:
    with refused(*message):
        Motion(**given)


def test_a_target_must_have_the_same_faces() -> None:
    with refused("target", "same faces", place="motion"):
        Object(icosphere(1), (GREY,), name="a", motion=Motion(target=icosphere(2)))


def test_a_toml_scene_says_how_meshes_move(tmp_path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text("""
[cameras.main]
position = [0, 0, 9]
target = [0, 0, 0]
[[lights]]
type = "point"
position = [0, 9, 9]
intensity = 50
[materials.m]
[[meshes]]
shape = { kind = "icosphere", subdivisions = 1 }
morph = { shape = { kind = "icosphere", subdivisions = 1, radius = 3 } }
motion = [{ scale = 2 }, { translate = [1, 0, 0], rotate = [0, 0, 90] }]
material = "m"
""")
    scene = wrt.load_scene(path)
    motion = scene.objects[0].motion
    assert motion is not None and motion.keys is not None and motion.target is not None
    assert motion.keys.tolist() == [key(scale=(2.0, 2.0, 2.0)), key((1.0, 0.0, 0.0), (0.0, 0.0, 90.0))]
    np.testing.assert_allclose(np.linalg.norm(motion.target.vertices, axis=1), 3.0, rtol=1e-6)
    path.write_text(path.read_text().replace("subdivisions = 1, radius", "subdivisions = 2, radius"))
    with refused("target", "same faces", place="meshes[0]: motion"):
        wrt.load_scene(path)
    path.write_text(path.read_text().replace('morph = { shape', 'morph = { file = "x.obj", shape'))
    with refused(what="exactly one", place="meshes[0].morph"):
        wrt.load_scene(path)
