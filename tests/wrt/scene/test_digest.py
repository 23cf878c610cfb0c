"""Digest of a scene: everything that changes a pixel changes it, and nothing else does."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from tests.data import ROOT
from wrt.io.load import load_scene
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import PointLight, SpotLight
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.model import Object, Scene, Sphere, digest
from wrt.scene.settings import Settings
from wrt.scene.shapes import box

IMAGE = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)


def scene(**changes: Any) -> Scene:
    material = Material(albedo_texture=Texture(IMAGE), name="one")
    return replace(Scene(objects=(Object(box(), (material,)),), spheres=(Sphere((0, 0, 0), 1.0, material),),
                         lights=(PointLight((0, 1, 0), (1, 1, 1)),), cameras=(Camera(),), name="scene"), **changes)


def test_a_scene_that_is_made_or_read_twice_has_one_digest() -> None:
    assert digest(scene()) == digest(scene())
    path = ROOT / "scenes" / "textures.toml"
    assert digest(load_scene(path)) == digest(load_scene(path)) != digest(scene())


def test_names_cameras_and_settings_do_not_change_it() -> None:
    same = scene(name="other", cameras=(), settings=Settings(spp=3), lights=(PointLight((0, 1, 0), (1, 1, 1), name="lamp"),))
    assert digest(same) == digest(scene())
    assert digest(Camera(name="a")) == digest(Camera()) != digest(Camera(fov_y=1.0))


def other(value: Any) -> Any:
    """Return a different value of the same type and shape."""
    if isinstance(value, np.ndarray):
        return value + value.dtype.type(1)
    return not value if isinstance(value, bool) else tuple(0.5 * each + 0.25 for each in value)


def moved(**changes: Any) -> Scene:
    thing = scene().objects[0]
    return scene(objects=(replace(thing, **changes),))


def painted(**changes: Any) -> Scene:
    thing = scene().objects[0]
    return moved(materials=(replace(thing.materials[0], **changes),))


@pytest.mark.parametrize("changed", [
    scene(objects=()), scene(objects=scene().objects * 2), scene(ambient=(0.0, 0.0, 1e-9)),
    scene(lights=(PointLight((0, 1, 0), (1, 1, 1.0001)),)), scene(lights=(SpotLight((0, 1, 0), (0, -1, 0), (1, 1, 1)),)),
    scene(background=EnvironmentBackground(np.ones((1, 1, 3)))), scene(background=EnvironmentBackground(np.ones((1, 2, 3)))),
    moved(transform=np.diag([1.0, 1.0, 1.0 + 1e-12, 1.0])), moved(mesh=replace(box(), vertices=other(box().vertices))),
    moved(mesh=replace(box(), faces=box().faces[::-1])), painted(roughness=0.1), painted(albedo_texture=Checkerboard()),
    painted(albedo_texture=Texture(other(IMAGE))), painted(albedo_texture=Texture(IMAGE, srgb=False)),
    painted(albedo_texture=None, emission_texture=Texture(IMAGE)),
], ids=range(15))
def test_whatever_changes_a_pixel_changes_it(changed: Scene) -> None:
    assert digest(changed) != digest(scene())


def test_every_field_of_a_material_but_its_name_changes_it() -> None:
    numbers = {"kind": "glass", "alpha_mode": "blend", "ior": 1.6, "exponent": 51.0}
    for each in fields(Material):
        value = getattr(Material(), each.name)
        if each.name == "name" or value is None:
            continue
        changed = numbers.get(each.name, other(value) if isinstance(value, bool | tuple) else 0.75)
        assert digest(painted(**{each.name: changed})) != digest(scene()), each.name
