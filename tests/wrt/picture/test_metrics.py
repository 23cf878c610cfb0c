from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from tests.refused import refused
from wrt.picture.heatmap import MARGIN, TITLE, colors
from wrt.picture.metrics import PIXELS_PER_DEGREE, RELMSE_EPS, compare, difference_image, failures, flip_map
from wrt.picture.tonemap import decode_srgb

H, W = 48, 64
MEASURES = ("mse", "relmse", "max_abs", "mean_ratio", "psnr", "flip")
KNOWN_FLIP = {PIXELS_PER_DEGREE: [0.152540, 0.191088, 0.221141, 0.583760], 30.0: [0.284852, 0.265032, 0.217631, 0.628466]}


def scene_like(seed: int = 0) -> np.ndarray:
    """Waves, a checkerboard and a little noise, display-linear in [0, 1]."""
    y, x = np.mgrid[0:H, 0:W]
    checks = 0.1 + 0.8 * ((x // 8 + y // 8) % 2)
    image = np.stack([0.5 + 0.4 * np.sin(x / 7), 0.5 + 0.4 * np.cos(y / 5), checks], axis=-1)
    return np.clip(image + np.random.default_rng(seed).normal(0, 0.02, image.shape), 0, 1).astype(np.float32)


# --- compare ----------------------------------------------------------------------------------------------------------


def test_identical_pictures() -> None:
    a = scene_like()
    result = compare(a, a.copy())
    assert {name: result[name] for name in MEASURES} == {
        "mse": 0, "relmse": 0, "max_abs": 0, "mean_ratio": 1, "psnr": math.inf, "flip": 0}
    assert (result["pixels"], result["nonfinite_differ"]) == (H * W, 0)


def test_measures_of_constants_in_closed_form() -> None:
    b = decode_srgb(np.full((H, W, 3), 0.5))
    a = decode_srgb(np.full((H, W, 3), 0.6))
    result = compare(a, b)
    error = float(a[0, 0, 0] - b[0, 0, 0])
    assert result["mse"] == pytest.approx(error**2, rel=1e-5)
    assert result["relmse"] == pytest.approx(error**2 / (b[0, 0, 0] ** 2 + RELMSE_EPS), rel=1e-5)
    assert result["max_abs"] == pytest.approx(error, rel=1e-5)
    assert result["mean_ratio"] == pytest.approx(a[0, 0, 0] / b[0, 0, 0], rel=1e-5)
    assert result["psnr"] == pytest.approx(20.0, abs=1e-4)  # a difference of 0.1 between codes of peak 1


def test_nonfinite_pixels_are_counted_and_left_out() -> None:
    b = scene_like()
    a = b * 1.05
    clean = compare(a, b)
    a[3, 4] = np.nan
    a[5, 6, 1] = b[5, 6, 1] = np.inf
    b[7, 8, 2] = -np.inf
    result = compare(a, b)
    assert (result["nonfinite_a"], result["nonfinite_b"], result["nonfinite_differ"]) == (2, 2, 3)
    for name in MEASURES:
        assert result[name] == pytest.approx(clean[name], rel=0.02), name


def test_without_a_finite_pixel_nothing_is_averaged() -> None:
    result = compare(np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3)))
    assert all(math.isnan(result[name]) for name in MEASURES)
    assert failures(result, {"mse": 1e9})


@pytest.mark.parametrize("measure", [compare, difference_image])
def test_wrong_sizes_are_input_errors(measure: Any) -> None:
    with refused(what="different sizes, 64x48"):
        measure(scene_like(), scene_like()[:, 1:])
    with refused(what="(H, W, 3)"):
        measure(scene_like()[..., 0], scene_like()[..., 0])


def test_failures_name_the_limits_that_are_broken() -> None:
    b = scene_like()
    result = compare(b * 1.1, b)
    assert failures(result, {"mse": 1.0, "flip": None, "psnr": 10.0}) == []
    told = failures(result, {"mse": 1e-9, "flip": 1e-9, "psnr": 90.0})
    assert [sentence.split()[0] for sentence in told] == ["mse", "flip", "psnr"]
    assert "below 90" in told[2] and "above 1e-09" in told[0]
    result["nonfinite_differ"] = 2
    assert len(failures(result, {"mse": 1.0})) == 1
    assert failures(result, {}) == []


# --- FLIP -------------------------------------------------------------------------------------------------------------


def test_flip_of_known_pictures() -> None:
    # The means by another implementation, in float64, of the same paper.
    b = scene_like()
    noise = np.random.default_rng(3).normal(0, 0.1, b.shape)
    pictures = (np.clip(b + noise, 0, 1), np.roll(b, 1, axis=1), 0.9 * b, b[..., ::-1])
    for ppd, means in KNOWN_FLIP.items():
        assert [flip_map(a, b, ppd).mean() for a in pictures] == pytest.approx(means, abs=2e-5)


def test_flip_is_symmetric_and_in_range() -> None:
    a, b = scene_like(1), scene_like(2)[::-1]
    forth, back = flip_map(a, b), flip_map(b, a)
    assert compare(a, b)["flip"] == pytest.approx(forth.mean(), abs=1e-7)
    assert np.allclose(forth, back, atol=1e-12)
    assert forth.min() >= 0.0 and forth.max() <= 1.0


def test_flip_grows_with_the_error() -> None:
    b = scene_like()
    noise = np.random.default_rng(5).normal(0, 1, b.shape)
    means = [compare(np.clip(b + size * noise, 0, 1), b)["flip"] for size in (0.01, 0.03, 0.1, 0.3)]
    assert all(low < high for low, high in itertools.pairwise(means))


def test_flip_of_green_and_blue_is_one() -> None:
    green, blue = np.zeros((2, H, W, 3))
    green[..., 1] = blue[..., 2] = 1.0
    assert flip_map(green, blue) == pytest.approx(np.ones((H, W)))


def test_flip_forgives_fine_noise_from_far_away() -> None:
    b = np.full((H, W, 3), 0.5)
    a = b + 0.2 * ((np.indices((H, W)).sum(axis=0) % 2) * 2.0 - 1.0)[..., None]
    assert flip_map(a, b, 120.0).mean() < 0.5 * flip_map(a, b, 10.0).mean()


# --- difference image -------------------------------------------------------------------------------------------------


def test_difference_image_is_a_heat_map_of_the_channel_that_differs_most() -> None:
    b = np.full((40, 600, 3), 0.5, dtype=np.float32)
    a = b.copy()
    a[:, 200:400, 1] += 0.1
    a[:, 400:] -= 0.4
    a[0, 0], b[0, 1] = np.nan, np.inf
    a[1, 1] = b[1, 1] = np.nan
    picture = difference_image(a, b)[TITLE:, MARGIN:]
    equal, less, most = (picture[5, x] for x in (100, 300, 500))
    scale = colors().tolist()
    assert [scale.index(colour.tolist()) for colour in (equal, less, most)] == [0, 51, 204]  # the scale ends at 0.5
    assert picture[0, 0].tolist() == picture[0, 1].tolist() == scale[-1] and picture[1, 1].tolist() == scale[0]
