"""Independent random samples are uniform and uncorrelated, and means have exactly the noise of independent samples."""

import numpy as np
import pytest

from tests.kernel_tools import launch, uints, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import independent_2d, make_sample_2d, sample_2d
from wrt.kernels.structs import kernel


@kernel
def independent_kernel(key: wp.array(dtype=wp.uint32), index: wp.array(dtype=wp.uint32), dimension: int,
                       out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    out[i] = independent_2d(key[i], index[i], dimension)


def samples(key, index, dimension=0):
    """Return samples, (N, 2) float64. key and index are broadcast."""
    key, index = np.broadcast_arrays(np.asarray(key, np.uint32), np.asarray(index, np.uint32))
    out = zeros(key.size, wp.vec2)
    launch(independent_kernel, key.size, uints(key.ravel()), uints(index.ravel()), dimension, out)
    return out.numpy().astype(np.float64)


def chi2(points, bins=16):
    """Return chi^2 of the counts in bins x bins cells, as standard deviations from its expectation."""
    counts = np.histogram2d(*points.T, bins=bins, range=[[0, 1], [0, 1]])[0]
    freedom, expected = bins * bins - 1, len(points) / bins**2
    return (((counts - expected) ** 2 / expected).sum() - freedom) / np.sqrt(2.0 * freedom)


def test_the_setting_chooses_the_sampler():
    assert make_sample_2d(Features()) is sample_2d
    assert make_sample_2d(Features(independent=True)) is independent_2d


@pytest.mark.parametrize(("key", "index"), [(7, np.arange(1 << 16)), (np.arange(1 << 16), 0), (2**32 - 1, np.arange(1 << 16))],
                         ids=["one pixel", "first sample of many pixels", "largest key"])
@pytest.mark.parametrize("dimension", [0, 1, 5])
def test_uniform_and_neither_too_even_nor_too_clustered(key, index, dimension):
    points = samples(key, index, dimension)
    assert points.min() >= 0.0 and points.max() < 1.0
    # A low-discrepancy sequence has a chi^2 near 0, 11 standard deviations below that of independent points.
    assert abs(chi2(points)) < 5.0
    assert abs(chi2(np.stack([points[:-1, 0], points[1:, 0]], axis=1))) < 5.0  # A sample does not depend on the last one.


def test_keys_and_dimensions_are_independent():
    n = 1 << 14
    columns = np.concatenate([samples(key, np.arange(n), dimension).T for key in (0, 1, 2**31) for dimension in (0, 1)])
    correlation = np.corrcoef(columns)
    assert np.abs(correlation[~np.eye(len(columns), dtype=bool)]).max() < 5.0 / np.sqrt(n)


@pytest.mark.parametrize("n", [16, 256])
def test_the_noise_of_a_mean_is_sigma_over_root_n(n):
    keys = np.arange(4000)
    points = samples(keys[:, None], np.arange(n)[None, :]).reshape(len(keys), n, 2)
    means = (np.exp(points[..., 0]) * np.sin(3.0 * points[..., 1])).mean(axis=1)
    exact = (np.e - 1.0) * (1.0 - np.cos(3.0)) / 3.0
    second = (np.e**2 - 1.0) / 2.0 * (0.5 - np.sin(6.0) / 12.0)  # The mean of the square: E[e^2x] E[sin^2 3y].
    expected = (second - exact**2) / n
    assert np.mean((means - exact) ** 2) == pytest.approx(expected, rel=0.12)  # 5 standard deviations of the mean of 4000 squares.
    assert abs(means.mean() - exact) < 5.0 * np.sqrt(expected / len(keys))
