"""Light samples against closed forms and direct integration: the mean of weight times cosine is the irradiance."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, directions, launch, rounded, sobol_like, unit, vec2s, vec3s, zeros  # isort: skip
import warp as wp

from wrt.accel.scenes.build import build
from wrt.kernels.shade import backgrounds, lights
from wrt.kernels.shade.backgrounds import environment, make_sky_point, make_sky_sample
from wrt.kernels.shade.direct import shadow_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.lights import LightSample, make_light_sample
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Background, Lighting, Ray, Surfaces, kernel
from wrt.renderer.upload import upload_scene
from wrt.scene.backgrounds import BACKGROUNDS, ConstantBackground, EnvironmentBackground, GradientBackground
from wrt.scene.lights import EMISSIVE, LIGHTS, DirectionalLight, PointLight, SpotLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import icosphere, quad

ALL_LIGHTS = Features(lights=(*LIGHTS, *EMISSIVE), sky_light=True)


@cache
def light_kernel(features):
    light_sample = make_light_sample(features)
    sky_sample, sky_point = make_sky_sample(features), make_sky_point(features)

    @kernel
    def take(lighting: Lighting, surfaces: Surfaces, point: wp.array(dtype=wp.vec3), n: wp.array(dtype=wp.vec3), light: int,
             xi: wp.array(dtype=wp.vec2), out: wp.array(dtype=LightSample), ray: wp.array(dtype=Ray)):
        i = wp.tid()
        s = Surface()
        s.point = point[i]
        s.geometric = n[i]
        s.shading = n[i]
        if light < lighting.count:
            out[i] = light_sample(lighting, surfaces, lighting.lights[light], s, xi[i])
        else:
            out[i] = sky_sample(lighting.background, n[i], sky_point(xi[i]))
        ray[i] = shadow_ray(s, out[i])

    return take


@kernel
def environment_kernel(b: Background, direction: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = environment(b, direction[i])


def take(scene, point=(0.0, 0.0, 0.0), n=(0.0, 1.0, 0.0), light=0, xi=None, features=ALL_LIGHTS):
    """Return light samples and their shadow rays as structured arrays; the light after the last is the background."""
    xi = sobol_like(1 << 15, np.random.default_rng(0)) if xi is None else xi
    on_device = upload_scene(scene, DEVICE)
    out, ray = zeros(len(xi), LightSample), zeros(len(xi), Ray)
    rows = [vec3s(np.broadcast_to(np.asarray(a, float), (len(xi), 3))) for a in (point, n)]
    launch(light_kernel(features), len(xi), on_device.lighting, on_device.surfaces, *rows, light, vec2s(xi), out, ray)
    return out.numpy(), ray.numpy()


def irradiance(scene, point=(0.0, 0.0, 0.0), n=(0.0, 1.0, 0.0), light=0, **rest):
    """Return the mean of weight times cosine over the samples, unoccluded, (3,)."""
    out, _ = take(scene, point, n, light, **rest)
    cosine = np.maximum(out["wi"].astype(np.float64) @ np.asarray(n, float), 0.0)
    return (out["weight"] * cosine[:, None]).mean(axis=0)


def lamp(mesh, emission=(3.0, 2.0, 1.0), **rest):
    return Object(mesh, (Material(emission=emission, **rest),))


def polygon_irradiance(corners, point, n, radiance=1.0):
    """Lambert's formula for a polygon wholly above the horizon, in float64: E = L/2 sum of angle times edge normal . n."""
    to = unit(np.asarray(corners, float) - point)
    following = np.roll(to, -1, axis=0)
    cross = np.cross(to, following)
    angle = np.arccos(np.clip((to * following).sum(axis=1), -1.0, 1.0))
    return radiance * 0.5 * abs((angle * (unit(cross) @ n)).sum())


