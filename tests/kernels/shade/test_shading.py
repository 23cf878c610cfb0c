"""The table of a material's textures: both loops, the host's materials and the features have the same textures."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.core.device import records
from wrt.kernels import structs
from wrt.kernels.parameters import TEXTURES, Texels
from wrt.kernels.rows import Rows
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.shading import make_resolve, textures_of
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Surfaces, kernel
from wrt.kernels.warp_private import fields_of
from wrt.renderer.plan import features_of
from wrt.scene.cameras import Camera
from wrt.scene.materials import MATERIALS, SLOTS, Material, Texture
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import quad

PICTURE = Texture(np.zeros((1, 1, 4), np.uint8))


def test_host_and_device_have_the_same_textures() -> None:
    assert SLOTS.keys() == TEXTURES.keys() == {name for name in fields_of(structs.Material) if name.endswith("_texture")}


def test_channels_go_to_numbers_of_texels_that_follow_one_another() -> None:
    """The wave loop stores the channels of a texture in adjacent rows, so that its fields must be neighbours in Texels."""
    rows, seen = Rows(Texels, 64), []
    for texture in TEXTURES.values():
        fields = [rows.field(name) for name in texture.parameters]
        assert [each.end for each in fields[:-1]] == [each.first for each in fields[1:]]
        assert fields[-1].end - fields[0].first == len(texture.channels)
        assert list(texture.channels) == sorted(texture.channels)
        seen += texture.parameters
    assert sorted(seen) == sorted(fields_of(Texels))
    assert TEXTURES["metallic_roughness_texture"][:2] == (("roughness", "metallic"), (1, 2))
    assert TEXTURES["albedo_texture"][:2] == (("albedo", "alpha"), (0, 1, 2, 3))


@pytest.mark.parametrize("name", SLOTS)
def test_a_scene_has_the_switch_of_each_texture_that_is_read(name: str) -> None:
    for kind in MATERIALS:
        material = Material(kind, clearcoat=1.0, **{name: PICTURE})
        scene = Scene(objects=(Object(quad((0, 0, 0), (1, 0, 0), (0, 1, 0)), (material,)),))
        found = textures_of(features_of(scene, Camera()))
        assert (name in found) == material.reads(name) or TEXTURES[name].feature == ""
    assert any(Material(kind).reads(name) for kind in MATERIALS)
    assert textures_of(Features()) == {}


resolve = make_resolve(Features(textures=True, parameter_textures=True, normal_maps=True, specular=True, clearcoat=True))


@kernel
def resolve_kernel(surfaces: Surfaces, texels: wp.array(dtype=Texels), out: wp.array(dtype=structs.Material)):
    out[0] = resolve(surfaces, Surface(), texels[0])


def test_each_texture_multiplies_its_parameters() -> None:
    texels, material = records(Texels, 1), records(structs.Material, 1)
    texels.view(np.float32)[:] = 0.5
    names = [name for name in fields_of(Texels) if name in fields_of(structs.Material)]
    assert {"normal"} == set(fields_of(Texels)) - set(names)
    for name in names:
        material[name] = 0.25
    surfaces, out = Surfaces(), zeros(1, structs.Material)
    surfaces.materials = wp.array(material, dtype=structs.Material, device=DEVICE)
    launch(resolve_kernel, 1, surfaces, wp.array(texels, dtype=Texels, device=DEVICE), out)
    for name in names:
        assert (out.numpy()[name] == 0.125).all(), name
