"""Whole renders of scenes with known radiance: mirrors, glass, lights over floors, and blending.

A kernel is compiled for a scene's features. Scenes here have distant hidden objects with more features, so that they share kernels.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.fresnel import fresnel
from wrt.kernels.shade.follow_up import MAX_RAYS
from wrt.kernels.shade.shadows import MAX_TRANSPARENT
from wrt.renderer.render import render
from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight, SpotLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, icosphere, quad

ONE = (1.0, 1.0, 1.0)
WHITE_SKY = ConstantBackground(ONE)
SETTINGS = Settings(size=(8, 8), spp=4, max_depth=30, min_throughput=0.0, filter="box")


def moved(mesh, scale=1.0, by=(0.0, 0.0, 0.0)):
    """Return the mesh without normals, scaled and moved."""
    return Mesh(mesh.vertices.astype(np.float64) * scale + by, mesh.faces)


def hidden(*materials):
    """Return a tiny triangle for each material, far behind the cameras of this file."""
    return tuple(Object(Mesh([[0, i, 1e4], [1e-3, i, 1e4], [0, i + 1e-3, 1e4]], [[0, 1, 2]]), (material,))
                 for i, material in enumerate(materials))


def glow(radiance=1.0):
    """Return a material that glows for cameras, but is no light and reflects nothing."""
    return Material(albedo=(0.0,) * 3, emission=(radiance,) * 3, emits_light=False)


def toward(target=(0.0, 0.0, 0.0), position=(0.0, 0.0, 5.0), fov=0.01, **rest):
    return Camera.look_at(position, target, fov_y=fov, **rest)


# --- mirrors ----------------------------------------------------------------------------------------------------------

HALF_MIRROR = Material("mirror", albedo=(0.5,) * 3, emission=(0.5,) * 3, two_sided=True)
MIRROR_BOX = Scene(objects=(Object(box((-1, -1, -1), (1, 1, 1)), (HALF_MIRROR,)),), settings=SETTINGS,
                   cameras=(Camera.look_at((0.3, 0.2, 0.1), (1.0, 0.4, 0.3), fov_y=1.5),))


@pytest.mark.parametrize("depth", [0, 1, 2, 5, 20])
def test_a_box_of_glowing_half_mirrors(depth):
    film = render(MIRROR_BOX, max_depth=depth)
    assert np.allclose(film.pixels, 1.0 - 0.5 ** (depth + 1), rtol=1e-6)
    assert film.stats["cut_by_depth"] == film.stats["samples"] == 8 * 8 * 4
    assert film.stats["rays"] == (depth + 1) * 8 * 8 * 4
    assert film.stats["lost_throughput_per_sample"] == pytest.approx(0.5 ** (depth + 1), rel=1e-5)
    assert film.stats["cut_by_throughput"] == 0 and film.stats["not_finite"] == 0


def test_cut_by_throughput():
    film = render(MIRROR_BOX, min_throughput=0.1)
    assert np.allclose(film.pixels, 1.0 - 0.5**4)  # The fourth reflection would have the throughput 1/16.
    assert film.stats["cut_by_throughput"] == film.stats["samples"] and film.stats["cut_by_depth"] == 0
    assert film.stats["lost_throughput_per_sample"] == pytest.approx(1.0 / 16.0)


def test_white_mirrors_vanish_in_a_white_room():
    mirror = Material("mirror", albedo=ONE)
    ball = Object(moved(icosphere(2)), (mirror,))
    scene = Scene(objects=(ball, *hidden(HALF_MIRROR)), background=WHITE_SKY, cameras=(toward(fov=0.6),), settings=SETTINGS)
    film = render(scene)
    assert np.allclose(film.pixels, 1.0, atol=1e-6) and film.stats["rays_per_sample"] > 1.3


# --- glass ------------------------------------------------------------------------------------------------------------

CLEAR = Material("glass", albedo=ONE, ior=1.5)
GLASS_EXTRA = (Material("glass", absorption=(1e-3, 1e-3, 1e-3)), glow())


def glass_scene(*objects, camera, background=None, spheres=()):
    far = Sphere((0.0, 100.0, 1e4), 1e-3, glow())
    return Scene(objects=(*objects, *hidden(*GLASS_EXTRA)), spheres=(*spheres, far), cameras=(camera,), settings=SETTINGS,
                 background=background or ConstantBackground())


def test_clear_glass_vanishes_in_a_white_room():
    # Glass is lossless: reflected and refracted light sum to 1, except for the counted rays that are cut.
    balls = (Object(moved(icosphere(2), 0.9, (-1.2, 0.0, 0.0)), (CLEAR,)), Object(moved(box(), 1.0, (0.0, 1.4, 0.0)), (CLEAR,)))
    scene = glass_scene(*balls, spheres=(Sphere((1.2, 0.0, 0.0), 0.9, CLEAR),), background=WHITE_SKY, camera=toward(fov=0.9))
    film = render(scene, size=(12, 12))
    lost = film.stats["lost_throughput_per_sample"]
    assert film.stats["rays_per_sample"] > 3.0
    assert 1e-4 < lost < 0.05 and (film.pixels <= 1.0 + 1e-5).all()
    # `lost` is the light of all cut rays, also of the rays cut inside glass.
    assert film.pixels.mean(dtype=np.float64) == pytest.approx(1.0 - lost, abs=1e-5)
    flat = render(scene, max_depth=30, camera=toward((0.0, 1.4, 0.0), (0.0, 1.4, 5.0)))
    assert np.allclose(flat.pixels, 1.0, atol=1e-4)


def slab_scene(thickness=1.0, degrees=0.0, material=CLEAR, camera=None):
    """Return a slab before a glowing wall. The space behind the camera is dark: only light through the slab is visible."""
    slab = box((-50.0, -50.0, -0.5 * thickness), (50.0, 50.0, 0.5 * thickness))
    angle = np.radians(degrees)
    turn = np.eye(4)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    # The wall is so small that rays reflected by the face of a steep slab miss it.
    wall = Object(quad((-20.0, -20.0, -60.0), (40.0, 0.0, 0.0), (0.0, 40.0, 0.0)), (glow(),))
    return glass_scene(Object(slab, (material,), turn), wall, camera=camera or toward())


def slab_transmittance(cosine, n, inside=1.0):
    """Return a slab's transmittance with all inner reflections, (1 - R)^2 a / (1 - R^2 a^2). `inside` is a, for one crossing."""
    r = fresnel(cosine, n)
    return (1.0 - r) ** 2 * inside / (1.0 - (r * inside) ** 2)


