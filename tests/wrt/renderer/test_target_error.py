"""`render(target_error=...)`: the render stops at the right number of samples, and its estimate of the error is correct."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from wrt.picture.film import aov_to_srgb8
from wrt.picture.image import read_channels
from wrt.renderer.film import GROUPS
from wrt.renderer.options import Options
from wrt.renderer.render import MAX_SPP, Renderer, render
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import quad

FLOOR = Object(quad((-3, 0, 3), (6, 0, 0), (0, 0, -6)), (Material(albedo=(0.6, 0.5, 0.4)),))
LAMP = Object(quad((-0.5, 2.0, -0.5), (1, 0, 0), (0, 0, 1)), (Material(albedo=(0, 0, 0), emission=(6, 6, 6)),))
BALLS = (Sphere((0.3, 0.5, 0.2), 0.5, Material(albedo=(0.2, 0.5, 0.8))), Sphere((-0.9, 0.5, 0.4), 0.5, Material("glass")))
SCENE = Scene(objects=(FLOOR, LAMP), spheres=BALLS, cameras=(Camera.look_at((0.0, 1.6, 4.5), (0.0, 0.4, 0.0), fov_y=0.7),),
              settings=Settings(size=(24, 16), max_depth=4))


def rmse(a: np.ndarray, b: np.ndarray, known: float = 0.0) -> float:
    """Return the root mean square difference of a and b. known: mean variance of b, which is subtracted."""
    return math.sqrt(max(float(np.mean((a.astype(np.float64) - b) ** 2)) - known, 0.0))


def reference(renderer: Renderer, spp: int, seeds: int = 8) -> tuple[np.ndarray, float]:
    """Return the mean of independent renders, in float64, and the mean of its variance."""
    pictures = np.stack([renderer.run(seed=10_000 + seed, spp=spp).pixels for seed in range(seeds)]).astype(np.float64)
    return pictures.mean(axis=0), float(pictures.var(axis=0, ddof=1).mean()) / seeds


# --- what it does -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [0.05, 0.01, 0.003])
def test_the_render_stops_at_the_first_power_of_two_below_the_target(target: float) -> None:
    film = render(SCENE, target_error=target)
    taken = film.metadata["spp"]
    assert (film.samples == taken).all() and taken % GROUPS == 0 and math.log2(taken // GROUPS).is_integer()
    assert film.stats["estimated_error"] <= target and film.stats["target_reached"] and not film.stats["timed_out"]
    assert film.stats["estimated_error"] == pytest.approx(math.sqrt(film.variance.mean(dtype=np.float64)), rel=1e-5)
    before = render(SCENE, target_error=target, spp=taken // 2)
    assert before.metadata["spp"] == taken // 2
    assert before.stats["estimated_error"] > target and not before.stats["target_reached"]


def test_the_picture_is_the_mean_of_independent_ones() -> None:
    film = render(SCENE, target_error=1e-9, spp=12 * GROUPS, seed=5)
    one = Renderer(SCENE, Options())
    seeds = np.random.SeedSequence(5).generate_state(GROUPS)
    parts = [one.run(seed=int(seed), spp=12) for seed in seeds]
    pictures = np.stack([part.pixels for part in parts]).astype(np.float64)
    assert np.allclose(film.pixels, pictures.mean(axis=0), rtol=1e-6)
    assert np.allclose(film.variance, pictures.var(axis=0, ddof=1) / GROUPS, rtol=1e-5, atol=1e-12)
    assert len(np.unique(seeds)) == GROUPS and film.pixels.std() > 0.05
    for name in ("rays", "samples", "cut_by_depth", "cut_by_throughput", "not_finite"):
        assert film.stats[name] == sum(part.stats[name] for part in parts)


@pytest.mark.parametrize("how", [{"threads": 1, "tile_size": 1000}, {"pass_size": 3, "threads": 2, "tile_size": 16}])
def test_same_pixels_for_any_tiles_threads_and_passes(how: dict[str, Any]) -> None:
    expected, film = (render(SCENE, target_error=0.02, **options) for options in ({}, how))
    for name in ("pixels", "variance", "samples"):
        assert np.array_equal(getattr(film, name), getattr(expected, name)), name
    for name in ("estimated_error", "rays", "cut_by_depth", "cut_by_throughput", "lost_throughput_per_sample"):
        assert film.stats[name] == expected.stats[name], name
    assert expected.stats["lost_throughput_per_sample"] > 0.0


def test_the_error_is_infinite_until_every_pixel_has_samples(tmp_path: Any) -> None:
    def at_once(progress: Any) -> None:
        if progress.stage == "trace":
            raise KeyboardInterrupt

    film = render(SCENE, target_error=0.5, progress=at_once, size=(1920, 1080), threads=1, device="cpu")  # long enough to be interrupted
    none = film.samples == 0
    assert none.any() and np.isposinf(film.variance[none]).all() and np.isfinite(film.variance[~none]).all()
    assert film.stats["estimated_error"] == math.inf and not film.stats["target_reached"]
    one = render(SCENE, spp=1)
    assert np.isposinf(one.variance).all()
    one.save(tmp_path / "one.exr")
    assert np.isposinf(read_channels(tmp_path / "one.exr")["variance.R"]).all()
    assert (aov_to_srgb8("variance", one.variance) == 255).all()


def test_time_limit_and_interrupt_end_a_render_with_a_target() -> None:
    film = render(SCENE, target_error=1e-9, time_limit=0.2)
    assert film.stats["timed_out"] and not film.stats["target_reached"] and film.metadata["spp"] >= GROUPS

    def stop(progress: Any) -> None:
        assert 0 <= progress.done <= progress.total
        if progress.done > 24 * 16 * 10 * GROUPS:
            raise KeyboardInterrupt

    film = render(SCENE, target_error=1e-9, progress=stop)
    assert film.stats["interrupted"] and not film.stats["timed_out"] and not film.stats["target_reached"]
    assert np.isfinite(film.pixels).all() and (film.samples % GROUPS == 0).all()


# --- whether it is true -----------------------------------------------------------------------------------------------


def compared(scene: Scene, spp: int, seeds: int, truth: np.ndarray, known: float) -> tuple[float, float]:
    """Return the estimated and the true root mean square error, each over `seeds` renders with a fixed number of samples."""
    films = [renderer_of(scene, 1e-12).run(seed=seed, spp=spp) for seed in range(seeds)]
    estimated = math.sqrt(np.mean([film.stats["estimated_error"] ** 2 for film in films]))
    return estimated, math.sqrt(np.mean([rmse(film.pixels, truth, known) ** 2 for film in films]))


@cache
def renderer_of(scene: Scene, target: float | None) -> Renderer:
    return Renderer(scene, Options(target_error=target))


@cache
def shipped(name: str, size: tuple[int, int]) -> Scene:
    return wrt.load_scene(ROOT / "scenes" / f"{name}.toml").with_settings(size=size)


@cache
def sampled(sampler: str) -> Scene:
    return SCENE.with_settings(sampler=sampler)


@cache
def truth_of_scene() -> tuple[np.ndarray, float]:
    return reference(renderer_of(sampled("sobol"), None), spp=2048)


@pytest.mark.parametrize(("name", "size", "spps"), [
    ("whitted", (32, 18), (16, 128)),
    *(pytest.param(name, (96, 54), (8, 32, 128, 512), marks=pytest.mark.slow)
      for name in ("whitted", "cornell_box", "lens", "frosted", "environment"))], ids=str)
def test_the_estimate_is_the_true_error(name: str, size: tuple[int, int], spps: tuple[int, ...]) -> None:
    scene = shipped(name, size)
    truth, known = reference(renderer_of(scene, None), spp=1024 if len(spps) > 2 else 512)
    for spp in spps:
        estimated, true = compared(scene, spp, 8, truth, known)
        assert estimated == pytest.approx(true, rel=0.2), spp
        assert known < 0.1 * true**2 or len(spps) > 2  # the reference is precise enough


def test_stopping_by_the_estimate_does_not_bias_the_error() -> None:
    # A render could stop when its estimate is too low by chance. Over many seeds, this does not bias the error.
    target, truth = 0.01, truth_of_scene()
    films = [renderer_of(sampled("sobol"), target).run(seed=seed, spp=MAX_SPP) for seed in range(24)]
    true = math.sqrt(np.mean([rmse(film.pixels, *truth) ** 2 for film in films]))
    estimated = math.sqrt(np.mean([film.stats["estimated_error"] ** 2 for film in films]))
    assert all(film.stats["target_reached"] for film in films)
    assert true < target and estimated == pytest.approx(true, rel=0.2)


def test_the_variance_of_one_sequence_overestimates_the_error() -> None:
    # Evenly spread samples have a much smaller error than their variance suggests; random samples do not.
    ratio = {}
    for sampler in ("sobol", "independent"):
        one = renderer_of(sampled(sampler), None)
        truth, known = truth_of_scene()
        films = [one.run(seed=seed, spp=64) for seed in range(8)]
        claimed = math.sqrt(np.mean([film.variance.mean(dtype=np.float64) for film in films]))
        ratio[sampler] = claimed / math.sqrt(np.mean([rmse(film.pixels, truth, known) ** 2 for film in films]))
    assert ratio["sobol"] > 2.0
    assert ratio["independent"] == pytest.approx(1.0, rel=0.2)