def test_both_tables_have_the_same_kinds():
    assert list(lights.LIGHTS) == [*LIGHTS, *EMISSIVE]
    assert list(backgrounds.BACKGROUNDS) == list(BACKGROUNDS)


# --- lights without area ----------------------------------------------------------------------------------------------


def test_point_light_falls_with_the_square_of_the_distance():
    scene = Scene(lights=(PointLight((0.0, 3.0, 4.0), (10.0, 20.0, 30.0)),))
    out, ray = take(scene, xi=np.zeros((1, 2)))
    assert np.allclose(out["wi"][0], [0.0, 0.6, 0.8]) and np.allclose(out["weight"][0], np.array([10, 20, 30]) / 25.0)
    assert not out["distant"][0] and not out["area"][0]
    assert np.allclose(ray["origin"][0] + ray["direction"][0], [0.0, 3.0, 4.0]) and ray["t_max"][0] == 1.0
    assert np.allclose(irradiance(scene), np.array([10, 20, 30]) / 25.0 * 0.6)


def test_a_surface_at_the_light_itself_gets_nothing():
    out, _ = take(Scene(lights=(PointLight((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),)), xi=np.zeros((1, 2)))
    assert np.isfinite(out["weight"]).all() and not out["weight"].any()


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
    scale = 1.0 / max(0.001, np.cos(inner) - np.cos(outer))  # the extension's reference code
    expected = np.clip((np.cos(angle) - np.cos(outer)) * scale, 0.0, 1.0) ** 2
    if inner == outer:
        expected = (angle < outer).astype(float)
    assert np.abs(out["weight"][:, 0] - expected).max() < 2e-4
    assert (out["weight"][angle > outer] == 0.0).all()


# --- mesh lights ------------------------------------------------------------------------------------------------------


def test_parallel_rectangle_by_its_form_factor():
    # A rectangle a x b at height c, parallel to the surface, with a corner right above the point (any radiation textbook).
    a, b, c = 2.0, 1.5, 1.25
    scene = Scene(objects=(lamp(quad((0.0, c, 0.0), (a, 0.0, 0.0), (0.0, 0.0, b))),))  # its front faces down
    x, y = a / c, b / c
    p, q = np.sqrt(1.0 + x * x), np.sqrt(1.0 + y * y)
    factor = (x / p * np.arctan(y / p) + y / q * np.arctan(x / q)) / (2.0 * np.pi)
    found = irradiance(scene)
    assert np.allclose(found, np.pi * factor * np.array([3.0, 2.0, 1.0]), rtol=2e-3)
    corners = [[0, c, 0], [a, c, 0], [a, c, b], [0, c, b]]
    assert polygon_irradiance(corners, np.zeros(3), [0, 1, 0]) == pytest.approx(np.pi * factor)


def test_the_back_does_not_emit_unless_two_sided():
    down, up = quad((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), quad((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    lit, dark = (irradiance(Scene(objects=(lamp(mesh),))) for mesh in (down, up))
    both = irradiance(Scene(objects=(lamp(up, two_sided=True),)))
    assert lit[0] > 0.1 and (dark == 0.0).all() and np.allclose(both, lit, rtol=2e-3)


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
    # One object, 40 triangles from 1e-3 to 1 in size, three emissions, some dark: chosen by power, none forgotten.
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
    # A convex light occludes none of its faces that turn to the point: the closed form needs no shadows.
    mesh = icosphere(4)
    ball = Mesh(mesh.vertices * radius + [0.0, distance, 0.0], mesh.faces)
    found = irradiance(Scene(objects=(lamp(ball, (1.0, 1.0, 1.0)),)), xi=sobol_like(1 << 17, np.random.default_rng(8)))
    assert np.allclose(found, exact, rtol=1e-2)
    sphere = Scene(spheres=(Sphere((0.0, distance, 0.0), radius, Material(emission=(1.0, 1.0, 1.0))),))
    assert np.allclose(irradiance(sphere), exact, rtol=1e-3)


# --- sphere lights ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ratio", "degrees"), [(1e-4, 0.0), (0.1, 0.0), (0.5, 0.0), (0.9, 0.0), (0.999, 0.0), (1e-4, 30.0),
                                                (0.1, 30.0), (0.5, 30.0), (0.8, 30.0)])
def test_sphere_light_by_its_closed_form(ratio, degrees):
    # E = pi L (r / d)^2 cos, as long as the sphere is wholly above the horizon.
    assert np.degrees(np.arcsin(ratio)) + degrees <= 90.0
    axis = np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees)), 0.0])
    sphere = Sphere(tuple(4.0 * axis), 4.0 * ratio, Material(emission=(2.0, 1.0, 0.5)))
    found = irradiance(Scene(spheres=(sphere,)))
    expected = np.pi * ratio**2 * np.cos(np.radians(degrees)) * np.array([2.0, 1.0, 0.5])
    assert np.allclose(found, expected, rtol=2e-3)