def test_a_slab_transmits_twelve_thirteenths():
    assert slab_transmittance(1.0, 1.5) == pytest.approx(12.0 / 13.0)
    film = render(slab_scene())
    assert np.allclose(film.pixels, 12.0 / 13.0, atol=1e-5)


@pytest.mark.parametrize("degrees", [30.0, 60.0])
def test_a_slanted_slab(degrees):
    # A Whitted tracer takes light as unpolarised at every boundary, so that the series has the mean reflectance.
    film = render(slab_scene(degrees=degrees))
    assert film.pixels.mean() == pytest.approx(slab_transmittance(np.cos(np.radians(degrees)), 1.5), abs=2e-4)


def test_absorption_follows_beer_and_lambert():
    sigma = np.array([0.3, 1.0, 2.0])
    material = Material("glass", albedo=ONE, absorption=tuple(sigma))
    for thickness, degrees in ((1.0, 0.0), (0.25, 0.0), (1.0, 45.0)):
        film = render(slab_scene(thickness, degrees, material))
        cosine = np.cos(np.radians(degrees))
        way = thickness / np.sqrt(1.0 - (1.0 - cosine**2) / 2.25)
        expected = slab_transmittance(cosine, 1.5, np.exp(-sigma * way))
        assert np.allclose(film.pixels.mean(axis=(0, 1)), expected, atol=2e-4), (thickness, degrees)


