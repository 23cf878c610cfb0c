"""Irradiance of each kind of light against closed forms: the mean of weight times cosine over light samples, without shadows."""

from dataclasses import replace

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, directions, rounded, sobol_like, unit  # isort: skip
from tests.light_samples import ALL_LIGHTS, inside_out, irradiance, lamp, take
from wrt.accel.scenes.build import build
from wrt.renderer.upload import upload_scene
from wrt.scene.backgrounds import ConstantBackground, EnvironmentBackground, GradientBackground
from wrt.scene.lights import DirectionalLight, PointLight, SpotLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import icosphere, quad

ENVIRONMENT = replace(ALL_LIGHTS, background="environment")


def polygon_irradiance(corners, point, n, radiance=1.0):
    """Return the irradiance of a polygon above the horizon by Lambert's formula: E = L/2 sum of angle times edge normal . n."""
    to = unit(np.asarray(corners, float) - point)
    following = np.roll(to, -1, axis=0)
    cross = np.cross(to, following)
    angle = np.arccos(np.clip((to * following).sum(axis=1), -1.0, 1.0))
    return radiance * 0.5 * abs((angle * (unit(cross) @ n)).sum())


def test_point_light_falls_with_the_square_of_the_distance():
    scene = Scene(lights=(PointLight((0.0, 3.0, 4.0), (10.0, 20.0, 30.0)),))
    out, ray = take(scene, xi=np.zeros((1, 2)))
    assert np.allclose(out["wi"][0], [0.0, 0.6, 0.8]) and np.allclose(out["weight"][0], np.array([10, 20, 30]) / 25.0)
    assert not out["distant"][0] and not out["area"][0]
    assert np.allclose(ray["origin"][0] + ray["direction"][0], [0.0, 3.0, 4.0]) and ray["t_max"][0] == 1.0
    assert np.allclose(irradiance(scene), np.array([10, 20, 30]) / 25.0 * 0.6)


def test_directional_light():
    scene = Scene(lights=(DirectionalLight((0.0, -2.0, 0.0), (5.0, 6.0, 7.0)),))
    out, ray = take(scene, xi=np.zeros((1, 2)))
    assert np.allclose(out["wi"][0], [0.0, 1.0, 0.0]) and out["distant"][0] and np.isinf(ray["t_max"][0])
    assert np.allclose(irradiance(scene, n=(0.0, 0.6, 0.8)), np.array([5, 6, 7]) * 0.6)


@pytest.mark.parametrize(("inner", "outer"), [(0.2, 0.6), (0.0, np.pi / 2), (0.3, 0.3)])
def test_spot_falls_off_as_khr_lights_punctual_says(inner, outer):
    light = SpotLight((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (4.0, 4.0, 4.0), inner, outer)
    angle = np.concatenate([np.linspace(0.0, np.pi, 300), [0.99 * inner, 0.999 * outer, 1.001 * outer]])
    angle = angle[np.abs(angle - outer) > 1e-4]
    point = 2.0 * np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=1)
    out, _ = take(Scene(lights=(light,)), point, xi=np.zeros((len(angle), 2)))
    scale = 1.0 / max(0.001, np.cos(inner) - np.cos(outer))  # From the reference code of KHR_lights_punctual.
    expected = np.clip((np.cos(angle) - np.cos(outer)) * scale, 0.0, 1.0) ** 2
    if inner == outer:
        expected = (angle < outer).astype(float)
    assert np.abs(out["weight"][:, 0] - expected).max() < 2e-4
    assert (out["weight"][angle > outer] == 0.0).all()