def inside_out(center=(0.0, 0.1, 0.0), radius=1.0, two_sided=True):
    return Scene(spheres=(Sphere(center, radius, Material(emission=(3.0, 2.0, 1.0), two_sided=two_sided)),))


def test_a_sphere_that_emits_outwards_only_gives_nothing_to_who_is_inside():
    out, _ = take(inside_out(two_sided=False))
    assert not out["weight"].any()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (0.3, -0.5, 0.6), (0.0, 0.9999, 0.0)])
def test_inside_a_glowing_sphere_the_irradiance_is_pi_l(point, scale):
    rng = np.random.default_rng(3)
    scene = inside_out((0.0, 0.0, 0.0), scale)
    for n in directions(rng, 3):
        at = np.array(point) * scale
        out, ray = take(scene, at, n, xi=rng.random((2000, 2)))
        each = out["weight"] * np.maximum(out["wi"].astype(np.float64) @ n, 0.0)[:, None]
        assert np.allclose(each, np.pi * np.array([3.0, 2.0, 1.0]), rtol=1e-3)  # each sample alone: there is no noise
        structure = build(upload_scene(scene, DEVICE).world.geometry, "bvh")
        assert not structure.any_hit(ray["origin"], ray["direction"], 0.0, ray["t_max"]).any()
        assert structure.any_hit(ray["origin"], ray["direction"], 0.0, 1.02).mean() > 0.999


def test_a_glowing_sphere_lights_its_own_inside_but_not_its_own_outside():
    # At points on the sphere itself, rounded to one side or the other, the normal tells which side is meant.
    rng = np.random.default_rng(4)
    center = np.array([10.0, -3.0, 0.5])
    for n in directions(rng, 40):
        point = rounded(center + 2.0 * n)
        inner, outer = (irradiance(inside_out(tuple(center), 2.0), point, side * n, xi=rng.random((64, 2))) for side in (-1.0, 1.0))
        assert np.allclose(inner, np.pi * np.array([3.0, 2.0, 1.0]), rtol=1e-3) and not outer.any()


def random_points(rng, n):
    return rounded(rng.uniform(-2.0, 2.0, (n, 3)) * [1.0, 0.3, 1.0])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("kind", ["mesh", "ball", "sphere", "big_sphere"])
