"""Pictures whose every number is known in closed form, beyond those of tests/kernels/shade/test_whitted.py.

Fresnel's curve, total reflection, a ball lens, a thin lens' circle of confusion, the photometric laws, and furnaces.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, icosphere, quad, torus
from wrt.scene.values import Color

N = 1.5
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
WHITE_SKY = ConstantBackground(WHITE)


def fresnel(degrees: float, n: float = N) -> float:
    """Unpolarised reflectance from outside, in float64."""
    cosine = math.cos(math.radians(degrees))
    inside = math.sqrt(1.0 - (1.0 - cosine**2) / n**2)
    s, p = (cosine - n * inside) / (cosine + n * inside), (n * cosine - inside) / (n * cosine + inside)
    return 0.5 * (s * s + p * p)


# --- Fresnel ----------------------------------------------------------------------------------------------------------

# So dark inside that what enters is lost: only the reflected ray sees the white sky.
INK = Material("glass", albedo=WHITE, ior=N, absorption=(1e3, 1e3, 1e3))


def reflectance(degrees: float) -> float:
    """Of the top of a block of dark glass, seen at this angle to its normal."""
    angle = math.radians(degrees)
    camera = Camera.look_at((0.0, 3.0 * math.cos(angle), 3.0 * math.sin(angle)), (0.0, 0.0, 0.0), up=(1.0, 0.0, 0.0), fov_y=1e-4)
    scene = Scene(objects=(Object(box((-5, -5, -5), (5, 0, 5)), (INK,)),), background=WHITE_SKY, cameras=(camera,),
                  settings=Settings(filter="box", min_throughput=0.0))
    return float(wrt.render(scene, size=(4, 4), spp=4).pixels.mean())


@pytest.mark.parametrize(("degrees", "value"), [
    (0.0, 0.04), (45.0, 0.05024), (60.0, 0.08919), (80.0, 0.38770),
    (math.degrees(math.atan(N)), 0.5 * ((N**2 - 1.0) / (N**2 + 1.0)) ** 2)])  # Brewster's angle: no p-polarised light
def test_a_picture_of_fresnels_curve(degrees: float, value: float) -> None:
    assert value == pytest.approx(fresnel(degrees), abs=1e-5)
    assert reflectance(degrees) == pytest.approx(value, abs=2e-5)


def test_total_reflection_begins_at_its_angle() -> None:
    # From inside glass, a strip of one degree across the critical angle: it goes dark where no light comes out any more.
    critical = math.degrees(math.asin(1.0 / N))
    assert critical == pytest.approx(41.810, abs=5e-4)
    rows, fov = 1024, math.radians(1.0)
    angle = math.radians(critical)
    camera = Camera.look_at((0.0, 0.0, 0.0), (math.sin(angle), math.cos(angle), 0.0), up=(1.0, 0.0, 0.0), fov_y=fov)
    scene = Scene(objects=(Object(box((-5, -5, -5), (5, 1, 5)), (Material("glass", albedo=WHITE, ior=N),)),),
                  background=WHITE_SKY, cameras=(camera,), settings=Settings(filter="box", max_depth=1))
    column = wrt.render(scene, size=(1, rows), spp=16).pixels[:, 0, 0]
    tangent = (1.0 - 2.0 * (np.arange(rows) + 0.5) / rows) * math.tan(0.5 * fov)
    degrees = critical + np.degrees(np.arctan(tangent))  # up is towards grazing
    lit = column > 0.0
    assert abs(degrees[lit].max() - critical) < 0.002 and abs(degrees[~lit].min() - critical) < 0.002
    assert not (lit[:-1] & ~lit[1:]).any()  # dark from there on
    # Below it, radiance comes out of the glass n^-2 as dense: a camera inside sees n^2 of what is let through.
    for i in (rows // 2 + 100, rows - 1):
        outside = math.degrees(math.asin(N * math.sin(math.radians(degrees[i]))))
        assert column[i] == pytest.approx(N**2 * (1.0 - fresnel(outside)), rel=2e-3)


# --- a ball lens ------------------------------------------------------------------------------------------------------


def exit_slopes(distances: list[float]) -> list[float]:
    """Slope of the ray behind a ball (R = 1, n = 1.5) over its slope at a point so far before the ball's face.

    The sky's radiance tells the height of the direction in which a ray leaves: 1 + d_y in a sky from 0 to 2. What is
    reflected on the way in meets a black wall behind the camera; what is reflected inside is cut by max_depth.
    """
    ball = Sphere((0.0, 0.0, 0.0), 1.0, Material("glass", albedo=WHITE, ior=N))
    found = []
    for distance in distances:
        wall = Object(quad((-1e3, -1e3, 1.05 + distance), (2e3, 0, 0), (0, 2e3, 0)), (Material(albedo=BLACK),))
        camera = Camera.look_at((0.0, 0.0, 1.0 + distance), (0.0, 0.0, 0.0), fov_y=0.02)
        films = []
        for top in (2.0, 1.0):  # the second sky is even: it tells what share of light goes through
            sky = GradientBackground(((2.0 - top,) * 3), (top,) * 3)
            scene = Scene(objects=(wall,), spheres=(ball,), background=sky, cameras=(camera,),
                          settings=Settings(filter="box", max_depth=2, min_throughput=0.0))
            films.append(wrt.render(scene, size=(2, 64), spp=64).pixels[..., 0].mean(axis=1, dtype=np.float64))
        assert np.allclose(films[1], (1.0 - fresnel(0.0)) ** 2, atol=1e-4)
        slope = (1.0 - 2.0 * (np.arange(64) + 0.5) / 64) * math.tan(0.01)
        found.append(float(np.polyfit(slope, films[0] / films[1] - 1.0, 1)[0]))
    return found


def test_a_ball_lens_has_its_focus_half_a_radius_behind_it() -> None:
    # Paraxial optics: focal length n R / (2 (n - 1)) = 1.5 from the centre, 0.5 from the face. A ray from a point at
    # distance b leaves with 1 - (b + R) / f of its slope, and from the focus parallel to the axis.
    distances = [0.1, 0.3, 0.5, 0.8, 1.2]
    found = exit_slopes(distances)
    assert found == pytest.approx([1.0 - (b + 1.0) / 1.5 for b in distances], abs=1e-3)
    gradient, offset = np.polyfit(distances, found, 1)
    assert -offset / gradient == pytest.approx(0.5, abs=1e-3)  # back focal length
    assert -1.0 / gradient == pytest.approx(1.5, abs=2e-3)  # focal length


# --- a thin lens ------------------------------------------------------------------------------------------------------

FOCAL, FOCUS, STOP, SENSOR, PIXELS = 0.1, 2.0, 1.4, 0.024, 256


def blurred_square(distance: float) -> tuple[float, float, float]:
    """Diameter of the circle of confusion at this distance along x and y, and light in the picture, in pixels.

    A glowing square that faces the lens is drawn, as wide as 20 pixels of the unblurred picture. Its blurred picture is
    the convolution of square, disc and pixel: variances add, and a disc of diameter C has C^2 / 16.
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
    # C = f^2 |So / Sa - 1| / (N (So - f)) on the sensor: here 0 to 60 pixels.
    expected = FOCAL**2 * abs(FOCUS / distance - 1.0) / (STOP * (FOCUS - FOCAL)) * PIXELS / SENSOR
    across, upward, light = blurred_square(distance)
    if distance == FOCUS:
        assert expected == 0.0 and max(across, upward) < 1.0
    else:
        assert across == pytest.approx(expected, rel=0.01) and upward == pytest.approx(expected, rel=0.01)
    assert light == pytest.approx(20.0**2, rel=0.01)  # blur spreads light and takes none


