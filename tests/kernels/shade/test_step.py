"""The integrator: the same pixels for every division of the work, seeds, variance, and the features of its kernel."""

import numpy as np
import pytest

from tests.known_answers.test_integrator import CLEAR, MIRROR_BOX, ONE
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of, switches
from wrt.renderer.render import render
from wrt.scene.backgrounds import GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import PointLight
from wrt.scene.materials import Checkerboard, Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import icosphere, quad


def busy_scene():
    """Return a scene with lens, filter, glass, rough metal, texture, area light, point light and sky."""
    board = Material(albedo=ONE, albedo_texture=Checkerboard(scale=4.0))
    ground = quad((-4, -1, 4), (8, 0, 0), (0, 0, -8))
    camera = Camera.look_at((1.0, 1.0, 5.0), (0.2, -0.3, 0.0), fov_y=0.7, aperture_radius=0.1, focus_distance=5.0, blades=6)
    lamp = Material(emission=(6.0, 5.0, 4.0))
    return Scene(
        objects=(Object(ground, (board,)), Object(icosphere(2, 0.6), (CLEAR,)),
                 Object(quad((-1.0, 3.0, -1.0), (2.0, 0.0, 0.0), (0.0, 0.0, 2.0)), (lamp,))),
        spheres=(Sphere((1.2, -0.3, -0.5), 0.7, Material("conductor", roughness=0.3)),),
        lights=(PointLight((3.0, 4.0, 3.0), (20.0, 20.0, 20.0)),), background=GradientBackground(), cameras=(camera,),
        settings=Settings(size=(36, 20), spp=20, max_depth=5))


@pytest.fixture(scope="module")
def reference():
    return render(busy_scene(), threads=1, tile_size=1000, pass_size=20)


@pytest.mark.parametrize("how", [
    {"threads": 2, "tile_size": 16}, {"threads": 2, "tile_size": 64}, {"threads": 1, "tile_size": 16},
    {"threads": 2, "tile_size": 7, "pass_size": 1}, {"threads": 2, "pass_size": 10}, {"threads": 2, "pass_size": None},
    {"threads": 2, "tile_size": 1, "pass_size": 3},
])
def test_same_pixels_for_any_tiles_threads_and_passes(reference, how):
    film = render(busy_scene(), **how)
    for name in ("pixels", "variance", "samples"):
        assert np.array_equal(getattr(film, name), getattr(reference, name)), name
    for name in ("rays", "cut_by_depth", "cut_by_throughput", "lost_throughput_per_sample", "not_finite"):
        assert film.stats[name] == reference.stats[name]
    assert film.stats["not_finite"] == 0 and film.pixels.std() > 0.05


def test_same_pixels_for_any_structure(reference):
    film = render(busy_scene(), accel="brute_force", threads=2)
    assert np.array_equal(film.pixels, reference.pixels) and film.stats["rays"] == reference.stats["rays"]


def test_a_crop_is_a_part_of_the_picture(reference):
    film = render(busy_scene(), crop=(5, 3, 30, 18), threads=2)
    assert np.array_equal(film.pixels, reference.pixels[3:18, 5:30])


def test_fewer_samples_are_the_first_ones_and_the_seed_matters(reference):
    few, again = (render(busy_scene(), spp=5, threads=2, pass_size=size) for size in (5, 2))
    assert np.array_equal(few.pixels, again.pixels) and not np.array_equal(few.pixels, reference.pixels)
    other = render(busy_scene(), seed=1, threads=2)
    assert not np.array_equal(other.pixels, reference.pixels)
    z = (other.pixels - reference.pixels) / np.sqrt(other.variance + reference.variance + 1e-12)
    noisy = (other.variance + reference.variance).max(axis=2) > 1e-8
    assert abs(np.median(z[noisy])) < 0.2 and np.abs(z[noisy]).mean() < 2.0


def test_variance_is_that_of_the_mean(reference):
    # The variance of pixels over many seeds must be at most the variance that one render reports. It is less, as the samples of a
    # pixel are more even than random samples.
    films = [render(busy_scene(), seed=seed, threads=2) for seed in range(2, 14)]
    spread = np.var([film.pixels for film in films], axis=0, ddof=1).mean()
    claimed = np.mean([film.variance for film in films])
    assert 0.02 * claimed < spread < 1.2 * claimed


def test_the_kernel_holds_only_what_the_scene_needs():
    bare = plan_of(MIRROR_BOX, Options()).features
    assert {name for name, on in switches(bare).items() if on} == {"mirror", "reflection", "emission"}