def test_a_slanted_slab_shifts_the_picture():
    # The shift is t sin(a) (1 - cos(a) / sqrt(n^2 - sin^2 a)), 0.329142 at 45 degrees. A wall that glows for x > 0 shows it.
    angle, n = np.radians(45.0), 1.5
    shift = np.sin(angle) * (1.0 - np.cos(angle) / np.sqrt(n * n - np.sin(angle) ** 2))
    assert shift == pytest.approx(0.329142, abs=1e-6)
    wall = Object(quad((0.0, -500.0, -60.0), (500.0, 0.0, 0.0), (0.0, 1000.0, 0.0)), (glow(),))
    # From 2000 away, the rays of a strip of 2048 pixels, one unit wide at the wall, are almost parallel.
    camera = toward(position=(0.0, 0.0, 2000.0), fov=2.0 * np.arctan(0.5 / 2060.0 * 64.0 / 2048.0))
    edges = []
    for degrees in (0.0, 45.0, -45.0):
        slab = slab_scene(degrees=degrees)
        scene = glass_scene(slab.objects[0], wall, camera=camera)
        film = render(scene, size=(2048, 64), crop=(0, 32, 2048, 33), spp=1)
        lit = film.pixels[0, :, 0] > 0.3
        edges.append(0.5 - lit.sum() / 2048.0)
        assert np.abs(np.diff(lit.astype(int))).sum() <= 3  # One edge, and perhaps a pixel whose sample is on it.
    assert edges[0] == pytest.approx(0.0, abs=1e-3)
    assert abs(edges[1]) == pytest.approx(shift, abs=2e-3)
    assert edges[1] == pytest.approx(-edges[2], abs=2e-3)
    # The slab's normal leans to +x, so that the rays inside are bent to -x. The glow begins farther to the right.
    assert edges[1] > 0.0


def test_a_ball_turns_the_world_upside_down():
    # The upper half of a glass ball shows the lower half of the world.
    scene = glass_scene(spheres=(Sphere((0.0, 0.0, 0.0), 1.0, CLEAR),), camera=toward(fov=0.2),
                        background=GradientBackground((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)))
    film = render(scene, spp=16)
    column = film.pixels[:, 3:5, 0].mean(axis=1)
    assert column[:4].mean() < column[4:].mean() - 0.02


# --- diffuse surfaces and lights --------------------------------------------------------------------------------------

LIGHT_EXTRA = (PointLight((0.0, 2e4, 0.0), (0.0,) * 3), DirectionalLight((1.0, 0.0, 0.0), (0.0,) * 3),
               SpotLight((0.0, 2e4, 0.0), (0.0, 1.0, 0.0), (0.0,) * 3))


def lit_scene(*objects, lights=(), background=WHITE_SKY, spheres=(), ambient=(1e-9,) * 3):
    return Scene(objects=tuple(objects), lights=(*lights, *LIGHT_EXTRA), background=background, ambient=ambient,
                 spheres=(*spheres, Sphere((0.0, 100.0, 1e4), 1e-3, Material())), settings=SETTINGS, cameras=(toward(),))


def floor(albedo=0.5, size=1000.0):
    mesh = quad((-0.5 * size, 0.0, 0.5 * size), (size, 0.0, 0.0), (0.0, 0.0, -size))
    return Object(moved(mesh), (Material(albedo=(albedo,) * 3),))