def test_parallel_rectangle_by_its_form_factor():
    # The form factor of a rectangle a x b at height c, parallel to the surface, with a corner above the point (textbooks).
    a, b, c = 2.0, 1.5, 1.25
    scene = Scene(objects=(lamp(quad((0.0, c, 0.0), (a, 0.0, 0.0), (0.0, 0.0, b))),))  # Its front faces down.
    x, y = a / c, b / c
    p, q = np.sqrt(1.0 + x * x), np.sqrt(1.0 + y * y)
    factor = (x / p * np.arctan(y / p) + y / q * np.arctan(x / q)) / (2.0 * np.pi)
    found = irradiance(scene)
    assert np.allclose(found, np.pi * factor * np.array([3.0, 2.0, 1.0]), rtol=2e-3)
    corners = [[0, c, 0], [a, c, 0], [a, c, b], [0, c, b]]
    assert polygon_irradiance(corners, np.zeros(3), [0, 1, 0]) == pytest.approx(np.pi * factor)


@pytest.mark.parametrize("seed", range(6))
def test_any_triangle_by_lamberts_formula(seed):
    rng = np.random.default_rng(seed)
    corners = rounded(rng.normal(size=(3, 3)) + np.array([0.0, 4.0, 0.0]))
    corners[:, 1] = np.maximum(corners[:, 1], 0.75)
    n = unit(np.array([0.1, 1.0, -0.1]))
    scene = Scene(objects=(lamp(Mesh(corners, [[0, 1, 2]]), two_sided=True),))
    expected = polygon_irradiance(corners, np.zeros(3), n) * np.array([3.0, 2.0, 1.0])
    assert np.allclose(irradiance(scene, n=n), expected, rtol=1e-2)


def test_many_emitters_of_different_size_and_power():
    # One object has 40 triangles of sizes 1e-3 to 1 with three emissions, or dark. They must be chosen by power.
    rng = np.random.default_rng(7)
    corners = rng.normal(size=(40, 1, 3)) * [1.5, 0.3, 1.5] + [0.0, 3.0, 0.0]
    corners = rounded(corners + rng.normal(size=(40, 3, 3)) * 10.0 ** rng.uniform(-3, 0, (40, 1, 1)) * [1.0, 0.2, 1.0])
    emissions = [(1.0, 0.0, 0.0), (0.0, 5.0, 0.5), (0.0, 0.0, 0.0), (20.0, 20.0, 20.0)]
    materials = tuple(Material(emission=e, two_sided=True) for e in emissions)
    which = rng.integers(0, 4, 40)
    mesh = Mesh(corners.reshape(-1, 3), np.arange(120).reshape(-1, 3))
    scene = Scene(objects=(Object(mesh, materials, face_material=which),))
    expected = sum(polygon_irradiance(corners[i], np.zeros(3), [0, 1, 0]) * np.array(emissions[which[i]]) for i in range(40))
    found = irradiance(scene, xi=sobol_like(1 << 18, rng))
    assert np.allclose(found, expected, rtol=2e-2)


def test_a_ball_of_triangles_and_the_exact_sphere():
    radius, distance = 0.5, 2.0
    exact = np.pi * (radius / distance) ** 2
    # A convex light does not occlude its faces that face the point, so that the closed form needs no shadows.
    mesh = icosphere(4)
    ball = Mesh(mesh.vertices * radius + [0.0, distance, 0.0], mesh.faces)
    found = irradiance(Scene(objects=(lamp(ball, (1.0, 1.0, 1.0)),)), xi=sobol_like(1 << 17, np.random.default_rng(8)))
    assert np.allclose(found, exact, rtol=1e-2)
    sphere = Scene(spheres=(Sphere((0.0, distance, 0.0), radius, Material(emission=(1.0, 1.0, 1.0))),))
    assert np.allclose(irradiance(sphere), exact, rtol=1e-3)


@pytest.mark.parametrize(("ratio", "degrees"), [(1e-4, 0.0), (0.1, 0.0), (0.5, 0.0), (0.9, 0.0), (0.999, 0.0), (1e-4, 30.0),
                                                (0.1, 30.0), (0.5, 30.0), (0.8, 30.0)])