def test_the_shadow_ray_ends_just_before_the_light(kind, scale):
    # Alone in the scene, a light must not shade itself; a sheet a little before it must.
    rng = np.random.default_rng(9)
    n = 20_000
    ball = icosphere(3)
    tilted = quad((-1.0, 3.0, -1.0), (2.0, 0.5, 0.0), (0.0, 0.25, 2.0))
    meshes = {"mesh": tilted, "ball": Mesh(ball.vertices + np.array([0.0, 3.0, 0.0]), ball.faces)}
    if kind in meshes:
        mesh = Mesh(meshes[kind].vertices * scale, meshes[kind].faces)
        scene = Scene(objects=(lamp(mesh),))
    else:
        center, radius = ((0.0, 3.0, 0.0), 1.0) if kind == "sphere" else ((0.0, 1001.0, 0.0), 1000.0)
        scene = Scene(spheres=(Sphere(tuple(scale * c for c in center), scale * radius, Material(emission=(1.0, 1.0, 1.0))),))
    point = random_points(rng, n) * scale
    out, ray = take(scene, point, xi=rng.random((n, 2)))
    lit = out["weight"].max(axis=1) > 0.0
    assert lit.sum() > 1000
    structure = build(upload_scene(scene, DEVICE).world.geometry, "bvh")
    origin, direction = ray["origin"][lit], ray["direction"][lit]
    blocked = structure.any_hit(origin, direction, 0.0, ray["t_max"][lit])
    # At the rim of a ball the way touches it: a few in ten thousand may graze.
    assert blocked.mean() <= (5e-4 if kind != "mesh" else 0.0)
    beyond = structure.any_hit(origin, direction, 0.0, 1.02)
    assert beyond.mean() > (0.98 if kind in ("sphere", "ball") else 0.999)


# --- the background ---------------------------------------------------------------------------------------------------


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
    # Integral of (y + 1) / 2 times the cosine over the upper hemisphere: pi (2/3 + 1) / 2.
    share = np.pi * (2.0 / 3.0 + 1.0) / 2.0
    bottom, top = np.array([1.0, 0.0, 0.5]), np.array([0.0, 2.0, 0.5])
    assert np.allclose(up, np.pi * bottom + share * (top - bottom), atol=2e-3)
    assert np.allclose(down, np.pi * top + share * (bottom - top), atol=2e-3)


ENVIRONMENT = replace(ALL_LIGHTS, background="environment")


def radiance_of(background, direction):
    out = zeros(len(direction), wp.vec3)
    launch(environment_kernel, len(direction), upload_scene(Scene(background=background), DEVICE).lighting.background,
           vec3s(direction), out)
    return out.numpy().astype(np.float64)


def bilinear(background, direction):
    """Look up a picture by the definition in wrt.scene.backgrounds, in float64: middle column along -z, columns towards +x, line 0 up."""
    image = background.image.astype(np.float64)
    height, width = image.shape[:2]
    c, s = np.cos(-background.rotation), np.sin(-background.rotation)
    x, y, z = np.asarray(direction, float).T
    x, z = c * x + s * z, c * z - s * x
    column = (0.5 + np.arctan2(x, -z) / (2.0 * np.pi)) * width - 0.5
    row = np.arccos(np.clip(y, -1.0, 1.0)) / np.pi * height - 0.5
    left, upper = np.floor(column).astype(int), np.floor(row).astype(int)
    total = np.zeros((len(x), 3))
    for i in (left, left + 1):
        for j in (upper, upper + 1):
            weight = (1.0 - np.abs(column - i)) * (1.0 - np.abs(row - j))
            total += weight[:, None] * image[np.clip(j, 0, height - 1), i % width]
    return background.scale * total


