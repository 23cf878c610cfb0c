"""Messages of scene classes about values of a wrong type, and their representations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.refused import Refusal, refused
from wrt.accel.scenes.build import build
from wrt.io.load import load_scene
from wrt.io.mesh_file import load_mesh
from wrt.picture.film import Film
from wrt.renderer.render import render
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import PointLight
from wrt.scene.materials import Material, Texture
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad

GREY = Material(name="grey")


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Mesh([[0, 0, 0], [1, 0]], [[0, 1, 2]]), ("vertices",)),
    (lambda: Mesh([["a"] * 3] * 3, [[0, 1, 2]]), ("vertices", "array of numbers")),
    (lambda: Mesh(np.eye(3), "faces"), ("faces",)), (lambda: load_mesh(5), ("path",)),
    (lambda: load_scene(None), ("path",)),
    (lambda: Object("box.obj", (GREY,)), ("mesh", "Mesh", "object")),
    (lambda: Object(box(), ("grey",)), ("materials[0]", "Material", "object")),
    (lambda: Object(box(), 5), ("each", "Material", "object: materials")),
    (lambda: Object(box(), GREY, transform="up"), ("transform", "array of numbers", "object")),
    (lambda: Object(box(), GREY, face_material="all"), ("face_material", "array", "object")),
    (lambda: Sphere((0, 0, 0), 1.0, None), ("material", "Material", "sphere")),
    (lambda: Material(albedo_texture="wood.png"), ("albedo_texture", "Texture or a Checkerboard", "material")),
    (lambda: Material(normal_texture=5), ("normal_texture", "Texture", "material")),
    (lambda: EnvironmentBackground("sky.hdr"), ("image", "array of numbers", "environment")),
    (lambda: Texture("wood.png"), ("image", "(H, W, 4) uint8", "texture")),
    (lambda: Camera(blades="six"), ("blades", "whole number", "camera")),
    (lambda: Camera(blades=2), ("blades", "0 (round)", "camera")),
    (lambda: Scene(objects=(box(),)), ("objects[0]", "Object")),
    (lambda: Scene(lights=5), ("each", "PointLight", "lights")),
    (lambda: Scene(background=(0, 0, 0)), ("background", "ConstantBackground")),
    (lambda: Scene(settings={"spp": 4}), ("settings", "Settings")),
    (lambda: Material(kind="gold"), ("kind", "must be one", "material")),
    (lambda: Material(kind="gold", name="ring"), ("kind", "must be one", "material 'ring'")),
    (lambda: PointLight((0, 0), 1), ("position", "three finite numbers", "light")),
    (lambda: Settings(spp=2.0), ("spp", "whole number")),
    (lambda: Settings(size="640"), ("size", "two whole numbers")),
], ids=lambda value: value if isinstance(value, str) else "")
def test_a_wrong_type_is_named(make: Callable[[], Any], message: Refusal) -> None:
    with refused(*message):
        make()


@pytest.mark.parametrize("matrix", [np.diag([1e39, 1, 1, 1]), np.diag([1, 1, 1e19, 1]),
                                    [[1, 0, 0, -2e18], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]], ids=["wide", "deep", "far"])
def test_objects_out_of_reach_are_refused(matrix: Any) -> None:
    with refused(what="reaches", place="object 'planet'"):
        Object(box(), GREY, matrix, name="planet")


def test_what_is_within_reach_is_hit_and_lit() -> None:
    def picture(size: float) -> Film:
        lamp = Object(quad((-2, 3, -2), (4, 0, 0), (0, 0, 4)), Material(albedo=0, emission=3.0), np.diag([size] * 3 + [1.0]))
        camera = Camera.look_at((2 * size, 2 * size, 4 * size), (0, 0, 0))
        scene = Scene((Object(box(), GREY, lamp.transform), lamp), cameras=(camera,))
        return render(scene, size=(16, 9), spp=4, aov="depth")

    unit, large = picture(1.0), picture(2.0**57)  # 1.4e17: the lamp reaches 4.3e17
    assert np.isfinite(unit.aov["depth"]).any() and unit.pixels.max() > 0.0
    assert np.allclose(large.aov["depth"] / 2.0**57, unit.aov["depth"], rtol=1e-6)
    assert np.allclose(large.pixels, unit.pixels, rtol=1e-3, atol=1e-5)


def test_meshes_end_at_1e30() -> None:
    vertices = np.float32([[0, 0, 0], [1e29, 0, 0], [0, 1e30, 0]])
    hits = build(Mesh(vertices, [[0, 1, 2]])).closest_hit([[1e28, 1e29, 1e29]], [[0, 0, -1]])
    assert hits.prim_id.tolist() == [0] and hits.t.tolist() == [np.float32(1e29)]
    with refused("vertices", "row 2"):
        Mesh(vertices * 3, [[0, 1, 2]])


def test_a_single_object_stands_for_a_tuple() -> None:
    scene = Scene(Object(box(), GREY), Sphere((0, 0, 0), 1, GREY), PointLight((0, 5, 0), 1), Camera())
    assert [len(each) for each in (scene.objects, scene.spheres, scene.lights, scene.cameras)] == [1] * 4
    assert Settings(size=" 32x18 ").size == (32, 18) and Settings(size=np.array([3, 4])).size == (3, 4)


def test_representations_are_a_line() -> None:
    mesh = box()
    assert repr(mesh) == "Mesh('box', 24 vertices, 12 faces, uvs, from (-0.5, -0.5, -0.5) to (0.5, 0.5, 0.5))"
    assert repr(Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))) == "Mesh(0 vertices, 0 faces)"
    scene = Scene((Object(mesh, GREY, np.diag([1, 2, 3, 1])),), (), (PointLight((0, 5, 0), 1),), (Camera(), Camera()), name="s")
    assert repr(scene) == ("Scene('s', 12 triangles, 1 object, 1 material, 1 light, 2 cameras,"
                           " from (-0.5, -1, -1.5) to (0.5, 1, 1.5))")
    assert repr(Scene()) == "Scene()"
    sky = EnvironmentBackground(np.ones((8, 16, 3)))
    for thing in (Object(mesh, GREY), sky, Texture(np.zeros((4, 4, 4), np.uint8))):
        assert "\n" not in repr(thing) and "array" not in repr(thing)
