"""Packed scenes: unpacking restores every bit, and shared objects stay shared."""

from __future__ import annotations

import json
import pickle
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from tests.data import ROOT
from tests.refused import refused
from wrt.io.load import load_scene
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.cameras import Camera
from wrt.scene.digest import digest
from wrt.scene.lights import SpotLight
from wrt.scene.materials import Material, Texture
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.pack import kinds, pack, unpack
from wrt.scene.shapes import box

SHIPPED = sorted((ROOT / "scenes").glob("*.toml"))


def sent(scene: Scene) -> Scene:
    """Return the scene that another process unpacks."""
    text, arrays = pack(scene)
    return unpack(text, pickle.loads(pickle.dumps(arrays)))


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenes_come_back(path: Any) -> None:
    scene = load_scene(path)
    back = sent(scene)
    assert digest(back) == digest(scene)
    assert [digest(camera) for camera in back.cameras] == [digest(camera) for camera in scene.cameras]
    assert back.settings == scene.settings and back.name == scene.name
    assert [material.name for material in back.materials] == [material.name for material in scene.materials]


def test_what_was_shared_is_shared_and_sent_once() -> None:
    texture = Texture(np.arange(24, dtype=np.uint8).reshape(2, 3, 4))
    one, two = Material(albedo_texture=texture), Material(albedo_texture=texture)
    mesh = box()
    scene = Scene(objects=(Object(mesh, (one, two)), Object(mesh, (one,))), spheres=(Sphere((0, 0, 0), 1.0, two),))
    back = sent(scene)
    a, b = back.objects
    assert a.mesh is b.mesh and a.materials[0] is b.materials[0] and a.materials[0] is not a.materials[1]
    assert a.materials[1] is back.spheres[0].material and len(back.materials) == 2
    assert a.materials[0].albedo_texture is a.materials[1].albedo_texture
    _, arrays = pack(scene)
    assert sum(array is mesh.vertices for array in arrays) == 1


def test_a_pose_that_another_rounding_would_change_stays_as_it_is() -> None:
    generator = np.random.default_rng(0)
    for _ in range(50):
        camera = Camera.look_at(generator.normal(size=3), generator.normal(size=3))
        back = sent(Scene(cameras=(camera,))).cameras[0]
        assert back.camera_to_world.tobytes() == camera.camera_to_world.tobytes()


def test_every_field_of_every_kind_travels() -> None:
    scene = Scene(lights=(SpotLight((0, 1, 0), (0, -1, 0), (1.0, 0.1, 1 / 3)),),
                  background=EnvironmentBackground(np.ones((2, 4, 3), np.float32), scale=0.1))
    text, _ = pack(scene)
    for name, content in json.loads(text):
        assert list(content) == [each.name for each in fields(kinds()[name])]
    assert sent(scene).lights[0] == scene.lights[0]


@pytest.mark.parametrize("text", ["", "[]", "{}", '[["Scene", {}]]', '[["os", {}]]', '[["Mesh", 1]]', '[["Scene", [{"a": 9}]]]'])
def test_another_text_is_refused(text: str) -> None:
    with refused(what="no scene"):
        unpack(text, [])