# --- photometric laws -------------------------------------------------------------------------------------------------


@cache
def lit_floor(lights: tuple[PointLight | DirectionalLight, ...]) -> np.ndarray:
    """Irradiance at the origin on a white floor that faces +y: (3,)."""
    floor = Object(quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)), (Material(albedo=WHITE),))
    camera = Camera.look_at((0.3, 0.4, 0.5), (0.0, 0.0, 0.0), fov_y=1e-5)
    hidden = (PointLight((0, -1e6, 0), BLACK), DirectionalLight((0, 1, 0), BLACK))  # one kernel for both kinds
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
    away = (math.sin(angle), math.cos(angle), 0.0)  # from the floor to the light
    expected = max(math.cos(angle), 0.0)
    sun = DirectionalLight((-away[0], -away[1], 0.0), WHITE)
    bulb = PointLight((5.0 * away[0], 5.0 * away[1], 0.0), (25.0,) * 3)
    for light in (sun, bulb):
        assert np.allclose(lit_floor((light,)), expected, rtol=1e-3, atol=1e-6), type(light)


def test_lights_add_up() -> None:
    lights = tuple(PointLight((0.1 * i, 2.0, 0.3), (1.0 + i, 2.0, 0.5 * i)) for i in range(4))
    assert np.allclose(lit_floor(lights), np.sum([lit_floor((light,)) for light in lights], axis=0), rtol=1e-5)


# --- furnaces ---------------------------------------------------------------------------------------------------------


@cache
def furnace(camera: str) -> tuple[np.ndarray, float]:
    """The shipped scene: radiance 1 from everywhere; its pixels, and the share of light that was cut."""
    film = wrt.render(wrt.load_scene(ROOT / "scenes" / "furnace.toml"), camera=camera, size=(48, 27), spp=4)
    return film.pixels, film.stats["lost_throughput_per_sample"]


def test_mirrors_in_a_furnace_cannot_be_seen() -> None:
    assert np.allclose(furnace("main")[0], 1.0, atol=1e-5)