def test_a_grey_ball_in_a_white_room_shows_its_albedo():
    ball = Sphere((0.0, 0.0, 0.0), 1.0, Material(albedo=(0.5, 0.25, 1.0)))
    # Ball and mesh are far from each other. A single convex object occludes no part of its own sky.
    mesh = Object(moved(icosphere(3), 1.0, (3000.0, 0.0, 0.0)), (ball.material,))
    scene = lit_scene(mesh, spheres=(ball,))
    for x, target in ((0.0, (0.0, 0.0, 0.0)), (0.0, (0.7, 0.5, 0.0)), (3000.0, (3000.0, 0.2, 0.0))):
        film = render(scene, camera=toward(target, (x, 0.5, 6.0)))
        assert np.allclose(film.pixels, [0.5, 0.25, 1.0], rtol=1e-6)


@pytest.mark.parametrize("height", [0.5, 2.0, 10.0])
def test_a_point_light_over_a_floor(height):
    # L = albedo (sky + I cos / (pi d^2)): the inverse square law and the cosine law.
    scene = lit_scene(floor(), lights=(PointLight((0.0, height, 0.0), (3.0, 6.0, 9.0)),))
    for x in (0.0, 1.0, 7.0):
        film = render(scene, camera=toward((x, 0.0, 0.0), (x, 30.0, 20.0), fov=1e-3))
        d2 = x * x + height**2
        expected = 0.5 * (1.0 + np.array([3.0, 6.0, 9.0]) * height / np.sqrt(d2) / (np.pi * d2))
        assert np.allclose(film.pixels.mean(axis=(0, 1)), expected, rtol=2e-3), x


def test_directional_and_spot_lights_over_a_floor():
    sun = DirectionalLight((0.0, -0.6, -0.8), (2.0,) * 3)
    spot = SpotLight((0.0, 4.0, 0.0), (0.0, -1.0, 0.0), (16.0,) * 3, inner=0.2, outer=0.5)
    scene = lit_scene(floor(), lights=(sun, spot), background=WHITE_SKY)
    for x in (0.0, 0.5, 1.5, 5.0):
        angle = np.arctan(x / 4.0)
        ramp = np.clip((np.cos(angle) - np.cos(0.5)) / (np.cos(0.2) - np.cos(0.5)), 0.0, 1.0) ** 2
        expected = 0.5 * (1.0 + (2.0 * 0.6 + 16.0 * ramp * np.cos(angle) ** 3 / 16.0) / np.pi)
        film = render(scene, camera=toward((x, 0.0, 0.0), (x, 30.0, 20.0), fov=1e-3))
        assert film.pixels.mean() == pytest.approx(expected, rel=2e-3), x


def test_shadows_and_the_ambient_term():
    lid = Object(moved(quad((-1.0, 1.0, 1.0), (2.0, 0.0, 0.0), (0.0, 0.0, -2.0))), (Material(albedo=(0.0,) * 3),))
    scene = lit_scene(floor(), lid, lights=(PointLight((0.0, 2.0, 0.0), (50.0,) * 3),), ambient=(0.3, 0.2, 0.1))
    under = render(scene, camera=toward((0.5, 0.0, 0.0), (9.0, 0.5, 0.0), fov=1e-3), spp=256)
    # Under the lid the point light is hidden. The form factor of the lid, 2 x 2 at height 1, gives the hidden part of the sky.
    corner = [(1.5, 1.0), (0.5, 1.0)]
    factor = 0.0
    for x, y in corner:
        p, q = np.sqrt(1.0 + x * x), np.sqrt(1.0 + y * y)
        factor += 2.0 * (x / p * np.arctan(y / p) + y / q * np.arctan(x / q)) / (2.0 * np.pi)
    expected = 0.5 * (1.0 - factor + np.array([0.3, 0.2, 0.1]))
    assert np.allclose(under.pixels.mean(axis=(0, 1)), expected, atol=5e-3)
    outside = render(scene, camera=toward((6.0, 0.0, 0.0), (9.0, 5.0, 0.0), fov=1e-3))
    assert outside.pixels.mean() > 0.5  # Outside, the point light is visible past the lid's edge.


