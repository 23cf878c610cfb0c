"""The sphere test against float64 and rational arithmetic."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernel_tools import directions, floats, launch, rounded, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, kernel
from wrt.kernels.units.box import box_ray
from wrt.kernels.units.sphere import ray_sphere


@kernel
def sphere_kernel(
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    t_min: wp.array(dtype=wp.float32),
    center: wp.array(dtype=wp.vec3),
    radius: wp.array(dtype=wp.float32),
    hits: wp.array(dtype=Hit),
):
    i = wp.tid()
    ray = Ray()
    ray.origin = origin[i]
    ray.direction = direction[i]
    ray.t_min = t_min[i]
    ray.t_max = float(wp.inf)
    hits[i] = ray_sphere(box_ray(ray), ray, center[i], radius[i])


def run(origin, direction, center, radius, t_min=0.0):
    rows = [np.asarray(a, np.float32).reshape(-1, 3) for a in (origin, direction, center)]
    scalars = [np.asarray(a, np.float32).reshape(-1) for a in (t_min, radius)]
    n = max(len(a) for a in rows + scalars)
    origin, direction, center = (vec3s(np.broadcast_to(a, (n, 3))) for a in rows)
    t_min, radius = (floats(np.broadcast_to(a, (n,))) for a in scalars)
    hits = zeros(n, Hit)
    launch(sphere_kernel, n, origin, direction, t_min, center, radius, hits)
    hits = hits.numpy()
    assert (hits["u"] == 0.0).all() and (hits["v"] == 0.0).all()
    assert (np.isinf(hits["t"]) == (hits["prim_id"] == int(NO_HIT))).all()
    return hits["t"].astype(np.float64)


def exact(origin, direction, center, radius):
    """Return t of both crossings (N, 2) and the discriminant relative to the radius (N,), in extended precision."""
    f = np.asarray(origin, np.longdouble) - center
    d = np.asarray(direction, np.longdouble)
    a, b = (d * d).sum(-1), (f * d).sum(-1)
    gap = f - (b / a)[..., None] * d
    inside = np.asarray(radius, np.longdouble) ** 2 - (gap * gap).sum(-1)
    root = np.sqrt(np.maximum(inside, 0.0) / a)
    middle = -b / a
    t = np.stack([middle - root, middle + root], axis=-1)
    return t.astype(np.float64), (inside / np.asarray(radius, np.longdouble) ** 2).astype(np.float64)


def aimed(rng, n, distance):
    center = rounded(rng.normal(size=(n, 3)))
    radius = rounded(rng.uniform(0.2, 2.0, n))
    direction = rounded(directions(rng, n) * 10.0 ** rng.uniform(-1, 1, (n, 1)))
    target = center + directions(rng, n) * (radius * rng.uniform(0.0, 1.4, n))[:, None]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    origin = rounded(target - direction / length * distance * rng.uniform(1.5, 4.0, (n, 1)))
    return origin, direction, center, radius


@pytest.mark.parametrize("distance", [2.0, 30.0, 1000.0])
def test_first_crossing_against_extended_precision(distance):
    origin, direction, center, radius = aimed(np.random.default_rng(1), 20_000, distance)
    t = run(origin, direction, center, radius)
    expected, inside = exact(origin, direction, center, radius)
    first = np.where(expected[:, 0] >= 0.0, expected[:, 0], expected[:, 1])
    assert np.isfinite(t)[(inside > 1e-9) & (first > 0.0)].all()
    assert not np.isfinite(t)[inside < -1e-9].any()
    clear = np.isfinite(t) & (inside > 1e-9)
    assert clear.sum() > 5000
    assert np.allclose(t[clear], first[clear], rtol=8.0 * 2.0**-24, atol=0.0)


@pytest.mark.parametrize("radius", [1e2, 1e4, 1e6])
def test_a_sphere_as_the_ground(radius):
    # In float32, the height above the sphere is the difference of two numbers as large as the radius.
    rng = np.random.default_rng(6)
    n = 10_000
    origin = rounded(np.stack([rng.uniform(-5, 5, n), rng.uniform(0.01, 2.0, n), rng.uniform(-5, 5, n)], axis=1))
    direction = rounded(np.stack([rng.normal(size=n), -rng.uniform(0.3, 1.0, n), rng.normal(size=n)], axis=1))
    center = np.broadcast_to([0.0, -radius, 0.0], (n, 3))
    expected, inside = exact(origin, direction, center, radius)
    t = run(origin, direction, center, radius)
    hit = (inside > 1e-9) & (expected[:, 0] > 0.0)
    assert hit.sum() > 0.9 * n and np.isfinite(t)[hit].all()
    assert np.allclose(t[hit], expected[hit, 0], rtol=8.0 * 2.0**-24, atol=0.0)


def test_a_tiny_sphere_far_away_is_hit_through_its_centre():
    # Up to rounding, the distances to all planes of its padded box are the same number.
    direction = rounded(directions(np.random.default_rng(12), 10_000))
    t = run(-(2.0**20) * direction, direction, [0.0, 0.0, 0.0], 2.0**-10)
    assert np.allclose(t, 2.0**20, rtol=8.0 * 2.0**-24, atol=0.0)


def test_a_small_sphere_far_from_the_origin_is_whole():
    # The box's corners are rounded by some percent of the radius. This must not cut a slice off the sphere.
    rng = np.random.default_rng(7)
    n = 20_000
    center = rounded(1000.0 * rng.normal(size=(n, 3)))
    radius = rounded(10.0 ** rng.uniform(-3, -1, n))
    direction = directions(rng, n)
    target = center + directions(rng, n) * (radius * rng.uniform(0.8, 1.2, n))[:, None]
    origin = rounded(target - direction * 10.0 ** rng.uniform(-1, 1, (n, 1)))
    expected, inside = exact(origin, direction, center, radius)
    ahead = expected[:, 0] > 0.0
    t = run(origin, direction, center, radius)
    assert np.isfinite(t)[ahead & (inside > 1e-9)].all()
    assert not np.isfinite(t)[inside < -1e-9].any()
    assert (inside > 0.0).sum() > 2000


def test_seen_from_very_far():
    # A ray from 1e6 radii away, straight at the center, with exact coordinates: t of the near side must be exact.
    for scale in (1.0, 1e-6, 1e6):
        t = run([0.0, 0.0, -1e6 * scale], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], scale)
        assert t[0] == pytest.approx((1e6 - 1.0) * scale, rel=1e-7)
        assert np.isinf(run([0.0, 1.01 * scale, -1e6 * scale], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], scale))[0]
        assert np.isfinite(run([0.0, 0.99 * scale, -1e6 * scale], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], scale))[0]


def test_origin_inside_finds_the_way_out():
    rng = np.random.default_rng(2)
    n = 5000
    center, radius = rounded(rng.normal(size=(n, 3))), rounded(rng.uniform(0.2, 2.0, n))
    origin = rounded(center + directions(rng, n) * (radius * rng.uniform(0.0, 0.99, n))[:, None])
    direction = directions(rng, n)
    t = run(origin, direction, center, radius)
    expected, _ = exact(origin, direction, center, radius)
    assert np.allclose(t, expected[:, 1], rtol=8.0 * 2.0**-24, atol=0.0)


def test_on_the_surface():
    # The origin is exactly on the sphere and segments are closed: t = 0 is the last crossing outwards, and the first one inwards.
    center, radius = np.zeros(3), 2.0
    origin = np.array([0.0, 0.0, 2.0])
    assert run(origin, [0.0, 0.0, 1.0], center, radius)[0] == 0.0
    assert run(origin, [0.0, 0.0, -1.0], center, radius)[0] == 0.0
    assert run(origin, [0.0, 0.0, -1.0], center, radius, t_min=1e-6)[0] == 4.0
    assert np.isinf(run(origin, [0.0, 0.0, 1.0], center, radius, t_min=1e-6)[0])
    assert np.isinf(run(origin, [1.0, 0.0, 0.0], center, radius, t_min=1e-6)[0])


def test_tangent():
    step = np.float32(1.0)
    touching = run([1.0, 0.0, -5.0], [0.0, 0.0, 1.0], np.zeros(3), 1.0)
    assert touching[0] == 5.0
    outside = np.nextafter(step, np.float32(2.0))
    assert np.isinf(run([outside, 0.0, -5.0], [0.0, 0.0, 1.0], np.zeros(3), 1.0)[0])
    within = run([np.nextafter(step, np.float32(0.0)), 0.0, -5.0], [0.0, 0.0, 1.0], np.zeros(3), 1.0)
    assert abs(within[0] - (5.0 - 2.0**-11.5)) <= 1e-6


def test_t_min_beyond_the_first_crossing_takes_the_second():
    rng = np.random.default_rng(3)
    origin, direction, center, radius = aimed(rng, 5000, 3.0)
    expected, inside = exact(origin, direction, center, radius)
    crossing = inside > 0.05
    t_min = rounded(np.where(crossing, expected.mean(axis=1), 0.0))
    t = run(origin, direction, center, radius, t_min)[crossing]
    assert np.allclose(t, expected[crossing, 1], rtol=8.0 * 2.0**-24, atol=0.0)
    beyond = run(origin, direction, center, radius, rounded(expected[:, 1] * (1.0 + 1e-4)))[crossing]
    assert np.isinf(beyond).all()


def test_behind_is_a_miss():
    origin, direction, center, radius = aimed(np.random.default_rng(4), 3000, 3.0)
    assert np.isinf(run(origin, -direction, center, radius)).all()


@pytest.mark.parametrize("power", [-90, -40, 40, 90])
def test_nothing_depends_on_the_scale(power):
    origin, direction, center, radius = aimed(np.random.default_rng(5), 3000, 3.0)
    scale = 2.0**power
    reference = run(origin, direction, center, radius)
    assert np.array_equal(run(origin * scale, direction, center * scale, radius * scale), reference * scale)
    longer = run(origin, direction * scale, center, radius) * scale
    assert np.array_equal(np.isinf(longer), np.isinf(reference))
    hit = np.isfinite(reference)
    assert np.allclose(longer[hit], reference[hit], rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), power=st.integers(-90, 90), turn=st.permutations(range(3)),
       sign=st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3))
def test_turned_mirrored_scaled_and_moved_by_powers_of_two(seed, power, turn, sign):
    # Integers up to 2^10, moved by such integers, are exact in float32. A turned scene changes the order of float64 sums.
    rng = np.random.default_rng(seed)
    n = 500
    center, direction = rng.integers(-512, 513, (n, 3)), rng.integers(-64, 65, (n, 3))
    direction[~direction.any(axis=1), 1] = 1
    radius, origin = rng.integers(1, 400, n), center + rng.integers(-512, 513, (n, 3))
    reference = run(origin, direction, center, radius)
    scale, turn, sign = 2.0**power, list(turn), np.array(sign)
    moved = run((origin + 1024.0) * scale, direction * scale, (center + 1024.0) * scale, radius * scale)
    turned = run(sign * origin[:, turn], sign * direction[:, turn], sign * center[:, turn], radius)
    _, inside = exact(origin, direction, center, radius)
    clear = np.abs(inside) > 1e-9  # The last digit of float64 decides whether a grazing line hits.
    assert np.isfinite(reference).sum() > 10
    for other in (moved, turned):
        assert np.array_equal(np.isinf(other)[clear], np.isinf(reference)[clear])
        both = np.isfinite(other) & np.isfinite(reference) & clear
        assert np.allclose(other[both], reference[both], rtol=2.0**-20, atol=1e-12)


def test_nan_misses():
    for axis in range(3):
        bad = np.zeros(3)
        bad[axis] = np.nan
        assert np.isinf(run(np.array([0.0, 0.0, -5.0]) + bad, [0.0, 0.0, 1.0], np.zeros(3), 1.0))[0]
        assert np.isinf(run([0.0, 0.0, -5.0], np.array([0.0, 0.0, 1.0]) + bad, np.zeros(3), 1.0))[0]
        assert np.isinf(run([0.0, 0.0, -5.0], [0.0, 0.0, 1.0], bad, 1.0))[0]


def test_the_sign_of_zero_is_the_same_on_every_device() -> None:
    """Inside a tiny sphere both crossings are rounded to 0, the crossing behind the origin to -0."""
    t = run((5e-39, 0.0, 0.0), (2.0**64, 0.0, 0.0), (0.0, 0.0, 0.0), 1e-38)
    assert t[0] == 0.0 and not np.signbit(t[0])