def test_environment_directions():
    image = np.zeros((3, 4, 3), np.float32)
    image[1, :, 0] = [1.0, 2.0, 3.0, 4.0]  # their centers are seen at -135, -45, 45 and 135 degrees from -z
    image[0], image[2] = 10.0, 20.0
    angle = np.radians([-135.0, -45.0, 45.0, 135.0])
    level = np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=1)
    assert np.allclose(radiance_of(EnvironmentBackground(image), level)[:, 0], [1, 2, 3, 4], atol=1e-5)
    poles = radiance_of(EnvironmentBackground(image), [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    assert np.allclose(poles, [[10.0] * 3, [20.0] * 3])
    # A quarter turn counter-clockwise, seen from above, brings what was seen along -z to -x.
    turned = EnvironmentBackground(image, rotation=np.pi / 2)
    plain = radiance_of(EnvironmentBackground(image), [[0.0, 0.0, -1.0]])
    assert np.allclose(radiance_of(turned, [[-1.0, 0.0, 0.0]]), plain, atol=1e-5)


@pytest.mark.parametrize("shape", [(8, 16), (5, 3), (1, 1), (2, 1)])
@pytest.mark.parametrize("rotation", [0.0, 2.5])
def test_environment_look_up(shape, rotation):
    rng = np.random.default_rng(10)
    background = EnvironmentBackground(rng.random((*shape, 3)).astype(np.float32), scale=2.5, rotation=rotation)
    d = np.concatenate([directions(rng, 3000), np.eye(3)[[0, 2]], -np.eye(3)[[0, 2]]])
    assert np.abs(radiance_of(background, d) - bilinear(background, d)).max() < 2e-4


def sky_with_a_sun(rng, shape=(12, 24)):
    image = 0.1 + 0.2 * rng.random((*shape, 3))
    image[2, 17] = [400.0, 300.0, 200.0]
    image[7, 0] = [0.0, 50.0, 0.0]
    image[9:, 5:12] = 0.0
    return image.astype(np.float32)


def sphere_grid(rows=720, columns=1440):
    """Directions and solid angles of a fine midpoint grid."""
    theta = np.pi * (np.arange(rows) + 0.5) / rows
    phi = 2.0 * np.pi * (np.arange(columns) + 0.5) / columns
    t, p = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], axis=-1).reshape(-1, 3)
    band = np.cos(np.pi * np.arange(rows) / rows) - np.cos(np.pi * np.arange(1, rows + 1) / rows)
    return d, np.repeat(band * 2.0 * np.pi / columns, columns)


@pytest.mark.parametrize("rotation", [0.0, 1.0])
def test_environment_sampling_is_unbiased(rotation):
    rng = np.random.default_rng(11)
    background = EnvironmentBackground(sky_with_a_sun(rng), scale=0.5, rotation=rotation)
    scene = Scene(background=background)
    d, solid_angle = sphere_grid()
    radiance = bilinear(background, d)
    out, _ = take(scene, xi=sobol_like(1 << 18, rng), features=ENVIRONMENT)
    wi, weight = out["wi"].astype(np.float64), out["weight"].astype(np.float64)
    assert np.abs(np.linalg.norm(wi, axis=1) - 1.0).max() < 1e-5
    assert np.isfinite(weight).all() and (weight >= 0.0).all()
    for test in (lambda d: np.ones(len(d)), lambda d: np.maximum(d[:, 1], 0.0), lambda d: np.maximum(-d[:, 1], 0.0),
                 lambda d: np.maximum(d @ unit(np.array([1.0, 0.2, -0.5])), 0.0) ** 4):
        expected = (test(d) * solid_angle) @ radiance
        assert np.allclose((test(wi)[:, None] * weight).mean(axis=0), expected, rtol=1e-2)
    # By brightness: the sun, 1/288 of the picture's pixels, draws a good part of the samples.
    bright = radiance_of(background, wi)[:, 0] > 5.0
    assert bright.mean() > 0.2


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 5), (64, 128)])
def test_constant_environment_has_the_constant_sky_irradiance(shape):
    scene = Scene(background=EnvironmentBackground(np.full((*shape, 3), 2.0, np.float32)))
    xi = sobol_like(1 << 17, np.random.default_rng(12))
    found = irradiance(scene, n=unit(np.array([0.3, 0.5, 0.8])), features=ENVIRONMENT, xi=xi)
    assert np.allclose(found, 2.0 * np.pi, rtol=5e-3)


def test_black_environment_gives_nothing_and_no_nan():
    scene = Scene(background=EnvironmentBackground(np.zeros((4, 8, 3), np.float32)))
    out, _ = take(scene, features=ENVIRONMENT)
    assert (out["weight"] == 0.0).all() and np.isfinite(out["wi"]).all()
