"""Irradiance of near and very distant area lights, whose own surface must not occlude their shadow rays."""

from __future__ import annotations

import math

import numpy as np
import pytest

import wrt
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import icosphere, quad

EMITTER = Material(albedo=(0, 0, 0), emission=(1, 1, 1))


def irradiance(light: dict, distance: float, shift: tuple[float, float, float]) -> float:
    """Return the irradiance of a floor that faces +y at `shift`, with the light `distance` above it."""
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
    assert irradiance(light, distance, shift) == pytest.approx(math.pi * (radius / distance) ** 2, rel=0.02)


@pytest.mark.parametrize("shift", SHIFTS, ids=["origin", "away", "light-at-origin"])
@pytest.mark.parametrize("distance", [1.0, 10.0, 100.0, 10_000.0])
def test_square_light(distance: float, shift: tuple[float, float, float] | int) -> None:
    shift = resolved(shift, distance)
    half = 0.4  # The square is four quarters with a corner above the point: the form factor is four times a quarter's.
    side = half / math.hypot(half, distance)
    expected = 4.0 * 0.5 * 2.0 * side * math.atan(side)
    square = Object(quad((-half, 0, -half), (2 * half, 0, 0), (0, 0, 2 * half)), (EMITTER,), transform=place(distance, shift))
    assert irradiance({"objects": (square,)}, distance, shift) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("distance", [10.0, 1000.0])
def test_mesh_light(distance: float) -> None:
    # Half of the emitters of a ball of triangles face away, and others are seen edge-on.
    ball = Object(icosphere(4, 0.4), (EMITTER,), transform=place(distance, (0, 0, 0)))
    assert irradiance({"objects": (ball,)}, distance, (0, 0, 0)) == pytest.approx(math.pi * (0.4 / distance) ** 2, rel=0.04)


@pytest.mark.parametrize(("distance", "radius"), [(10.0, 0.05), (100.0, 0.4), (1000.0, 0.05)])
def test_a_lamp_in_a_clear_bulb_is_not_shaded_by_itself(distance: float, radius: float) -> None:
    # The shadow ray passes the bulb, and must still end before the lamp in spite of the rounding of its new origin.
    clear = Material("glass", albedo=(1, 1, 1), ior=1.0, thin=True)
    lamp = Sphere((0, 0, 0), radius, EMITTER)
    bulb = Sphere((0, 0, 0), 1.5 * radius, clear)
    shift = (0.0, -distance, 0.0)
    alone = irradiance({"spheres": (lamp,)}, distance, shift)
    assert irradiance({"spheres": (lamp, bulb)}, distance, shift) == pytest.approx(alone, rel=1e-4)
