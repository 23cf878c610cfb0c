"""Irradiance of a floor: the photometric laws of point lights and directional lights, and area lights from near and very far.

An area light's own surface must not occlude its shadow rays.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

import wrt
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import icosphere, quad
from wrt.scene.values import Color

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


# --- lights without area ----------------------------------------------------------------------------------------------


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


# --- area lights ------------------------------------------------------------------------------------------------------

EMITTER = Material(albedo=(0, 0, 0), emission=(1, 1, 1))


def irradiance(light: dict, shift: tuple[float, float, float]) -> float:
    """Return the irradiance of a floor that faces +y at `shift`."""
    x, y, z = shift
    floor = Object(quad((x - 1, y, z + 1), (2, 0, 0), (0, 0, -2)), (Material(albedo=(1, 1, 1)),))
    camera = Camera.look_at((x + 0.5, y + 0.5, z + 0.5), (x, y, z), fov_y=0.02)
    scene = Scene(objects=(floor, *light.get("objects", ())), spheres=light.get("spheres", ()), cameras=(camera,),
                  settings=Settings(filter="box"))
    return math.pi * float(wrt.render(scene, spp=256, size=(4, 4), max_depth=0).pixels.mean())


def place(distance: float, shift: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = shift[0], shift[1] + distance, shift[2]
    return matrix


# Positions of the floor. 1 stands for the light at the origin: the light's coordinates then have small roundings, the floor's large ones.
SHIFTS = [(0.0, 0.0, 0.0), (100.0, -300.0, 50.0), 1]


def resolved(shift: tuple[float, float, float] | int, distance: float) -> tuple[float, float, float]:
    return shift if isinstance(shift, tuple) else (0.0, -distance, 0.0)


@pytest.mark.parametrize("shift", SHIFTS, ids=["origin", "away", "light-at-origin"])
@pytest.mark.parametrize("distance", [1.0, 10.0, 100.0, 10_000.0])
def test_sphere_light(distance: float, shift: tuple[float, float, float] | int) -> None:
    shift = resolved(shift, distance)
    radius = 0.4
    light = {"spheres": (Sphere((shift[0], shift[1] + distance, shift[2]), radius, EMITTER),)}
    assert irradiance(light, shift) == pytest.approx(math.pi * (radius / distance) ** 2, rel=0.02)


@pytest.mark.parametrize("shift", SHIFTS, ids=["origin", "away", "light-at-origin"])
@pytest.mark.parametrize("distance", [1.0, 10.0, 100.0, 10_000.0])
def test_square_light(distance: float, shift: tuple[float, float, float] | int) -> None:
    shift = resolved(shift, distance)
    half = 0.4  # The square is four quarters with a corner above the point: the form factor is four times a quarter's.
    side = half / math.hypot(half, distance)
    expected = 4.0 * 0.5 * 2.0 * side * math.atan(side)
    square = Object(quad((-half, 0, -half), (2 * half, 0, 0), (0, 0, 2 * half)), (EMITTER,), transform=place(distance, shift))
    assert irradiance({"objects": (square,)}, shift) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("distance", [10.0, 1000.0])
def test_mesh_light(distance: float) -> None:
    # Half of the emitters of a ball of triangles face away, and others are seen edge-on.
    ball = Object(icosphere(4, 0.4), (EMITTER,), transform=place(distance, (0, 0, 0)))
    assert irradiance({"objects": (ball,)}, (0, 0, 0)) == pytest.approx(math.pi * (0.4 / distance) ** 2, rel=0.04)


@pytest.mark.parametrize(("distance", "radius"), [(10.0, 0.05), (100.0, 0.4), (1000.0, 0.05)])
def test_a_lamp_in_a_clear_bulb_is_not_shaded_by_itself(distance: float, radius: float) -> None:
    # The shadow ray passes the bulb, and must still end before the lamp in spite of the rounding of its new origin.
    clear = Material("glass", albedo=(1, 1, 1), ior=1.0, thin=True)
    lamp = Sphere((0, 0, 0), radius, EMITTER)
    bulb = Sphere((0, 0, 0), 1.5 * radius, clear)
    shift = (0.0, -distance, 0.0)
    alone = irradiance({"spheres": (lamp,)}, shift)
    assert irradiance({"spheres": (lamp, bulb)}, shift) == pytest.approx(alone, rel=1e-4)