def test_sphere_light_by_its_closed_form(ratio, degrees):
    # E = pi L (r / d)^2 cos if the whole sphere is above the horizon.
    assert np.degrees(np.arcsin(ratio)) + degrees <= 90.0
    axis = np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees)), 0.0])
    sphere = Sphere(tuple(4.0 * axis), 4.0 * ratio, Material(emission=(2.0, 1.0, 0.5)))
    found = irradiance(Scene(spheres=(sphere,)))
    expected = np.pi * ratio**2 * np.cos(np.radians(degrees)) * np.array([2.0, 1.0, 0.5])
    assert np.allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (0.3, -0.5, 0.6), (0.0, 0.9999, 0.0)])
def test_inside_a_glowing_sphere_the_irradiance_is_pi_l(point, scale):
    rng = np.random.default_rng(3)
    scene = inside_out((0.0, 0.0, 0.0), scale)
    for n in directions(rng, 3):
        at = np.array(point) * scale
        out, ray = take(scene, at, n, xi=rng.random((2000, 2)))
        each = out["weight"] * np.maximum(out["wi"].astype(np.float64) @ n, 0.0)[:, None]
        assert np.allclose(each, np.pi * np.array([3.0, 2.0, 1.0]), rtol=1e-3)  # Each sample has this value: there is no noise.
        structure = build(upload_scene(scene, DEVICE).world.geometry, "bvh")
        assert not structure.any_hit(ray["origin"], ray["direction"], 0.0, ray["t_max"]).any()
        assert structure.any_hit(ray["origin"], ray["direction"], 0.0, 1.02).mean() > 0.999


def test_a_glowing_sphere_lights_its_own_inside_but_not_its_own_outside():
    # Points on the sphere are rounded to one side or the other. The normal decides whether the surface is inside.
    rng = np.random.default_rng(4)
    center = np.array([10.0, -3.0, 0.5])
    for n in directions(rng, 40):
        point = rounded(center + 2.0 * n)
        inner, outer = (irradiance(inside_out(tuple(center), 2.0), point, side * n, xi=rng.random((64, 2))) for side in (-1.0, 1.0))
        assert np.allclose(inner, np.pi * np.array([3.0, 2.0, 1.0]), rtol=1e-3) and not outer.any()


def test_constant_sky_is_pi_l_without_noise():
    scene = Scene(background=ConstantBackground((1.0, 2.0, 3.0)))
    for n in ([0, 1, 0], [0, 0, -1], unit(np.array([1.0, -2.0, 0.5]))):
        out, ray = take(scene, n=n)
        each = out["weight"] * np.maximum(out["wi"].astype(np.float64) @ n, 1e-9)[:, None]
        assert np.allclose(each.mean(axis=0), np.pi * np.array([1, 2, 3]), rtol=1e-5)
        assert each.std(axis=0).max() < 1e-2
        assert out["distant"].all() and np.isinf(ray["t_max"]).all()


def test_gradient_sky():
    scene = Scene(background=GradientBackground((1.0, 0.0, 0.5), (0.0, 2.0, 0.5)))
    features = replace(ALL_LIGHTS, background="gradient")
    up, down = (irradiance(scene, n=n, features=features) for n in ((0, 1, 0), (0, -1, 0)))
    # The integral of (y + 1) / 2 times the cosine over the upper hemisphere is pi (2/3 + 1) / 2.
    share = np.pi * (2.0 / 3.0 + 1.0) / 2.0
    bottom, top = np.array([1.0, 0.0, 0.5]), np.array([0.0, 2.0, 0.5])
    assert np.allclose(up, np.pi * bottom + share * (top - bottom), atol=2e-3)
    assert np.allclose(down, np.pi * top + share * (bottom - top), atol=2e-3)


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 5), (64, 128)])
def test_constant_environment_has_the_constant_sky_irradiance(shape):
    scene = Scene(background=EnvironmentBackground(np.full((*shape, 3), 2.0, np.float32)))
    xi = sobol_like(1 << 17, np.random.default_rng(12))
    found = irradiance(scene, n=unit(np.array([0.3, 0.5, 0.8])), features=ENVIRONMENT, xi=xi)
    assert np.allclose(found, 2.0 * np.pi, rtol=5e-3)
