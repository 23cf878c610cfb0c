"""Light samples that have no closed form: lights that emit nothing to a point, ends of shadow rays, and environments."""

from dataclasses import replace

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, directions, launch, rounded, sobol_like, unit, vec3s, zeros  # isort: skip
import warp as wp

from tests.light_samples import ALL_LIGHTS, inside_out, irradiance, lamp, take
from wrt.accel.scenes.build import build
from wrt.kernels.shade import backgrounds, lights
from wrt.kernels.shade.backgrounds import environment
from wrt.kernels.structs import Background, kernel
from wrt.renderer.upload import upload_scene
from wrt.scene.backgrounds import BACKGROUNDS, EnvironmentBackground
from wrt.scene.lights import EMISSIVE, LIGHTS, PointLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene, Sphere
from wrt.scene.shapes import icosphere, quad


@kernel
def environment_kernel(b: Background, direction: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = environment(b, direction[i])


def test_both_tables_have_the_same_kinds():
    assert list(lights.LIGHTS) == [*LIGHTS, *EMISSIVE]
    assert list(backgrounds.BACKGROUNDS) == list(BACKGROUNDS)


# --- lights without area ----------------------------------------------------------------------------------------------


def test_a_surface_at_the_light_itself_gets_nothing():
    out, _ = take(Scene(lights=(PointLight((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),)), xi=np.zeros((1, 2)))
    assert np.isfinite(out["weight"]).all() and not out["weight"].any()


# --- mesh lights ------------------------------------------------------------------------------------------------------


def test_the_back_does_not_emit_unless_two_sided():
    down, up = quad((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), quad((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    lit, dark = (irradiance(Scene(objects=(lamp(mesh),))) for mesh in (down, up))
    both = irradiance(Scene(objects=(lamp(up, two_sided=True),)))
    assert lit[0] > 0.1 and (dark == 0.0).all() and np.allclose(both, lit, rtol=2e-3)


# --- sphere lights ----------------------------------------------------------------------------------------------------


def test_a_sphere_that_emits_outwards_only_gives_nothing_to_who_is_inside():
    out, _ = take(inside_out(two_sided=False))
    assert not out["weight"].any()


def random_points(rng, n):
    return rounded(rng.uniform(-2.0, 2.0, (n, 3)) * [1.0, 0.3, 1.0])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("kind", ["mesh", "ball", "sphere", "big_sphere"])
def test_the_shadow_ray_ends_just_before_the_light(kind, scale):
    # A light alone in the scene must not occlude itself. A ray that goes 2 % further must hit it.
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
    # At the silhouette of a ball of triangles, a few shadow rays in ten thousand may graze it.
    assert blocked.mean() <= (5e-4 if kind != "mesh" else 0.0)
    beyond = structure.any_hit(origin, direction, 0.0, 1.02)
    assert beyond.mean() > (0.98 if kind in ("sphere", "ball") else 0.999)


# --- the background ---------------------------------------------------------------------------------------------------


ENVIRONMENT = replace(ALL_LIGHTS, background="environment")


def radiance_of(background, direction):
    out = zeros(len(direction), wp.vec3)
    launch(environment_kernel, len(direction), upload_scene(Scene(background=background), DEVICE).lighting.background,
           vec3s(direction), out)
    return out.numpy().astype(np.float64)


def bilinear(background, direction):
    """Look up a picture in float64, as wrt.scene.backgrounds defines it: middle column along -z, columns towards +x, row 0 up."""
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
    image[1, :, 0] = [1.0, 2.0, 3.0, 4.0]  # Their centers are at -135, -45, 45 and 135 degrees from -z.
    image[0], image[2] = 10.0, 20.0
    angle = np.radians([-135.0, -45.0, 45.0, 135.0])
    level = np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=1)
    assert np.allclose(radiance_of(EnvironmentBackground(image), level)[:, 0], [1, 2, 3, 4], atol=1e-5)
    poles = radiance_of(EnvironmentBackground(image), [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    assert np.allclose(poles, [[10.0] * 3, [20.0] * 3])
    # A quarter turn counter-clockwise, seen from above, moves the pixel along -z to -x.
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
    """Return the directions and solid angles of a fine midpoint grid on the sphere."""
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
    # Samples follow the brightness: the sun, 1/288 of the picture's pixels, gets more than 20 % of the samples.
    bright = radiance_of(background, wi)[:, 0] > 5.0
    assert bright.mean() > 0.2


def test_black_environment_gives_nothing_and_no_nan():
    scene = Scene(background=EnvironmentBackground(np.zeros((4, 8, 3), np.float32)))
    out, _ = take(scene, features=ENVIRONMENT)
    assert (out["weight"] == 0.0).all() and np.isfinite(out["wi"]).all()
