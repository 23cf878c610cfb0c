"""What the classes of a scene say of values of the wrong type, and how they show themselves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from wrt.arguments import shown
from wrt.errors import InputError
from wrt.mesh import Mesh, load_mesh
from wrt.scene import (
    Camera,
    EnvironmentBackground,
    Material,
    Object,
    PointLight,
    Scene,
    Settings,
    Sphere,
    Texture,
)
from wrt.scene_file import load_scene
from wrt.shapes import box

GREY = Material(name="grey")


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Mesh([[0, 0, 0], [1, 0]], [[0, 1, 2]]), "vertices: must be"),
    (lambda: Mesh([["a"] * 3] * 3, [[0, 1, 2]]), "vertices must be an array of numbers"),
    (lambda: Mesh(np.eye(3), "faces"), "faces: must be"), (lambda: load_mesh(5), "path must be a path, got 5"),
    (lambda: load_scene(None), "path must be a path, got None"),
    (lambda: Object("box.obj", (GREY,)), "mesh must be a Mesh, got 'box.obj'"),
    (lambda: Object(box(), ("grey",)), r"materials\[0\] must be a Material, got 'grey'"),
    (lambda: Object(box(), 5), "materials: each must be a Material, got 5"),
    (lambda: Object(box(), GREY, transform="up"), "transform must be an array of numbers, got 'up'"),
    (lambda: Object(box(), GREY, face_material="all"), "face_material must be an array"),
    (lambda: Sphere((0, 0, 0), 1.0, None), "material must be a Material, got None"),
    (lambda: Material(albedo_texture="wood.png"), "albedo_texture must be a Texture or a Checkerboard, got 'wood.png'"),
    (lambda: Material(normal_texture=5), "normal_texture must be a Texture, got 5"),
    (lambda: EnvironmentBackground("sky.hdr"), "image must be an array of numbers, got 'sky.hdr'"),
    (lambda: Texture("wood.png"), r"image must be \(H, W, 4\) uint8"),
    (lambda: Camera(blades="six"), "blades must be a whole number, got 'six'"),
    (lambda: Camera(blades=2), r"blades must be 0 \(round\) or 3 to 64, got 2"),
    (lambda: Scene(objects=(box(),)), r"objects\[0\] must be an Object, got a Mesh"),
    (lambda: Scene(lights=5), "lights: each must be a PointLight or a DirectionalLight or a SpotLight, got 5"),
    (lambda: Scene(background=(0, 0, 0)), "background must be a ConstantBackground or .*, got \\(0, 0, 0\\)"),
    (lambda: Scene(settings={"spp": 4}), "settings must be a Settings, got a dict"),
    (lambda: Settings(spp=2.0), "spp must be a whole number, got 2.0"),
    (lambda: Settings(size="640"), "size must be two whole numbers or text"),
], ids=lambda value: value if isinstance(value, str) else "")
def test_the_wrong_type_is_told_by_name(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_one_thing_stands_for_a_tuple_of_it() -> None:
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


@pytest.mark.parametrize(("value", "expected"), [
    (None, "None"), ("x" * 100, "'" + "x" * 56 + "..."), (np.zeros((2, 3)), "an array (2, 3) of float64"), (GREY, "a Material"),
    (Object(box(), GREY), "an Object"),
], ids=str)
def test_values_are_shown_short(value: Any, expected: str) -> None:
    assert shown(value) == expected