@pytest.mark.parametrize("radius", [0.5, 1.5, 4.0, 50.0])
def test_a_wall_occludes_the_ambient_term_as_far_as_the_radius(radius):
    """Nusselt's analog: the directions that meet a wall at distance 1 within the radius are a segment of the unit disk."""
    wall = Object(moved(quad((1.0, -500.0, -500.0), (0.0, 0.0, 1000.0), (0.0, 1000.0, 0.0))), (Material(albedo=(0.0,) * 3),))
    scene = lit_scene(floor(), wall, background=ConstantBackground(), ambient=(0.4, 0.2, 0.1))
    scene = replace(scene, ambient_occlusion=radius)
    film = render(scene, camera=toward((0.0, 0.0, 0.0), (-3.0, 5.0, 0.0), fov=1e-3), spp=1024)
    near = min(1.0, 1.0 / radius)
    occluded = (np.arccos(near) - near * np.sqrt(1.0 - near * near)) / np.pi
    assert film.pixels.mean(axis=(0, 1)) == pytest.approx(0.5 * np.array([0.4, 0.2, 0.1]) * (1.0 - occluded), rel=2e-3)


@pytest.mark.parametrize("radius", [0.1, 1.0, 1.7, 1.9])
def test_inside_a_ball_chords_occlude_the_ambient_term(radius):
    """A chord at angle a from the normal has length 2 cos a. By the cosine, the share of longer chords is 1 - (radius / 2)^2."""
    ball = Sphere((0.0, 0.0, 0.0), 1.0, Material(albedo=(0.5,) * 3, specular=(0.3,) * 3))
    scene = replace(lit_scene(spheres=(ball,), background=ConstantBackground(), ambient=(0.6,) * 3), ambient_occlusion=radius)
    for mesh in (False, True):
        if mesh:
            walls = Object(moved(replace(icosphere(5), normals=None)), (ball.material,))
            scene = replace(scene, objects=(walls,), spheres=())
        film = render(scene, camera=toward((0.9, 0.1, 0.2), (0.1, 0.0, 0.0), fov=0.5), spp=256)
        assert film.pixels.mean() == pytest.approx(0.3 * max(0.0, 1.0 - (radius / 2.0) ** 2), rel=5e-3, abs=1e-4)


# --- mixtures ---------------------------------------------------------------------------------------------------------


def test_blending_is_a_weighted_mean():
    def pane(z, alpha, radiance):
        material = Material(albedo=(0.0,) * 3, emission=radiance, emits_light=False, alpha=alpha, alpha_mode="blend")
        return Object(moved(quad((-5.0, -5.0, z), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0))), (material,))

    scene = Scene(objects=(pane(1.0, 0.25, (8.0, 0.0, 0.0)), pane(0.0, 0.5, (0.0, 8.0, 0.0)), pane(-1.0, 1.0, (0.0, 0.0, 8.0))),
                  cameras=(toward(),), settings=SETTINGS, background=WHITE_SKY)
    for depth in (8, 0):  # Passing straight on is no bounce.
        film = render(scene, max_depth=depth)
        assert np.allclose(film.pixels, [8.0 * 0.25, 8.0 * 0.75 * 0.5, 8.0 * 0.75 * 0.5], rtol=1e-6)
        assert film.stats["cut_by_depth"] == 0


@pytest.mark.parametrize("count", [1, 12, 256, 257])
def test_what_is_not_there_hides_nothing_up_to_a_number_that_is_counted(count):
    clear = Material(albedo=(0.0,) * 3, alpha=0.0, alpha_mode="blend")
    panes = [Object(moved(quad((-5.0, -5.0, float(z)), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0))), (clear,))
             for z in np.linspace(0.0, 1.0, count)]
    wall = Object(moved(quad((-5.0, -5.0, -1.0), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0))), (glow(),))
    film = render(Scene(objects=(*panes, wall), cameras=(toward(),), settings=SETTINGS, background=WHITE_SKY), max_depth=2)
    there = count <= MAX_TRANSPARENT
    assert np.allclose(film.pixels, float(there)) and film.stats["lost_throughput_per_sample"] == float(not there)
    assert film.stats["cut_by_depth"] == (0 if there else film.stats["samples"])


