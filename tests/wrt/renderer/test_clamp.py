"""The setting `clamp`: samples brighter than it are scaled down, and the share of the light that this costs is reported."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import wrt
from tests.both_loops import differences, film_of, one_ray_at_a_time
from tests.refused import refused
from wrt.core.device import start
from wrt.picture.film import Film
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import prepare
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import quad


@cache
def sparks() -> Scene:
    """Return a scene with fireflies: a rough metal reflects a small bright ball."""
    metal, bulb = Material("conductor", roughness=0.5), Material(emission=(900.0, 600.0, 300.0), emits_light=False)
    return Scene((Object(quad((-5, -5, 0), (10, 0, 0), (0, 10, 0)), (metal,)),), (Sphere((2.5, 0.0, 3.0), 0.3, bulb),),
                 background=ConstantBackground((0.2, 0.3, 0.5)), cameras=(Camera.look_at((-2, 0, 4), (0, 0, 0)),),
                 settings=Settings(size=(40, 30), spp=1, filter="box"))


def rendered(**options: float) -> Film:
    return wrt.render(sparks(), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("limit", [0.4, 2.0, 50.0])
def test_a_bright_sample_keeps_its_color_and_gets_the_limit(limit: float) -> None:
    free, film = rendered(), rendered(clamp=limit)
    largest = free.pixels.max(axis=2, keepdims=True)
    expected = free.pixels * np.minimum(1.0, limit / np.maximum(largest, 1e-9))
    assert 5 < (largest > limit).sum() and np.allclose(film.pixels, expected, rtol=1e-6, atol=0.0)
    assert film.pixels.max() == pytest.approx(limit, rel=1e-6)
    lost = 1.0 - expected.sum(dtype=np.float64) / free.pixels.sum(dtype=np.float64)
    assert film.stats["clamped_share"] == film.metadata["clamped_share"] == pytest.approx(lost, rel=1e-5)
    assert film.metadata["clamp"] == limit


def test_a_limit_that_nothing_reaches_changes_no_bit() -> None:
    free, film = rendered(spp=4), rendered(spp=4, clamp=1e6)
    assert np.array_equal(free.pixels, film.pixels) and np.array_equal(free.variance, film.variance)
    assert film.stats["clamped_share"] == 0.0 and "clamp" not in free.metadata


@pytest.mark.parametrize("groups", [1, 4])
def test_both_loops_clamp_alike(groups: int) -> None:
    ready = prepare(plan_of(sparks().with_settings(clamp=0.7, spp=3), Options()), start("cpu"))
    films = [film_of(each, (0, 0, 40, 30), (0, 3), groups=groups) for each in (ready, one_ray_at_a_time(ready))]
    assert differences(*films) == [] and films[0]["clamped"].any()


def test_clamped_samples_make_the_picture_darker_by_the_reported_share_and_less_noisy() -> None:
    free, film = rendered(spp=64), rendered(spp=64, clamp=2.0)
    share = 1.0 - film.pixels.sum(dtype=np.float64) / free.pixels.sum(dtype=np.float64)
    assert film.stats["clamped_share"] == pytest.approx(share, rel=1e-4) and share > 0.01
    assert film.variance.mean() < 0.1 * free.variance.mean()


def test_the_inspector_clamps_as_the_renderer_does() -> None:
    film = rendered(spp=8, clamp=0.7)
    y, x = np.unravel_index(rendered(spp=8).pixels.max(axis=2).argmax(), film.samples.shape)
    assert np.array_equal(wrt.inspect(sparks(), (int(x), int(y)), spp=8, clamp=0.7).radiance, film.pixels[y, x])


def test_a_target_error_and_a_resumed_render_report_the_share(tmp_path: object) -> None:
    film = rendered(spp=16, clamp=0.7, target_error=1e-9)
    whole = rendered(spp=16).pixels.sum(dtype=np.float64)
    assert film.stats["clamped_share"] == pytest.approx(1.0 - film.pixels.sum(dtype=np.float64) / whole, rel=0.5)
    path = f"{tmp_path}/sparks.checkpoint"
    rendered(spp=4, clamp=0.7, checkpoint=path)  # type: ignore[arg-type]
    with refused(what="clamp was 0.7, is 0.8"):
        rendered(spp=8, clamp=0.8, checkpoint=path, resume=True)  # type: ignore[arg-type]
    resumed, direct = rendered(spp=8, clamp=0.7, checkpoint=path, resume=True), rendered(spp=8, clamp=0.7)  # type: ignore[arg-type]
    assert np.array_equal(resumed.pixels, direct.pixels) and resumed.stats["clamped_share"] == direct.stats["clamped_share"]
