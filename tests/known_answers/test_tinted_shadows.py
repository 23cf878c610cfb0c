"""Shadows through glass: the transmittance of a pane against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

import wrt
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad


def fresnel(angle: float, ior: float) -> float:
    """Return the unpolarised reflectance from outside, by the sine and tangent form of Fresnel's equations."""
    if angle == 0.0:
        return ((ior - 1.0) / (ior + 1.0)) ** 2
    inside = math.asin(math.sin(angle) / ior)
    s = math.sin(angle - inside) / math.sin(angle + inside)
    p = math.tan(angle - inside) / math.tan(angle + inside)
    return 0.5 * (s * s + p * p)


def floor_below(glass: Material, angle: float, shadows: str, thickness: float = 0.5) -> float:
    """Return the pane's transmittance for green: a floor's radiance in parallel light with the pane over that without it."""
    pane = box((-10, 1, -10), (10, 1 + thickness, 10)) if not glass.thin else quad((-10, 1, 10), (20, 0, 0), (0, 0, -20))
    floor = Object(quad((-10, 0, 10), (20, 0, 0), (0, 0, -20)), (Material(albedo=(1, 1, 1)),))
    light = DirectionalLight((math.sin(angle), -math.cos(angle), 0), (math.pi,) * 3)
    camera = Camera.look_at((0, 0.5, 0.8), (0, 0, 0), fov_y=0.01)

    def render(objects: tuple[Object, ...]) -> float:
        settings = Settings(filter="box", glass_shadows=shadows)
        scene = Scene(objects=objects, lights=(light,), cameras=(camera,), settings=settings)
        return float(wrt.render(scene, spp=1, size=(2, 2), max_depth=0).pixels[..., 1].mean())

    return render((floor, Object(pane, (glass,)))) / render((floor,))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 80.0])
def test_solid_glass_tints_by_both_faces_and_the_way_between(degrees: float) -> None:
    # 60 and 80 degrees are beyond the critical angle. The unbent ray must not be totally reflected at the exit.
    angle = math.radians(degrees)
    glass = Material("glass", albedo=(1.0, 0.8, 1.0), absorption=(0.0, 0.7, 0.0))
    expected = (0.8 * (1.0 - fresnel(angle, 1.5))) ** 2 * math.exp(-0.7 * 0.5 / math.cos(angle))
    assert floor_below(glass, angle, "tinted") == pytest.approx(expected, rel=1e-4)


@pytest.mark.filterwarnings("ignore:the picture is all black:wrt.SceneWarning")
def test_solid_glass_is_opaque_to_shadow_rays_by_default() -> None:
    assert floor_below(Material("glass"), 0.5, "opaque") == 0.0


@pytest.mark.parametrize("degrees", [0.0, 70.0])
def test_a_thin_pane_always_lets_light_through(degrees: float) -> None:
    angle = math.radians(degrees)
    r = fresnel(angle, 1.5)
    expected = 0.8 * (1.0 - 2.0 * r / (1.0 + r))
    pane = Material("glass", albedo=(1.0, 0.8, 1.0), thin=True)
    assert np.isclose(floor_below(pane, angle, "opaque"), expected, rtol=1e-4)


def test_absorption_counts_from_where_the_camera_stands_in_the_glass() -> None:
    ball = Sphere((0, 0, 0), 2.0, Material("glass", albedo=(1, 1, 1), ior=1.0, absorption=(1.0, 1.0, 1.0)))
    inner = Sphere((0, 0, 0), 1.0, Material("glass", albedo=(1, 1, 1), ior=1.0))
    white = {"background": ConstantBackground((1, 1, 1)), "settings": Settings(filter="box")}
    within = Camera.look_at((0, 0, 0), (0, 0, -1), fov_y=0.01)
    outside = Camera.look_at((0, 0, 9), (0, 0, 0), fov_y=0.01)
    seen = wrt.render(Scene(spheres=(ball,), cameras=(within,), **white), spp=1, size=(2, 2)).pixels.mean()
    assert seen == pytest.approx(math.exp(-2.0), rel=1e-4)
    # With a clear ball of radius 1 inside, the ray is in the absorbing glass for a length of 1 on each side.
    seen = wrt.render(Scene(spheres=(ball, inner), cameras=(outside,), **white), spp=1, size=(2, 2)).pixels.mean()
    assert seen == pytest.approx(math.exp(-2.0), rel=1e-3)