def test_a_grey_ball_in_a_furnace_shows_its_albedo() -> None:
    pixels, _ = furnace("diffuse")
    assert np.allclose(pixels[13, 24], 0.5, atol=1e-5) and np.allclose(pixels[0, 0], 1.0)
    edge = ~(np.isclose(pixels, 0.5, atol=1e-5) | np.isclose(pixels, 1.0, atol=1e-5)).all(axis=2)
    assert 0 < edge.sum() < 0.1 * edge.size and ((pixels[edge] > 0.5) & (pixels[edge] < 1.0)).all()


def test_glass_in_a_furnace_is_seen_only_by_what_was_cut() -> None:
    pixels, lost = furnace("glass")
    assert (pixels <= 1.0 + 1e-5).all() and 1e-6 < lost < 3e-3
    assert 1.0 - pixels.mean(dtype=np.float64) == pytest.approx(lost, abs=2e-6)


def random_material(rng: np.random.Generator) -> Material:
    """Any kind, white or coloured, rough or not, blended or not."""
    kind = str(rng.choice(["diffuse", "mirror", "conductor", "glass", "metallic_roughness"]))
    transmission, thin = float(rng.choice([0.0, rng.random()])), bool(rng.random() < 0.3)
    return Material(kind, albedo=WHITE if rng.random() < 0.5 else tuple(rng.random(3)), ior=float(rng.uniform(1.0, 2.5)),
                    roughness=float(rng.choice([0.0, rng.random()])), metallic=float(rng.random()), transmission=transmission,
                    thin=thin, absorption=(float(rng.choice([0.0, 0.5])),) * 3, alpha=float(rng.random()),
                    alpha_mode=str(rng.choice(["opaque", "blend"])))


@pytest.mark.parametrize("seed", range(6))
def test_never_more_light_than_comes_in(seed: int) -> None:
    # Whatever stands in a room of radiance 1: no pixel is above 1, not even of one sample.
    rng = np.random.default_rng(seed)
    meshes = (icosphere(1), torus(segments=12, tube_segments=8), box((-0.5,) * 3, (0.5,) * 3))
    objects, spheres = [], []
    for _ in range(14):
        matrix = np.diag([*rng.uniform(0.2, 0.8, 3), 1.0])
        matrix[:3, 3] = rng.uniform(-1.2, 1.2, 3)
        objects.append(Object(meshes[rng.integers(3)], (random_material(rng),), matrix))
        spheres.append(Sphere(tuple(rng.uniform(-1.2, 1.2, 3)), float(rng.uniform(0.1, 0.4)), random_material(rng)))
    # One of each feature far away, so that all seeds share a kernel.
    kinds = [Material("glass", thin=True), Material("glass", absorption=(1, 1, 1), roughness=0.5), Material("mirror"),
             Material("conductor"), Material("metallic_roughness", transmission=0.5), Material(alpha_mode="blend", alpha=0.5)]
    spheres += [Sphere((1e4, 10.0 * i, 0.0), 1.0, material) for i, material in enumerate(kinds)]
    camera = Camera.look_at(tuple(rng.normal(size=3) + np.array([0, 0, 6.0])), (0, 0, 0), fov_y=0.6)
    scene = Scene(objects=tuple(objects), spheres=tuple(spheres), background=WHITE_SKY, cameras=(camera,),
                  settings=Settings(filter="box", max_depth=8, min_throughput=1e-3))
    film = wrt.render(scene, size=(40, 40), spp=1)
    assert film.stats["not_finite"] == 0 and film.stats["rays_per_sample"] > 3.0
    assert film.pixels.max() <= 1.0 + 2e-5 and film.pixels.min() >= 0.0


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.8, -0.9, 1.1)])
def test_inside_a_glowing_sphere_a_surface_is_lit_from_all_around(place: Color) -> None:
    # E = pi L at any place and angle, so that a Lambertian surface has radiance albedo times L.
    lamp = Sphere((0.0, 0.0, 0.0), 2.0, Material(albedo=BLACK, emission=(3.0, 2.0, 1.0), two_sided=True))
    square = Object(quad((place[0] - 0.1, place[1], place[2] + 0.1), (0.2, 0, 0), (0, 0, -0.2)), (Material(albedo=(0.5,) * 3),))
    camera = Camera.look_at((place[0] + 0.1, place[1] + 0.2, place[2]), place, fov_y=0.01)
    scene = Scene(objects=(square,), spheres=(lamp,), cameras=(camera,), settings=Settings(filter="box"))
    assert np.allclose(wrt.render(scene, size=(4, 4), spp=4).pixels, [1.5, 1.0, 0.5], rtol=1e-3)
    away = Camera.look_at((place[0], place[1] + 0.1, place[2]), (place[0], place[1] + 1.0, place[2] + 1.0), fov_y=0.01)
    assert np.allclose(wrt.render(scene, camera=away, size=(4, 4), spp=1).pixels, [3.0, 2.0, 1.0])
