"""The net property of the sample sequence, and the moments of sampled shapes and directions against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernel_tools import floats, launch, sobol_like, uints, unit, vec2s, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.shade.sampling import (
    cap_point,
    cosine_hemisphere,
    disk,
    frame_x,
    ggx_lambda,
    ggx_normal,
    ggx_visible_share,
    hash_u32,
    polygon,
    reverse_bits,
    sample_2d,
    search_cdf,
    sobol_second,
    triangle,
    unit_float,
    where_vec3,
)
from wrt.kernels.structs import kernel
from wrt.kernels.structs import unit as device_unit


@kernel
def sample_kernel(key: wp.array(dtype=wp.uint32), index: wp.array(dtype=wp.uint32), dimension: int,
                  out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    out[i] = sample_2d(key[i], index[i], dimension)


@kernel
def bits_kernel(x: wp.array(dtype=wp.uint32), hashed: wp.array(dtype=wp.uint32), reverse: wp.array(dtype=wp.uint32),
                second: wp.array(dtype=wp.uint32), number: wp.array(dtype=wp.float32)):
    i = wp.tid()
    hashed[i] = hash_u32(x[i])
    reverse[i] = reverse_bits(x[i])
    second[i] = sobol_second(x[i])
    number[i] = unit_float(x[i])


@kernel
def shapes_kernel(xi: wp.array(dtype=wp.vec2), sides: int, rotation: float, n: wp.array(dtype=wp.vec3),
                  on_disk: wp.array(dtype=wp.vec2), on_polygon: wp.array(dtype=wp.vec2), on_triangle: wp.array(dtype=wp.vec2),
                  above: wp.array(dtype=wp.vec3), tangent: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    on_disk[i] = disk(xi[i])
    on_polygon[i] = polygon(xi[i], sides, rotation)
    on_triangle[i] = triangle(xi[i])
    above[i] = cosine_hemisphere(xi[i], n[i])
    tangent[i] = frame_x(n[i])


@kernel
def ggx_kernel(xi: wp.array(dtype=wp.vec2), n: wp.vec3, wo: wp.vec3, alpha: float, h: wp.array(dtype=wp.vec3),
               share: wp.array(dtype=wp.float32)):
    i = wp.tid()
    m = ggx_normal(cap_point(xi[i]), n, wo, alpha)
    h[i] = m
    wi = 2.0 * wp.dot(m, wo) * m - wo
    if wp.dot(n, wi) > 0.0:
        share[i] = ggx_visible_share(wp.dot(n, wo), wp.dot(n, wi), alpha)


@kernel
def lambda_kernel(cosine: wp.array(dtype=wp.float32), alpha: float, out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out[i] = ggx_lambda(cosine[i], alpha)


@kernel
def search_kernel(cdf: wp.array(dtype=wp.float32), first: int, count: int, x: wp.array(dtype=wp.float32),
                  out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = search_cdf(cdf, first, count, x[i])


def samples(key, index, dimension=0):
    index = np.asarray(index, np.uint32)
    out = zeros(len(index), wp.vec2)
    launch(sample_kernel, len(index), uints(np.broadcast_to(np.uint32(key), index.shape)), uints(index), dimension, out)
    return out.numpy()


def shapes(xi, sides=5, rotation=0.3, n=(0.0, 0.0, 1.0)):
    count = len(xi)
    outs = [zeros(count, wp.vec2), zeros(count, wp.vec2), zeros(count, wp.vec2), zeros(count, wp.vec3), zeros(count, wp.vec3)]
    launch(shapes_kernel, count, vec2s(xi), sides, rotation, vec3s(np.broadcast_to(n, (count, 3))), *outs)
    return [out.numpy().astype(np.float64) for out in outs]


# --- the sequence -----------------------------------------------------------------------------------------------------


def assert_net(points, k):
    """Check that each elementary interval 2^-a x 2^-(k-a) has exactly one point."""
    for a in range(k + 1):
        cell = np.floor(points * [2.0**a, 2.0 ** (k - a)]).astype(int)
        number = cell[:, 0] * 2 ** (k - a) + cell[:, 1]
        assert len(np.unique(number)) == 2**k, (a, k - a)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 40), st.integers(0, 10), st.integers(0, 2**22 - 1))
def test_every_aligned_block_is_a_net(key, dimension, k, block):
    first = (block << k) & 0xFFFFFFFF
    assert_net(samples(key, first + np.arange(2**k, dtype=np.uint64), dimension), k)


def test_keys_and_dimensions_are_independent():
    # The same net for two pixels or two dimensions would be visible as a pattern. The points of two keys or dimensions must be
    # uncorrelated, and pairs of a coordinate of each must fill the square evenly.
    rng = np.random.default_rng(1)
    n = 4096
    sets = [samples(key, np.arange(n), dimension) for key, dimension in
            ((1, 0), (2, 0), (1, 1), (1, 2), (int(rng.integers(2**32)), 0), (0, 0), (2**32 - 1, 0))]
    for i, a in enumerate(sets):
        for b in sets[:i]:
            for x in range(2):
                for y in range(2):
                    assert abs(np.corrcoef(a[:, x], b[:, y])[0, 1]) < 5.0 / np.sqrt(n)
                    counts = np.histogram2d(a[:, x], b[:, y], bins=8, range=[[0, 1], [0, 1]])[0]
                    assert counts.min() > 20 and counts.max() < 120  # The expectation is 64.


def test_first_sample_over_neighbouring_keys_is_uniform():
    # With one sample for each pixel, the samples of neighbouring pixels must be white noise.
    keys = np.arange(1 << 14, dtype=np.uint32)
    out = zeros(len(keys), wp.vec2)
    launch(sample_kernel, len(keys), uints(keys), uints(np.zeros(len(keys))), 0, out)
    counts = np.histogram2d(*out.numpy().T, bins=16, range=[[0, 1], [0, 1]])[0]
    chi2 = ((counts - 64.0) ** 2 / 64.0).sum()  # 255 degrees of freedom: the standard deviation is 22.6.
    assert 255.0 - 6.0 * 22.6 < chi2 < 255.0 + 6.0 * 22.6
    assert abs(np.corrcoef(out.numpy()[:-1, 0], out.numpy()[1:, 0])[0, 1]) < 0.04


def test_owen_scrambling_beats_random_samples():
    # The error of the mean of a smooth function over 1024 points is far below 1/sqrt(n) (Owen 1997: n^-1.5 up to logarithms).
    errors = []
    for key in range(40):
        x, y = samples(key, np.arange(1024)).T.astype(np.float64)
        errors.append((np.exp(x) * np.sin(3.0 * y)).mean() - (np.e - 1.0) * (1.0 - np.cos(3.0)) / 3.0)
    assert np.sqrt(np.mean(np.square(errors))) < 0.01 / np.sqrt(1024)
    assert abs(np.mean(errors)) < 4.0 * np.std(errors) / np.sqrt(40)  # The mean is unbiased.


def run_bits(x):
    x = np.asarray(x, np.uint32)
    outs = [zeros(len(x), wp.uint32) for _ in range(3)] + [zeros(len(x))]
    launch(bits_kernel, len(x), uints(x), *outs)
    return [out.numpy() for out in outs]


def test_bit_tricks():
    x = np.concatenate([np.arange(4096), np.random.default_rng(2).integers(0, 2**32, 4096)]).astype(np.uint32)
    hashed, reverse, second, number = run_bits(x)
    assert np.array_equal(reverse, [int(f"{int(v):032b}"[::-1], 2) for v in x])
    # The second Sobol dimension by definition, from the direction numbers of the primitive polynomial x + 1.
    v = [1 << 31]
    for _ in range(31):
        v.append(v[-1] ^ (v[-1] >> 1))
    expected = []
    for value in x:
        total = 0
        for bit in range(32):
            if int(value) >> bit & 1:
                total ^= v[bit]
        expected.append(total)
    assert np.array_equal(second, [int(f"{e:032b}"[::-1], 2) for e in expected])
    assert np.array_equal(number, (x >> 8) * 2.0**-24) and number.max() < 1.0
    assert len(np.unique(hashed)) == len(np.unique(x))
    flips = []
    for bit in range(32):
        other = run_bits(x ^ np.uint32(1 << bit))[0]
        flips.append(np.unpackbits((hashed ^ other).view(np.uint8)).mean())
    assert 0.45 < min(flips) and max(flips) < 0.55  # Each input bit flips half of the output bits.


# --- shapes -----------------------------------------------------------------------------------------------------------


def test_disk_moments():
    d = shapes(sobol_like(1 << 17, np.random.default_rng(3)))[0]
    r2 = (d**2).sum(axis=1)
    assert r2.max() <= 1.0 + 1e-6
    assert np.abs(d.mean(axis=0)).max() < 1e-3
    assert np.abs((d**2).mean(axis=0) - 0.25).max() < 1e-3 and abs((d[:, 0] * d[:, 1]).mean()) < 1e-3
    assert abs((r2**2).mean() - 1.0 / 3.0) < 1e-3
    for radius in (0.1, 0.5, 0.9):
        assert abs((r2 <= radius**2).mean() - radius**2) < 2e-3
    assert np.array_equal(shapes(np.array([[0.5, 0.5]]))[0], [[0.0, 0.0]])


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 8, 64])
@pytest.mark.parametrize("rotation", [0.0, 0.7])
def test_polygon_moments(sides, rotation):
    p = shapes(sobol_like(1 << 16, np.random.default_rng(5)), sides, rotation)[1]
    half = np.pi / sides
    normals = rotation + half + 2.0 * half * np.arange(sides)
    across = p @ np.array([np.cos(normals), np.sin(normals)])
    assert across.max() <= np.cos(half) + 1e-6  # Inside every side, and so inside the circle.
    assert np.linalg.norm(p, axis=1).max() <= 1.0 + 1e-6
    # The second moment of a regular n-gon of circumradius 1 about its center is (2 + cos(2 pi / n)) / 6.
    assert abs((p**2).sum(axis=1).mean() - (2.0 + np.cos(2.0 * half)) / 6.0) < 2e-3
    assert np.abs(p.mean(axis=0)).max() < 2e-3
    for scale in (0.3, 0.7):
        assert abs((across.max(axis=1) <= scale * np.cos(half)).mean() - scale**2) < 4e-3
    sector = np.floor(np.mod(np.arctan2(p[:, 1], p[:, 0]) - rotation, 2.0 * np.pi) / (2.0 * half)).astype(int) % sides
    assert np.abs(np.bincount(sector, minlength=sides) * sides / len(p) - 1.0).max() < 0.02


def test_triangle_moments():
    b = shapes(sobol_like(1 << 16, np.random.default_rng(6)))[2]
    w = np.column_stack([1.0 - b.sum(axis=1), b])
    assert w.min() >= -1e-7
    assert np.abs(w.mean(axis=0) - 1.0 / 3.0).max() < 1e-3
    assert np.abs((w**2).mean(axis=0) - 1.0 / 6.0).max() < 1e-3
    assert np.abs((w * np.roll(w, 1, axis=1)).mean(axis=0) - 1.0 / 12.0).max() < 1e-3
    for share in (0.2, 0.6):
        assert np.abs((w >= 1.0 - share).mean(axis=0) - share**2).max() < 3e-3


NORMALS = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, -0.48, -0.64), (1e-4, 0.0, -1.0)]


@pytest.mark.parametrize("n", NORMALS)
def test_cosine_hemisphere_moments(n):
    n = unit(np.array(n))
    d = shapes(sobol_like(1 << 16, np.random.default_rng(7)), n=n)[3]
    assert np.abs(np.linalg.norm(d, axis=1) - 1.0).max() < 1e-6
    cosine = d @ n
    assert cosine.min() >= -1e-6
    assert abs(cosine.mean() - 2.0 / 3.0) < 1e-3 and abs((cosine**2).mean() - 0.5) < 1e-3
    across = d - cosine[:, None] * n
    assert np.abs(across.mean(axis=0)).max() < 2e-3
    second = across.T @ across / len(d)  # Must be (I - n n^T) / 4: isotropic in the plane.
    assert np.abs(second - 0.25 * (np.eye(3) - np.outer(n, n))).max() < 2e-3
    for c in (0.2, 0.7):
        assert abs((cosine >= c).mean() - (1.0 - c * c)) < 2e-3


def test_frames_are_orthonormal():
    rng = np.random.default_rng(8)
    near_poles = np.array([[1e-20, 0, -1], [-1e-8, 1e-8, -1], [0, 1e-4, 1]])
    n = np.concatenate([unit(rng.normal(size=(5000, 3))), NORMALS, unit(near_poles)])
    n = n.astype(np.float32).astype(np.float64)
    count = len(n)
    outs = [zeros(count, wp.vec2) for _ in range(3)] + [zeros(count, wp.vec3) for _ in range(2)]
    launch(shapes_kernel, count, vec2s(np.full((count, 2), 0.25)), 3, 0.0, vec3s(n), *outs)
    x = outs[4].numpy().astype(np.float64)
    assert np.abs(np.linalg.norm(x, axis=1) - 1.0).max() < 1e-6
    assert np.abs((x * n).sum(axis=1)).max() < 1e-6


# --- GGX --------------------------------------------------------------------------------------------------------------


def run_ggx(xi, n, wo, alpha):
    h, share = zeros(len(xi), wp.vec3), zeros(len(xi))
    launch(ggx_kernel, len(xi), vec2s(xi), wp.vec3(*n), wp.vec3(*wo), float(alpha), h, share)
    return h.numpy().astype(np.float64), share.numpy().astype(np.float64)


def smith_lambda(c, alpha):
    return 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / c**2 - 1.0)) - 1.0)


def ggx_d(c, alpha):
    return alpha**2 / (np.pi * (c * c * (alpha**2 - 1.0) + 1.0) ** 2)


def hemisphere_grid(n=400):
    """Return directions of the upper hemisphere and their solid angles: Gauss nodes in the cosine, equal steps in azimuth."""
    x, w = np.polynomial.legendre.leggauss(n)
    c, w = 0.5 * (x + 1.0), 0.5 * w
    phi = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    c, phi = np.meshgrid(c, phi, indexing="ij")
    s = np.sqrt(1.0 - c * c)
    return np.stack([s * np.cos(phi), s * np.sin(phi), c], axis=-1), np.broadcast_to(w[:, None] * 2.0 * np.pi / n, c.shape)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("cos_o", [1.0, 0.7, 0.2])
def test_ggx_normals_are_those_that_are_seen(cos_o, alpha):
    # The density of visible normals is D(m) max(0, wo.m) / (cos_o (1 + Lambda)). Quadrature gives the moments of m.
    wo = np.array([np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    h, _ = run_ggx(sobol_like(1 << 16, np.random.default_rng(9)), (0.0, 0.0, 1.0), wo, alpha)
    assert np.abs(np.linalg.norm(h, axis=1) - 1.0).max() < 1e-5
    assert (h @ wo).min() > -1e-6 and h[:, 2].min() > 0.0
    # With theta = atan(alpha tan(q)), the peak in q has the same width for every alpha.
    x, w = np.polynomial.legendre.leggauss(600)
    q, w = 0.25 * np.pi * (x + 1.0), 0.25 * np.pi * w
    theta = np.arctan(alpha * np.tan(q))
    jacobian = alpha / (np.cos(q) ** 2 + alpha**2 * np.sin(q) ** 2)
    phi = 2.0 * np.pi * (np.arange(256) + 0.5) / 256
    t, p = np.meshgrid(theta, phi, indexing="ij")
    m = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    weight = (w * jacobian * np.sin(theta))[:, None] * 2.0 * np.pi / 256
    density = ggx_d(np.cos(t), alpha) * np.maximum(m @ wo, 0.0) / (cos_o * (1.0 + smith_lambda(cos_o, alpha)))
    assert (density * weight).sum() == pytest.approx(1.0, abs=2e-3)
    for moment in (lambda m: m[..., 2], lambda m: m[..., 0], lambda m: m[..., 1] ** 2, lambda m: m[..., 0] ** 2):
        expected = (moment(m) * density * weight).sum()
        assert moment(h).mean() == pytest.approx(expected, abs=3e-3)
    assert abs(h[:, 1].mean()) < 3e-3


@pytest.mark.parametrize("alpha", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("cos_o", [1.0, 0.6, 0.25])
def test_white_rough_mirror_against_quadrature(cos_o, alpha):
    # The reflectance of single scattering with F = 1 is the integral of D G2 / (4 cos_o) over the hemisphere of wi. It is at most 1.
    wo = np.array([np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    _, share = run_ggx(sobol_like(1 << 16, np.random.default_rng(10)), (0.0, 0.0, 1.0), wo, alpha)
    wi, weight = hemisphere_grid(500)
    h = unit(wi + wo)
    g2 = 1.0 / (1.0 + smith_lambda(cos_o, alpha) + smith_lambda(wi[..., 2], alpha))
    expected = (ggx_d(h[..., 2], alpha) * g2 / (4.0 * cos_o) * weight).sum()
    assert share.min() >= 0.0 and share.max() <= 1.0 + 1e-6
    assert share.mean() == pytest.approx(expected, abs=3e-3)
    assert 0.3 < expected < 1.0
    if (cos_o, alpha) == (1.0, 1.0):
        assert expected == pytest.approx(1.0 - np.log(2.0), abs=1e-4)  # The closed form.


def test_ggx_in_any_frame_is_the_same_distribution():
    xi = sobol_like(1 << 15, np.random.default_rng(11))
    cos_o, alpha = 0.5, 0.4
    reference = run_ggx(xi, (0.0, 0.0, 1.0), (np.sqrt(0.75), 0.0, 0.5), alpha)[0][:, 2].mean()
    for normal in NORMALS:
        n = unit(np.array(normal))
        side = unit(np.cross(n, [0.3, 0.5, -0.7]))
        wo = cos_o * n + np.sqrt(1.0 - cos_o**2) * side
        assert (run_ggx(xi, n, wo, alpha)[0] @ n).mean() == pytest.approx(reference, abs=2e-3)


def test_smith_lambda():
    cosine = np.linspace(0.001, 1.0, 500).astype(np.float32)
    for alpha in (0.01, 0.3, 1.0):
        out = zeros(500)
        launch(lambda_kernel, 500, floats(cosine), alpha, out)
        assert np.allclose(out.numpy(), smith_lambda(cosine.astype(np.float64), alpha), rtol=1e-4, atol=2e-7)


# --- tables -----------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 5), min_size=1, max_size=40).filter(any), st.integers(0, 3))
def test_search_cdf(weights, before):
    cdf = (np.cumsum(weights) / np.sum(weights)).astype(np.float32)
    padded = np.concatenate([np.full(before, 0.5, np.float32), cdf, [0.25]])
    x = np.concatenate([np.linspace(0.0, 1.0, 101)[:-1], cdf[:-1], np.nextafter(cdf, np.float32(0.0))]).astype(np.float32)
    x = x[(x >= 0.0) & (x < 1.0)]
    out = zeros(len(x), wp.int32)
    launch(search_kernel, len(x), floats(padded), before, len(cdf), floats(x), out)
    expected = np.searchsorted(cdf, x, side="right")
    assert np.array_equal(out.numpy(), expected)
    assert all(weights[i] > 0 for i in out.numpy())  # An entry of weight 0 is never chosen.


@kernel
def unit_kernel(v: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3), warps: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = device_unit(v[i])
    warps[i] = wp.normalize(v[i])


def test_unit_vectors_without_a_branch() -> None:
    rng = np.random.default_rng(0)
    v = (rng.normal(size=(20_000, 3)) * 10.0 ** rng.uniform(-45, 38, (20_000, 1))).astype(np.float32)
    v[:10], v[10:20], v[20:30, 0], v[30:40, 1] = 0.0, -0.0, np.inf, np.nan
    out, warps = zeros(len(v), wp.vec3), zeros(len(v), wp.vec3)
    launch(unit_kernel, len(v), vec3s(v), out, warps)
    np.testing.assert_array_equal(out.numpy(), warps.numpy())
    assert not out.numpy()[:20].any() and not out.numpy()[30:40].any()


@kernel
def where_kernel(a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = where_vec3(i % 2 == 0, a[i], b[i])


def test_one_of_two_vectors() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 8, 3)).astype(np.float32)
    out = zeros(8, wp.vec3)
    launch(where_kernel, 8, vec3s(a), vec3s(b), out)
    assert (out.numpy() == np.where(np.arange(8)[:, None] % 2 == 0, a, b)).all()
