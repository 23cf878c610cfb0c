"""Files that cannot describe lights: their pictures without options, and the warnings that name the added lights."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.gltf_files import GltfFile
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
    assert told[0].endswith("it has no lights but the emission of 'lamp': surfaces that it does not reach are black")


def test_a_camera_in_a_closed_box_sees_nothing_and_that_is_told(tmp_path: Path) -> None:
    pixels, told = rendered(gltf_box(tmp_path, -4, 4, translation=[0, 0, 0]))
    assert not pixels.any()
    assert len(told) == 2 and "a key light" in told[0] and "the picture is all black" in told[1]