def test_a_tree_of_rays_without_end_is_cut_and_told():
    pane = Material("glass", albedo=ONE, ior=1.5, thin=True)
    panes = [Object(moved(quad((-50.0, -50.0, z), (100.0, 0.0, 0.0), (0.0, 100.0, 0.0))), (pane,)) for z in (0.0, -1.0, -2.0)]
    scene = Scene(objects=tuple(panes), cameras=(toward(),), settings=SETTINGS, background=WHITE_SKY)
    options = {"size": (2, 2), "spp": 1, "min_throughput": 0.0}
    whole, endless = render(scene, max_depth=12, **options), render(scene, max_depth=64, **options)
    assert whole.stats["rays"] < 4 * MAX_RAYS <= endless.stats["rays"] <= 4 * (MAX_RAYS + 200)  # Waiting rays are still traced.
    for film in (whole, endless):  # All light that is not lost comes from the sky of radiance 1.
        assert 0.0 < film.stats["lost_throughput_per_sample"] < 0.2 and film.stats["cut_by_depth"] > 0
        assert film.pixels.mean() + film.stats["lost_throughput_per_sample"] == pytest.approx(1.0, abs=1e-4)


def blended_glass(alpha, **rest):
    return Material("glass", albedo=ONE, ior=1.5, alpha=alpha, alpha_mode="blend", **rest)


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_blended_solid_glass_is_the_mean_of_the_picture_with_and_without_it(alpha):
    # The glass has absorption and an object inside. Glass of alpha 0 is invisible.
    inner = Sphere((0.3, 0.0, 0.0), 0.4, Material(albedo=(0.0,) * 3, emission=(0.7, 0.1, 0.1), emits_light=False))

    def picture(glass):
        balls = () if glass is None else (Sphere((0.0, 0.0, 0.0), 1.0, glass),)
        extra = hidden(blended_glass(0.5), *GLASS_EXTRA)
        scene = Scene(objects=extra, spheres=(inner, *balls), settings=SETTINGS, cameras=(toward(fov=0.5),),
                      background=GradientBackground((0.1, 0.2, 0.3), (0.9, 0.8, 0.7)))
        return render(scene, size=(16, 16), spp=16)

    sigma = {"absorption": (0.5, 0.1, 0.9)}
    without, opaque = picture(None), picture(Material("glass", albedo=ONE, ior=1.5, **sigma))
    film = picture(blended_glass(alpha, **sigma))
    assert np.abs(film.pixels - ((1.0 - alpha) * without.pixels + alpha * opaque.pixels)).max() < 1e-4
    assert np.abs(opaque.pixels - without.pixels).max() > 0.2


@pytest.mark.parametrize("alpha", [0.2, 0.7])
def test_blended_solid_glass_in_a_white_room(alpha):
    slab = Object(box((-50.0, -50.0, -0.5), (50.0, 50.0, 0.5)), (blended_glass(alpha),))
    scene = Scene(objects=(slab, *hidden(*GLASS_EXTRA)), spheres=(Sphere((0.0, 100.0, 1e4), 1e-3, glow()),),
                  cameras=(toward(),), settings=SETTINGS, background=WHITE_SKY)
    assert np.allclose(render(scene).pixels, 1.0, atol=1e-4)


def test_nothing_but_background():
    sky = GradientBackground((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    film = render(Scene(background=sky, cameras=(Camera(fov_y=1.0),), settings=SETTINGS), aov=["depth", "prim_id", "normal"])
    assert (film.pixels[0, :, 0] > film.pixels[-1, :, 0]).all() and np.allclose(film.pixels.sum(axis=2), 1.0)
    assert np.isinf(film.aov["depth"]).all() and (film.aov["prim_id"] == -1).all() and not film.aov["normal"].any()
    assert film.stats["rays_per_sample"] == 1.0
