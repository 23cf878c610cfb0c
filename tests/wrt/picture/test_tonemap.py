from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wrt.picture.tonemap import (
    ACES_IN,
    ACES_OUT,
    AGX_PIVOT,
    REINHARD_WHITE,
    agx_contrast,
    decode_srgb,
    encode_srgb,
    luminance,
    to_codes,
    tone_map,
)
from wrt.scene.settings import TONEMAPS

ALL = pytest.mark.parametrize("name", TONEMAPS)
GREYS = np.repeat(np.logspace(-7, 10, 4001)[:, None], 3, axis=1).astype(np.float32)


# --- sRGB -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 16])
def test_every_code_survives_decoding_and_encoding(bits: int) -> None:
    codes = np.arange(2**bits)
    linear = decode_srgb(codes / (2**bits - 1)).astype(np.float32)
    assert np.array_equal(to_codes(np.repeat(linear[:, None], 3, axis=1), bits=bits)[:, 1], codes)


def test_transfer_function_at_values_that_can_be_worked_out_by_hand() -> None:
    assert encode_srgb(np.array([0.0, 0.001, 1.0])) == pytest.approx([0.0, 0.01292, 1.0], abs=1e-15)
    assert decode_srgb(np.array([0.0, 0.01292, 0.555, 1.0])) == pytest.approx([0, 0.001, (0.61 / 1.055) ** 2.4, 1])


# --- every curve ------------------------------------------------------------------------------------------------------


@ALL
def test_grey_ramp_is_monotonic_in_range_and_stays_grey(name: str) -> None:
    shown = tone_map(GREYS, tonemap=name)
    assert shown.dtype == np.float32
    assert shown.min() >= 0.0 and shown.max() == 1.0
    assert np.diff(shown[:, 1]).min() >= -1e-7  # float32 rounding where the curve is flat
    codes = to_codes(GREYS, tonemap=name)
    assert (np.diff(codes.astype(int), axis=0) >= 0).all()
    assert (codes == codes[:, :1]).all() or name == "aces"
    assert np.abs(shown - shown[:, 1:2]).max() < 2e-5  # the published ACES matrices hold a grey to 1e-5


@ALL
@given(color=st.lists(st.floats(width=32), min_size=3, max_size=3), exposure=st.floats(-100, 100))
def test_any_input_is_shown_in_range(name: str, color: list[float], exposure: float) -> None:
    shown = tone_map(np.array(color, dtype=np.float32), exposure, name)
    assert np.isfinite(shown).all() and (shown >= 0.0).all() and (shown <= 1.0).all()


@ALL
def test_exposure_is_a_factor_of_two_per_stop(name: str) -> None:
    pixels = np.random.default_rng(1).random((50, 3), dtype=np.float32)
    assert np.array_equal(tone_map(pixels, 3.0, name), tone_map(8.0 * pixels, 0.0, name))


@ALL
def test_black_nan_and_infinity(name: str) -> None:
    shown = tone_map(np.array([[0, 0, 0], [np.nan] * 3, [-np.inf] * 3, [-1.0] * 3, [np.inf] * 3]), tonemap=name)
    assert shown[:4].max() < 1e-6
    assert shown[4] == pytest.approx([1, 1, 1])


# --- each curve -------------------------------------------------------------------------------------------------------


def test_reinhard_maps_its_white_to_one_and_keeps_the_hue() -> None:
    shown = tone_map(np.array([[REINHARD_WHITE] * 3, [0.18] * 3, [0.2, 0.1, 0.05]]), tonemap="reinhard")
    assert shown[0] == pytest.approx([1, 1, 1])
    assert shown[1] == pytest.approx([0.18 * (1 + 0.18 / 16) / 1.18] * 3)
    assert shown[2] / shown[2, 0] == pytest.approx([1.0, 0.5, 0.25])
    assert luminance(shown[2]) < luminance(np.array([0.2, 0.1, 0.05]))


def test_aces_matrices_keep_white_and_its_curve_is_the_published_one() -> None:
    for matrix in (ACES_IN, ACES_OUT):
        assert matrix.sum(axis=1) == pytest.approx([1, 1, 1], abs=2e-5)
    v = 0.18
    expected = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.432951) + 0.238081)
    assert tone_map(np.full(3, 0.18), tonemap="aces") == pytest.approx([expected] * 3, abs=1e-5)


def test_agx_contrast_passes_its_pivot_with_its_slope_and_ends_in_the_corners() -> None:
    x, step = AGX_PIVOT[0], 1e-5
    low, middle, high = agx_contrast(np.array([x - step, x, x + step]))
    assert middle == pytest.approx(0.5)
    assert [(middle - low) / step, (high - middle) / step] == pytest.approx([2.0, 2.0], rel=1e-3)
    assert agx_contrast(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0], abs=1e-12)
    assert (np.diff(agx_contrast(np.linspace(0, 1, 4097))) > 0).all()


def test_agx_shows_mid_grey_at_half_the_code_and_bright_colours_pale() -> None:
    assert tone_map(np.full(3, 0.18), tonemap="agx") == pytest.approx([0.5**2.2] * 3, rel=1e-5)
    dim, bright = tone_map(np.array([[0.1, 0.0, 0.0], [300.0, 0.0, 0.0]]), tonemap="agx")
    assert dim[1] < 0.2 * dim[0]
    assert bright[1] > 0.5 * bright[0]
