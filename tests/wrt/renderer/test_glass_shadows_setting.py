"""Default of `glass_shadows`: "tinted" for a glTF file with solid glass, since glTF has no such setting; else "opaque"."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

import wrt
from tests.gltf_files import GltfFile
from wrt.scene.settings import GLASS_DEPTH, Settings
from wrt.scene.shapes import box


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
