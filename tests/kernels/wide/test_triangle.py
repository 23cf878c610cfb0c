"""The lanes of wide/triangle.h clamp any t to a triangle's box as units/triangle.py does, to the last bit."""

import numpy as np

from tests.kernel_tools import cpu_only, floats, ints, launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.units.box import BoxRay
from wrt.kernels.units.triangle import within_bounds
from wrt.kernels.wide.layout import LANES
from wrt.kernels.wide.packets import packet_kernel

pytestmark = cpu_only
FIELDS = 13  # Of a lane: origin, reciprocal direction, t, low and high corner of the box.


@wp.func_native("""
    typedef wrt::Vec3<wrt::Rays> Vector;
    wrt::Rays field[13];
    for (int k = 0; k < 13; ++k) field[k] = wrt::load<wrt::Rays>(numbers.data + 16 * (13 * i + k));
    const wrt::BoxRay<wrt::Rays> ray = {{{field[0], field[1], field[2]}}, {{field[3], field[4], field[5]}}};
    wrt::Hits<16> hit = {};
    hit.t = field[6];
    hit.mask = mask;
    wrt::within_bounds<wrt::Bounds>(ray, hit, Vector{{field[7], field[8], field[9]}}, Vector{{field[10], field[11], field[12]}});
    wrt::store(out.data + 16 * i, hit.t);
    return hit.mask;
""")
def clamp_lanes(numbers: wp.array(dtype=wp.float32), i: int, mask: int, out: wp.array(dtype=wp.float32)) -> int: ...


@packet_kernel
def vectorised(numbers: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32), mask: wp.array(dtype=wp.int32)):
    i = wp.tid()
    mask[i] = clamp_lanes(numbers, i, mask[i], out)


@wp.func
def vector(numbers: wp.array3d(dtype=wp.float32), i: int, first: int, lane: int):
    return wp.vec3(numbers[i, first, lane], numbers[i, first + 1, lane], numbers[i, first + 2, lane])


@kernel
def scalar(numbers: wp.array3d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
    i, lane = wp.tid()
    ray = BoxRay()
    ray.origin = vector(numbers, i, 0, lane)
    ray.inv_dir = vector(numbers, i, 3, lane)
    out[i, lane] = within_bounds(ray, numbers[i, 6, lane], vector(numbers, i, 7, lane), vector(numbers, i, 10, lane))


def clamp_cases(rng, n):
    """Return boxes, rays at small distances of them, and t near the planes or anywhere, (n, FIELDS, LANES).

    Direction components are 0, subnormal, so small that the shear underflows, or ordinary; several rays lie in faces."""
    shape = (n, 3, LANES)
    size = 10.0 ** rng.uniform(-30.0, 0.0, (n, 1, LANES))
    origin, low = rng.integers(-2, 3, shape) * size, rng.integers(-3, 1, shape) * size
    high = low + rng.integers(0, 3, shape) * size
    direction = np.where(rng.random(shape) < 0.3, 0.0, 10.0 ** rng.uniform(-45.0, 0.0, shape)) * rng.choice([-1.0, 1.0], shape)
    np.put_along_axis(direction, rng.integers(0, 3, (n, 1, LANES)), 1.0, axis=1)
    one = (n, 1, LANES)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        inverse = np.float32(1.0) / direction.astype(np.float32)
        planes = (np.where(rng.random(shape) < 0.5, low, high) - origin) * inverse
        near = np.take_along_axis(planes, rng.integers(0, 3, one), axis=1) * (1.0 + rng.integers(-16, 17, one) * 2.0**-24)
        anywhere = 10.0 ** rng.uniform(-45.0, 2.0, one) * rng.choice([-1.0, 1.0], one)
        t = np.where(rng.random(one) < 0.6, near, anywhere).astype(np.float32)
    t[~np.isfinite(t)] = 1.0
    return np.concatenate([origin, inverse, t, low, high], axis=1).astype(np.float32)


def test_lanes_clamp_t_as_the_unit_does():
    n = 4000
    numbers = clamp_cases(np.random.default_rng(0), n)
    masks = np.where(np.arange(n) % 2, 1 << np.arange(n) // 2 % LANES, (1 << LANES) - 1)  # one lane, or all of them
    clamped, mask, expected = zeros(n * LANES), ints(masks), zeros((n, LANES))
    launch(vectorised, n, floats(numbers.reshape(-1)), clamped, mask)
    launch(scalar, (n, LANES), wp.array(numbers, dtype=wp.float32, device="cpu"), expected)
    clamped, expected = clamped.numpy().reshape(n, LANES), expected.numpy()
    asked, hit = ((each[:, None] >> np.arange(LANES) & 1).astype(bool) for each in (masks, mask.numpy()))
    np.testing.assert_array_equal(hit, asked & ~np.isinf(expected))
    np.testing.assert_array_equal(clamped[hit].view(np.int32), expected[hit].view(np.int32))
    moved = hit & (clamped != numbers[:, 6])
    assert min(hit.mean(), (asked & ~hit).mean(), moved.mean()) > 0.02
