"""Furnaces: with radiance 1 from all around, no material is brighter, and a lossless material cannot be seen."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, icosphere, quad, torus
from wrt.scene.values import Color

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
WHITE_SKY = ConstantBackground(WHITE)


@cache
def furnace(camera: str) -> tuple[np.ndarray, float]:
    """Return the pixels of the shipped furnace, whose surroundings have radiance 1, and the share of light that was cut."""
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


def test_clear_coats_in_a_furnace() -> None:
    # On a lossless mirror a coat cannot be seen. On black it shows Fresnel's reflectance: 4 % in the middle of the ball.
    mirror = Material("metallic_roughness", albedo=WHITE, metallic=1.0, clearcoat=0.7)
    black = Material("metallic_roughness", albedo=BLACK, specular_factor=0.0, clearcoat=0.7)
    camera = Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), fov_y=0.2)
    for material, expected in ((mirror, 1.0), (black, 0.7 * 0.04)):
        scene = Scene(spheres=(Sphere((0.0, 0.0, 0.0), 1.0, material), Sphere((1e4, 0.0, 0.0), 1.0, black)), background=WHITE_SKY,
                      cameras=(camera,), settings=Settings(filter="box", min_throughput=0.0))
        film = wrt.render(scene, size=(9, 9), spp=1)
        assert film.pixels[4, 4] == pytest.approx(expected, abs=1e-5)
        assert film.pixels.min() >= expected - 1e-5 and film.pixels.max() <= 1.0 + 1e-5


def random_material(rng: np.random.Generator) -> Material:
    """Return a material of a random kind: white or coloured, rough or smooth, blended or opaque."""
    kind = str(rng.choice(["diffuse", "mirror", "conductor", "glass", "metallic_roughness"]))
    transmission, thin = float(rng.choice([0.0, rng.random()])), bool(rng.random() < 0.3)
    return Material(kind, albedo=WHITE if rng.random() < 0.5 else tuple(rng.random(3)), ior=float(rng.uniform(1.0, 2.5)),
                    roughness=float(rng.choice([0.0, rng.random()])), metallic=float(rng.random()), transmission=transmission,
                    specular_factor=float(rng.choice([1.0, rng.random()])), specular_color=tuple(rng.uniform(0.0, 3.0, 3)),
                    clearcoat=float(rng.choice([0.0, rng.random()])), clearcoat_roughness=float(rng.choice([0.0, rng.random()])),
                    thin=thin, absorption=(float(rng.choice([0.0, 0.5])),) * 3, alpha=float(rng.random()),
                    alpha_mode=str(rng.choice(["opaque", "blend"])))


@pytest.mark.parametrize("seed", range(6))
def test_never_more_light_than_comes_in(seed: int) -> None:
    # In surroundings of radiance 1, no sample of any objects may exceed 1.
    rng = np.random.default_rng(seed)
    meshes = (icosphere(1), torus(segments=12, tube_segments=8), box((-0.5,) * 3, (0.5,) * 3))
    objects, spheres = [], []
    for _ in range(14):
        matrix = np.diag([*rng.uniform(0.2, 0.8, 3), 1.0])
        matrix[:3, 3] = rng.uniform(-1.2, 1.2, 3)
        objects.append(Object(meshes[rng.integers(3)], (random_material(rng),), matrix))
        spheres.append(Sphere(tuple(rng.uniform(-1.2, 1.2, 3)), float(rng.uniform(0.1, 0.4)), random_material(rng)))
    # A distant object for each feature, so that all seeds share a kernel.
    kinds = [Material("glass", thin=True), Material("glass", absorption=(1, 1, 1), roughness=0.5), Material("mirror"),
             Material("conductor"), Material(alpha_mode="blend", alpha=0.5), Material(
                 "metallic_roughness", transmission=0.5, clearcoat=0.5, clearcoat_roughness=0.5, specular_factor=0.5)]
    spheres += [Sphere((1e4, 10.0 * i, 0.0), 1.0, material) for i, material in enumerate(kinds)]
    camera = Camera.look_at(tuple(rng.normal(size=3) + np.array([0, 0, 6.0])), (0, 0, 0), fov_y=0.6)
    scene = Scene(objects=tuple(objects), spheres=tuple(spheres), background=WHITE_SKY, cameras=(camera,),
                  settings=Settings(filter="box", max_depth=8, min_throughput=1e-3))
    film = wrt.render(scene, size=(40, 40), spp=1)
    assert film.stats["not_finite"] == 0 and film.stats["rays_per_sample"] > 3.0
    assert film.pixels.max() <= 1.0 + 2e-5 and film.pixels.min() >= 0.0


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.8, -0.9, 1.1)])
def test_inside_a_glowing_sphere_a_surface_is_lit_from_all_around(place: Color) -> None:
    # The irradiance is pi L at any place and angle, so that a Lambertian surface has the radiance albedo times L.
    lamp = Sphere((0.0, 0.0, 0.0), 2.0, Material(albedo=BLACK, emission=(3.0, 2.0, 1.0), two_sided=True))
    square = Object(quad((place[0] - 0.1, place[1], place[2] + 0.1), (0.2, 0, 0), (0, 0, -0.2)), (Material(albedo=(0.5,) * 3),))
    camera = Camera.look_at((place[0] + 0.1, place[1] + 0.2, place[2]), place, fov_y=0.01)
    scene = Scene(objects=(square,), spheres=(lamp,), cameras=(camera,), settings=Settings(filter="box"))
    assert np.allclose(wrt.render(scene, size=(4, 4), spp=4).pixels, [1.5, 1.0, 0.5], rtol=1e-3)
    away = Camera.look_at((place[0], place[1] + 0.1, place[2]), (place[0], place[1] + 1.0, place[2] + 1.0), fov_y=0.01)
    assert np.allclose(wrt.render(scene, camera=away, size=(4, 4), spp=1).pixels, [3.0, 2.0, 1.0])
