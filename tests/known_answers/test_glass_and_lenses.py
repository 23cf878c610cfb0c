"""Fresnel's curve, total reflection, a ball lens, and the circle of confusion of a thin lens, in pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest

import wrt
from tests.fresnel import fresnel
from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad

N = 1.5
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
WHITE_SKY = ConstantBackground(WHITE)


# --- Fresnel ----------------------------------------------------------------------------------------------------------

# Light that enters is absorbed: only the reflected ray sees the white sky.
INK = Material("glass", albedo=WHITE, ior=N, absorption=(1e3, 1e3, 1e3))


def reflectance(degrees: float) -> float:
    """Return the reflectance of a block of dark glass, as rendered at this angle to the normal."""
    angle = math.radians(degrees)
    camera = Camera.look_at((0.0, 3.0 * math.cos(angle), 3.0 * math.sin(angle)), (0.0, 0.0, 0.0), up=(1.0, 0.0, 0.0), fov_y=1e-4)
    scene = Scene(objects=(Object(box((-5, -5, -5), (5, 0, 5)), (INK,)),), background=WHITE_SKY, cameras=(camera,),
                  settings=Settings(filter="box", min_throughput=0.0))
    return float(wrt.render(scene, size=(4, 4), spp=4).pixels.mean())


@pytest.mark.parametrize(("degrees", "value"), [
    (0.0, 0.04), (45.0, 0.05024), (60.0, 0.08919), (80.0, 0.38770),
    (math.degrees(math.atan(N)), 0.5 * ((N**2 - 1.0) / (N**2 + 1.0)) ** 2)])  # Brewster's angle: no p-polarised light
def test_a_picture_of_fresnels_curve(degrees: float, value: float) -> None:
    assert value == pytest.approx(fresnel(math.cos(math.radians(degrees)), N), abs=1e-5)
    assert reflectance(degrees) == pytest.approx(value, abs=2e-5)


def test_total_reflection_begins_at_its_angle() -> None:
    # The camera is inside glass and sees a strip of one degree across the critical angle. Beyond that angle, the strip is dark.
    critical = math.degrees(math.asin(1.0 / N))
    assert critical == pytest.approx(41.810, abs=5e-4)
    rows, fov = 1024, math.radians(1.0)
    angle = math.radians(critical)
    camera = Camera.look_at((0.0, 0.0, 0.0), (math.sin(angle), math.cos(angle), 0.0), up=(1.0, 0.0, 0.0), fov_y=fov)
    scene = Scene(objects=(Object(box((-5, -5, -5), (5, 1, 5)), (Material("glass", albedo=WHITE, ior=N),)),),
                  background=WHITE_SKY, cameras=(camera,), settings=Settings(filter="box", max_depth=1))
    column = wrt.render(scene, size=(1, rows), spp=16).pixels[:, 0, 0]
    tangent = (1.0 - 2.0 * (np.arange(rows) + 0.5) / rows) * math.tan(0.5 * fov)
    degrees = critical + np.degrees(np.arctan(tangent))  # Up in the picture is towards grazing.
    lit = column > 0.0
    assert abs(degrees[lit].max() - critical) < 0.002 and abs(degrees[~lit].min() - critical) < 0.002
    assert not (lit[:-1] & ~lit[1:]).any()  # Dark from the critical angle on.
    # Below the critical angle, a camera inside sees n^2 times the transmitted radiance.
    for i in (rows // 2 + 100, rows - 1):
        outside = math.asin(N * math.sin(math.radians(degrees[i])))
        assert column[i] == pytest.approx(N**2 * (1.0 - fresnel(math.cos(outside), N)), rel=2e-3)


# --- a ball lens ------------------------------------------------------------------------------------------------------


def exit_slopes(distances: list[float]) -> list[float]:
    """Return the slope of rays behind a ball (R = 1, n = 1.5) over their slope before it, for points at these distances from its face.

    The sky has the radiance 1 + d_y, which shows the direction d in which a ray leaves. Light that is reflected at the
    face meets a black wall behind the camera. Light that is reflected inside is cut by max_depth.
    """
    ball = Sphere((0.0, 0.0, 0.0), 1.0, Material("glass", albedo=WHITE, ior=N))
    found = []
    for distance in distances:
        wall = Object(quad((-1e3, -1e3, 1.05 + distance), (2e3, 0, 0), (0, 2e3, 0)), (Material(albedo=BLACK),))
        camera = Camera.look_at((0.0, 0.0, 1.0 + distance), (0.0, 0.0, 0.0), fov_y=0.02)
        films = []
        for top in (2.0, 1.0):  # The second sky is constant: its picture is the transmittance.
            sky = GradientBackground(((2.0 - top,) * 3), (top,) * 3)
            scene = Scene(objects=(wall,), spheres=(ball,), background=sky, cameras=(camera,),
                          settings=Settings(filter="box", max_depth=2, min_throughput=0.0))
            films.append(wrt.render(scene, size=(2, 64), spp=64).pixels[..., 0].mean(axis=1, dtype=np.float64))
        assert np.allclose(films[1], (1.0 - fresnel(1.0, N)) ** 2, atol=1e-4)
        slope = (1.0 - 2.0 * (np.arange(64) + 0.5) / 64) * math.tan(0.01)
        found.append(float(np.polyfit(slope, films[0] / films[1] - 1.0, 1)[0]))
    return found


def test_a_ball_lens_has_its_focus_half_a_radius_behind_it() -> None:
    # In paraxial optics, the focal length is n R / (2 (n - 1)) = 1.5 from the centre, 0.5 from the face. A ray from a point
    # at distance b leaves with 1 - (b + R) / f of its slope. From the focus, it leaves parallel to the axis.
    distances = [0.1, 0.3, 0.5, 0.8, 1.2]
    found = exit_slopes(distances)
    assert found == pytest.approx([1.0 - (b + 1.0) / 1.5 for b in distances], abs=1e-3)
    gradient, offset = np.polyfit(distances, found, 1)
    assert -offset / gradient == pytest.approx(0.5, abs=1e-3)  # The back focal length.
    assert -1.0 / gradient == pytest.approx(1.5, abs=2e-3)  # The focal length.


# --- a thin lens ------------------------------------------------------------------------------------------------------

FOCAL, FOCUS, STOP, SENSOR, PIXELS = 0.1, 2.0, 1.4, 0.024, 256


def blurred_square(distance: float) -> tuple[float, float, float]:
    """Return the diameter of the circle of confusion at this distance along x and y, in pixels, and the sum of the pixels.

    The scene is a glowing square that faces the lens, 20 pixels wide without blur. The blurred picture is the convolution
    of square, disc and pixel. The variances add; a disc of diameter C has the variance C^2 / 16.
    """
    image_distance = FOCAL * FOCUS / (FOCUS - FOCAL)
    width = 20.0 * SENSOR / PIXELS * distance / image_distance
    square = quad((-0.5 * width, -0.5 * width, -distance), (width, 0, 0), (0, width, 0))
    glow = Material(albedo=BLACK, emission=WHITE, emits_light=False)
    camera = Camera(**Camera.lens(FOCAL, FOCUS, SENSOR, f_number=STOP))
    scene = Scene(objects=(Object(square, (glow,)),), cameras=(camera,), settings=Settings(filter="box", max_depth=0))
    low, high = PIXELS // 2 - 64, PIXELS // 2 + 64
    picture = wrt.render(scene, size=(PIXELS, PIXELS), spp=128, crop=(low, low, high, high)).pixels[..., 0].astype(np.float64)
    at = np.arange(128) - 63.5
    diameters = []
    for weight in (picture.sum(axis=0), picture.sum(axis=1)):
        mean = (weight * at).sum() / weight.sum()
        assert abs(mean) < 0.1
        variance = (weight * (at - mean) ** 2).sum() / weight.sum() - 20.0**2 / 12.0 - 1.0 / 12.0
        diameters.append(4.0 * math.sqrt(max(variance, 0.0)))
    return diameters[0], diameters[1], float(picture.sum())


@pytest.mark.parametrize("distance", [0.8, 1.2, 2.0, 3.5, 8.0])
def test_the_circle_of_confusion(distance: float) -> None:
    # On the sensor, C = f^2 |So / Sa - 1| / (N (So - f)): 0 to 60 pixels. So is the focus distance, Sa the distance, N the f-number.
    expected = FOCAL**2 * abs(FOCUS / distance - 1.0) / (STOP * (FOCUS - FOCAL)) * PIXELS / SENSOR
    across, upward, light = blurred_square(distance)
    if distance == FOCUS:
        assert expected == 0.0 and max(across, upward) < 1.0
    else:
        assert across == pytest.approx(expected, rel=0.01) and upward == pytest.approx(expected, rel=0.01)
    assert light == pytest.approx(20.0**2, rel=0.01)  # Blur keeps the sum of the light.


