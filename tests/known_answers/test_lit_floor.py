"""The photometric laws, by the radiance of a floor below point lights and directional lights."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

import wrt
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene
from wrt.scene.settings import Settings
from wrt.scene.shapes import quad
from wrt.scene.values import Color

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


@cache
def lit_floor(lights: tuple[PointLight | DirectionalLight, ...]) -> np.ndarray:
    """Return the irradiance, (3,), at the origin on a white floor that faces +y."""
    floor = Object(quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)), (Material(albedo=WHITE),))
    camera = Camera.look_at((0.3, 0.4, 0.5), (0.0, 0.0, 0.0), fov_y=1e-5)
    hidden = (PointLight((0, -1e6, 0), BLACK), DirectionalLight((0, 1, 0), BLACK))  # All tests share a kernel for both kinds of light.
    scene = Scene(objects=(floor,), lights=(*lights, *hidden), cameras=(camera,), settings=Settings(filter="box", max_depth=0))
    return math.pi * wrt.render(scene, size=(2, 2), spp=1).pixels.mean(axis=(0, 1), dtype=np.float64)


@pytest.mark.parametrize("power", range(-3, 7))
def test_the_inverse_square_law_over_ten_decades(power: int) -> None:
    distance = 10.0**power
    intensity: Color = (distance**2, 2.0 * distance**2, 0.0)
    assert np.allclose(lit_floor((PointLight((0.0, distance, 0.0), intensity),)), [1.0, 2.0, 0.0], rtol=1e-4)


@pytest.mark.filterwarnings("ignore:the picture is all black:wrt.SceneWarning")
@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 85.0, 89.9, 90.1, 120.0, 180.0])
def test_the_cosine_law_to_grazing_light_and_none_from_below(degrees: float) -> None:
    angle = math.radians(degrees)
    away = (math.sin(angle), math.cos(angle), 0.0)  # The direction from the floor to the light.
    expected = max(math.cos(angle), 0.0)
    sun = DirectionalLight((-away[0], -away[1], 0.0), WHITE)
    bulb = PointLight((5.0 * away[0], 5.0 * away[1], 0.0), (25.0,) * 3)
    for light in (sun, bulb):
        assert np.allclose(lit_floor((light,)), expected, rtol=1e-3, atol=1e-6), type(light)


def test_lights_add_up() -> None:
    lights = tuple(PointLight((0.1 * i, 2.0, 0.3), (1.0 + i, 2.0, 0.5 * i)) for i in range(4))
    assert np.allclose(lit_floor(lights), np.sum([lit_floor((light,)) for light in lights], axis=0), rtol=1e-5)
