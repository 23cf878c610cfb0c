"""Limits of lights, in Python and in scene files."""

import math

import numpy as np
import pytest

from tests.refused import refused
from wrt.io.load import load_scene
from wrt.scene.cameras import Camera
from wrt.scene.lights import SpotLight
from wrt.scene.materials import Material

HALF = float(np.float32(math.pi / 2))  # larger than pi / 2


def spot(**angles: float) -> SpotLight:
    return SpotLight((0, 0, 0), (0, 0, 1), (1, 1, 1), **angles)


def test_a_value_that_rounding_takes_past_its_limit_is_the_limit():
    assert spot(outer=HALF).outer == math.pi / 2
    assert spot(inner=float(np.float32(0.3)), outer=0.3).inner == 0.3 < float(np.float32(0.3))
    assert spot(inner=0.25, outer=0.5).inner == 0.25
    assert Material(albedo=(1.0000001192, 0.5, 1.0), roughness=1.0000001192).albedo == (1.0, 0.5, 1.0)
    assert Camera(fov_y=math.radians(179.94) * 1.0000001).fov_y == pytest.approx(math.radians(179.94), rel=1e-15)


@pytest.mark.parametrize("angles, name", [
    ({"outer": 1.571}, "outer"), ({"inner": 0.301, "outer": 0.3}, "inner"), ({"inner": -1e-9}, "inner")])
def test_a_value_further_out_is_refused(angles, name):
    with refused(name):
        spot(**angles)


def test_the_same_in_a_scene_file(tmp_path):
    text = """
[cameras.main]
position = [0, 0, 5]
target = [0, 0, 0]
[[lights]]
type = "spot"
position = [0, 3, 0]
direction = [0, -1, 0]
intensity = 1
outer = {}
[[spheres]]
center = [0, 0, 0]
radius = 1.0
material = "a"
[materials.a]
kind = "metallic_roughness"
albedo = [1.0000001, 0.5, 0.5]
roughness = 1.0000001
"""
    path = tmp_path / "scene.toml"
    path.write_text(text.format(math.degrees(HALF)))
    scene = load_scene(path)
    assert scene.lights[0].outer == math.pi / 2 and scene.materials[0].albedo == (1.0, 0.5, 0.5) and scene.materials[0].roughness == 1.0
    path.write_text(text.format(90.01))
    with refused(what="90"):
        load_scene(path)
