"""Files that cannot describe lights or shadows of glass: their pictures without options, and the warnings that name added lights."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.gltf_files import GltfFile
from tests.refused import refused
from wrt.picture.tonemap import luminance
from wrt.scene.settings import GLASS_DEPTH, Settings
from wrt.scene.shapes import box


def gltf_box(folder: Path, low: float, high: float, emission: float = 0.0, strength: float = 1.0, **camera: Any) -> Path:
    """Write a glTF file: a white box, a small emissive box, and if `camera` has fields of its node, a camera along -z."""
    file = GltfFile()
    for (lowest, highest), glow in (((low, high), 0.0), ((-3.2, -3.0), emission)):
        mesh = box((lowest,) * 3, (highest,) * 3)
        material = file.add("materials", {"name": "lamp" if glow else "wall", "emissiveFactor": [glow] * 3,
                                          "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": strength}},
                                          "pbrMetallicRoughness": {"metallicFactor": 0.0}})
        file.node(mesh=file.mesh(file.primitive(mesh.vertices, mesh.faces.ravel(), material=material)))
    if camera:
        file.node(camera=file.add("cameras", {"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}), **camera)
    return file.write(folder, "boxes.glb")


def rendered(path: Path) -> tuple[np.ndarray, list[str]]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", wrt.SceneWarning)
        pixels = wrt.render(path, size="32x24", spp=4).pixels
    assert {each.filename for each in told} == {__file__}  # the warning names the caller's file, not a file of wrt
    return pixels, [str(each.message) for each in told]


def test_weak_emission_does_not_switch_off_the_light_that_is_added(tmp_path: Path) -> None:
    dark, _ = rendered(gltf_box(tmp_path, -1, 1))
    weak, told = rendered(gltf_box(tmp_path, -1, 1, emission=0.01))
    assert weak.mean() == pytest.approx(dark.mean(), rel=0.01) and dark.mean() > 0.2
    assert len(told) == 1 and "no lights but the emission of 'lamp', which is too weak to light it: a key light" in told[0]


def test_a_lamp_that_lights_the_scene_is_its_only_light_and_that_is_told(tmp_path: Path) -> None:
    pixels, told = rendered(gltf_box(tmp_path, -4, 4, emission=1.0, strength=2000.0, translation=[0, 0, 0]))
    assert 0.0 < np.median(pixels) and len(told) == 1
    assert "it has no lights but the emission of 'lamp': a fill light of radiance" in told[0] and "--fill 0" in told[0]


@pytest.mark.parametrize("strength", [200.0, 2000.0])
def test_the_fill_light_is_emitted_power_over_area_and_can_be_set_or_switched_off(tmp_path: Path, strength: float) -> None:
    path = gltf_box(tmp_path, -4, 4, emission=1.0, strength=strength, translation=[0, 0, 0])
    lamp, walls = 6 * 0.2**2, 6 * 8.0**2
    with pytest.warns(wrt.SceneWarning, match="fill light"):
        scene = wrt.load_scene(path)
    assert scene.ambient == pytest.approx((strength * lamp / (lamp + walls),) * 3, rel=1e-4) and 0.0 < scene.ambient_occlusion < 4.0
    with pytest.warns(wrt.SceneWarning, match="does not reach are black"):
        assert wrt.load_scene(path, fill=0).ambient == (0.0, 0.0, 0.0)
    with pytest.warns(wrt.SceneWarning, match="fill light of radiance 0.5 "):
        assert wrt.load_scene(path, fill=0.5).ambient == (0.5, 0.5, 0.5)
    (tmp_path / "a.toml").write_text("")
    with refused("fill", "glTF"):
        wrt.load_scene(tmp_path / "a.toml", fill=0.5)


@pytest.mark.parametrize("strength", [200.0, 2e6])
def test_pictures_of_a_files_own_lights_are_exposed_and_an_exposure_ends_that(tmp_path: Path, strength: float) -> None:
    path = gltf_box(tmp_path, -4, 4, emission=1.0, strength=strength, translation=[0, 0, 0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        film = wrt.render(path, size="32x24", spp=4)
        plain = wrt.render(path, size="32x24", spp=4, exposure=1.5)
    assert np.array_equal(film.pixels, plain.pixels) and plain.exposure == 1.5
    bright = np.quantile(luminance(film.pixels.astype(float)) * 2.0**film.exposure, 0.95)
    assert bright == pytest.approx(0.8, rel=0.01)


def test_a_scene_without_any_light_is_told_unless_it_is_rendered_for_its_aovs() -> None:
    scene = wrt.Scene(spheres=[wrt.Sphere((0.0, 0.0, -3.0), 1.0)], cameras=[wrt.Camera(np.eye(4))])
    with pytest.warns(wrt.SceneWarning, match="all black: the scene has no lights, no background"):
        assert not wrt.render(scene, size="16x16", spp=1).pixels.any()
    assert wrt.render(scene, size="16x16", spp=1, aov=["depth"]).aov["depth"].any()  # a warning would be an error
    glowing = wrt.Material(emission=(1.0, 1.0, 1.0))
    assert wrt.render(replace(scene, spheres=(replace(scene.spheres[0], material=glowing),)), size="16x16", spp=1).pixels.any()


def block_with_a_leaf(folder: Path, thickness: float = 1.0) -> Path:
    """A glTF file: a white leaf within a block, seen from the front along -z, whence light of irradiance pi comes.

    The block is of solid glass, or of thin glass where it has no thickness; its index of refraction is 1, so that it is not seen.
    """
    file = GltfFile()
    glass = file.add("materials", {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.0}, "extensions": {
        "KHR_materials_transmission": {"transmissionFactor": 1.0}, "KHR_materials_ior": {"ior": 1.0},
        "KHR_materials_volume": {"thicknessFactor": thickness}}})
    white = file.add("materials", {"pbrMetallicRoughness": {"metallicFactor": 0.0},
                                   "extensions": {"KHR_materials_ior": {"ior": 1.0}}})
    block = box((-1, -1, -1), (1, 1, 1))
    leaf = [[-0.9, -0.9, 0.0], [0.9, -0.9, 0.0], [0.0, 0.9, 0.0]]
    file.node(mesh=file.mesh(file.primitive(block.vertices, block.faces.ravel(), material=glass),
                             file.primitive(leaf, material=white)))
    file.node(camera=file.add("cameras", {"type": "perspective", "perspective": {"yfov": 0.01, "znear": 0.1}}),
              translation=[0, 0, 8], extensions={"KHR_lights_punctual": {"light": 0}})
    file.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "directional", "intensity": math.pi}]}}
    return file.write(folder, "block.glb")


def leaf_of(path: Path, **settings: Any) -> float:
    return float(wrt.render(path, spp=1, size=(2, 2), filter="box", **settings).pixels.mean())


@pytest.mark.filterwarnings("ignore:the picture is all black:wrt.SceneWarning")
def test_what_is_in_solid_glass_of_a_gltf_file_is_lit(tmp_path: Path) -> None:
    path = block_with_a_leaf(tmp_path)
    assert wrt.load_scene(path).settings == Settings(glass_shadows="tinted", max_depth=GLASS_DEPTH, auto_exposure=True)
    assert leaf_of(path) == pytest.approx(1.0, rel=1e-5)
    assert leaf_of(path, glass_shadows="opaque") == 0.0  # an explicit setting wins


def test_a_gltf_file_without_solid_glass_has_the_settings_of_any_scene(tmp_path: Path) -> None:
    path = block_with_a_leaf(tmp_path, thickness=0.0)
    assert wrt.load_scene(path).settings == Settings(max_depth=GLASS_DEPTH, auto_exposure=True)
    assert leaf_of(path) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize(("text", "thickness", "expected"), [
    ("", 1.0, "tinted"), ("", 0.0, "opaque"), ('[settings]\nspp = 2\n', 1.0, "tinted"),
    ('[settings]\nglass_shadows = "opaque"\n', 1.0, "opaque"), ('[settings]\nglass_shadows = "tinted"\n', 0.0, "tinted"),
    ('[override."material 0"]\nkind = "glass"\n', 1.0, "tinted"),
])
def test_a_toml_scene_that_says_nothing_takes_what_its_included_file_needs(tmp_path: Path, text: str, thickness: float,
                                                                           expected: str) -> None:
    block_with_a_leaf(tmp_path, thickness)
    for include in ('["block.glb"]', '[{ file = "block.glb", transform = { scale = 2 } }]'):
        (tmp_path / "scene.toml").write_text(f"include = {include}\n{text}")
        assert wrt.load_scene(tmp_path / "scene.toml").settings.glass_shadows == expected
