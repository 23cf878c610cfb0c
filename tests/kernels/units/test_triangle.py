"""The triangle test against float64, and the properties that keep rays from leaking through a mesh."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernel_tools import DEVICE, directions, launch, rounded, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.geometry import LAYOUTS, Geometry
from wrt.accel.scenes.build import build
from wrt.kernels.structs import NO_HIT, Hit, Primitive, Ray, kernel
from wrt.kernels.units.box import box_ray
from wrt.kernels.units.triangle import RAY_TRIANGLE, crossing, ray_triangle, sure_crossing, to_ray_space, triangle_ray, watertight

# Published numbers of pbrt-v4, shapes_test, Triangle.BadCases: three collinear points, and a ray that must miss.
BAD_TRIANGLE = [[-1113.45459, -79.049614, -56.2431908], [-1113.45459, -87.0922699, -56.2431908],
                [-1113.45459, -79.2090149, -56.2431908]]
BAD_ORIGIN, BAD_DIRECTION = [-1081.47925, 99.9999542, 87.7701111], [-32.1072998, -183.355865, -144.607635]


@kernel
def triangle_kernel(
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    v0: wp.array(dtype=wp.vec3),
    v1: wp.array(dtype=wp.vec3),
    v2: wp.array(dtype=wp.vec3),
    line: wp.array(dtype=Hit),
    unit: wp.array(dtype=Hit),
):
    """Store the hits of the watertight test, and of the unit, which also clamps t to the triangle's box."""
    i = wp.tid()
    ray = Ray()
    ray.origin = origin[i]
    ray.direction = direction[i]
    shear = triangle_ray(ray)
    line[i] = watertight(ray.origin, shear, v0[i], v1[i], v2[i])
    unit[i] = ray_triangle(box_ray(ray), shear, v0[i], v1[i], v2[i])


def run(origin, direction, triangle, which="unit"):
    """Return the hits as a structured array of t, u, v, prim_id. `triangle` is (N, 3, 3) or (3, 3)."""
    origin, direction = (np.asarray(a, np.float32).reshape(-1, 3) for a in (origin, direction))
    triangle = np.asarray(triangle, np.float32).reshape(-1, 3, 3)
    n = max(len(origin), len(direction), len(triangle))
    record = np.zeros(len(triangle), dtype=Primitive.numpy_dtype())
    LAYOUTS["corners"](record, *(np.ascontiguousarray(triangle[:, i]) for i in range(3)))
    rows = [np.broadcast_to(a, (n, 3)) for a in (origin, direction, record["v0"], record["v1"], record["v2"])]
    line, unit = zeros(n, Hit), zeros(n, Hit)
    launch(triangle_kernel, n, *(vec3s(a) for a in rows), line, unit)
    return (unit if which == "unit" else line).numpy()


def is_hit(hits):
    return hits["prim_id"] != int(NO_HIT)


def exact(origin, direction, triangle):
    """Return t, u, v (N,) of the line and the triangle's plane in float64, by Cramer's rule (Moeller and Trumbore 1997)."""
    v0, v1, v2 = (np.asarray(triangle)[:, i] for i in range(3))
    e1, e2, s = v1 - v0, v2 - v0, np.asarray(origin) - v0
    p, q = np.cross(direction, e2), np.cross(s, e1)
    det = (e1 * p).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (e2 * q).sum(axis=1) / det, (s * p).sum(axis=1) / det, (direction * q).sum(axis=1) / det


def exact_fraction(origin, direction, triangle):
    """Return t, u, v of one ray in rational arithmetic, or None if the ray is parallel to the plane."""
    o, d = ([Fraction(float(x)) for x in row] for row in (origin, direction))
    v0, v1, v2 = ([Fraction(float(x)) for x in row] for row in triangle)

    def cross(a, b):
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    def minus(a, b):
        return [x - y for x, y in zip(a, b, strict=True)]

    def dot(a, b):
        return sum(x * y for x, y in zip(a, b, strict=True))

    e1, e2, s = minus(v1, v0), minus(v2, v0), minus(o, v0)
    p, q = cross(d, e2), cross(s, e1)
    det = dot(e1, p)
    return None if det == 0 else (dot(e2, q) / det, dot(s, p) / det, dot(d, q) / det)


def aimed_rays(rng, n, spread=0.4):
    """Return rays aimed at points in and around triangles of size about 1, from at least 0.2 off the triangles' planes."""
    triangle = rounded(rng.normal(size=(n, 3, 3)) + 3.0 * rng.normal(size=(n, 1, 3)))
    w = rng.normal(1.0 / 3.0, spread, (n, 2))
    target = triangle[:, 0] + w[:, :1] * (triangle[:, 1] - triangle[:, 0]) + w[:, 1:] * (triangle[:, 2] - triangle[:, 0])
    direction = rounded(rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-1, 1, (n, 1)))
    origin = rounded(target - direction * rng.uniform(0.5, 4.0, (n, 1)))
    normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    area = np.linalg.norm(normal, axis=1)
    slope = np.abs((normal * direction).sum(axis=1)) / (area * np.linalg.norm(direction, axis=1))
    keep = (slope > 0.2) & (area > 0.3)
    return origin[keep], direction[keep], triangle[keep]


def test_t_and_barycentrics_against_float64():
    origin, direction, triangle = aimed_rays(np.random.default_rng(1), 20_000)
    hits = run(origin, direction, triangle)
    t, u, v = exact(origin, direction, triangle)
    margin = np.minimum(np.minimum(u, v), 1.0 - u - v)
    assert is_hit(hits)[margin > 1e-4].all()
    assert not is_hit(hits)[margin < -1e-4].any()
    assert (margin > 1e-4).sum() > 2000 and (margin < -1e-4).sum() > 2000
    on = is_hit(hits)
    # Coordinates are at most some tens and slopes above 0.2. They bound the effect of the rounding of the ray on its point.
    bound = 2.0**-24 * 40.0 * (1.0 + np.abs(origin).max(axis=1) + np.abs(triangle).max(axis=(1, 2)))[on]
    assert (np.abs(hits["t"] - t)[on] * np.linalg.norm(direction, axis=1)[on] <= bound).all()
    assert (np.abs(hits["u"] - u)[on] <= bound * 5.0).all() and (np.abs(hits["v"] - v)[on] <= bound * 5.0).all()
    point = (1.0 - hits["u"] - hits["v"])[:, None] * triangle[:, 0] + hits["u"][:, None] * triangle[:, 1]
    point += hits["v"][:, None] * triangle[:, 2]
    assert np.abs(point - origin - t[:, None] * direction)[on].max() < 1e-4


def test_both_sides_and_every_order_of_the_corners_agree():
    rng = np.random.default_rng(2)
    n = 40_000
    triangle = rounded(rng.normal(size=(n, 3, 3)) * 10.0 ** rng.uniform(-3, 3, (n, 1, 3)))
    w = rng.dirichlet([0.4, 0.4, 0.4], n)
    w = np.where(rng.random((n, 3)) < 0.25, 0.0, w)  # Many points are on edges and at corners.
    w = np.where(w.sum(axis=1, keepdims=True) > 0.0, w, [1.0, 0.0, 0.0])
    target = np.einsum("ni,nij->nj", w / w.sum(axis=1, keepdims=True), triangle)
    direction = directions(rng, n)
    origin = rounded(target - direction * 10.0 ** rng.uniform(-2, 2, (n, 1)))
    reference = run(origin, direction, triangle)
    hit = is_hit(reference)
    assert 0.2 * n < hit.sum() < 0.95 * n
    for order in ([1, 2, 0], [2, 0, 1], [0, 2, 1], [1, 0, 2], [2, 1, 0]):
        hits = run(origin, direction, triangle[:, order])
        assert np.array_equal(is_hit(hits), hit), order
        close = np.isclose(hits["t"][hit], reference["t"][hit], rtol=1e-6, atol=0.0)
        assert close.all()


def test_no_ray_between_two_triangles_with_a_common_edge():
    rng = np.random.default_rng(3)
    n = 200_000
    scale = 10.0 ** rng.uniform(-2, 3, (n, 1, 3)) * np.where(rng.random((n, 1, 3)) < 0.2, 0.0, 1.0)
    edge = rounded(rng.normal(size=(n, 2, 3)) * scale)
    direction = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-4, 0, (n, 3))
    direction = rounded(np.where(rng.random((n, 3)) < 0.1, 0.0, direction))
    direction[~direction.any(axis=1), 2] = 1.0
    along = rng.uniform(0.05, 0.95, (n, 1))
    target = edge[:, 0] + along * (edge[:, 1] - edge[:, 0])
    origin = rounded(target - direction * 10.0 ** rng.uniform(-3, 2, (n, 1)))
    # The other two corners are on opposite sides of the plane through ray and edge, so far away that the triangles cover the ray.
    side = np.cross(edge[:, 1] - edge[:, 0], direction)
    length = np.linalg.norm(side, axis=1, keepdims=True)
    extent = np.linalg.norm(edge[:, 1] - edge[:, 0], axis=1, keepdims=True)
    side = np.divide(side, length, out=np.zeros_like(side), where=length > 0.0)
    wobble = 0.3 * rng.normal(size=(2, n, 3)) * extent
    c, d = (rounded(edge.mean(axis=1) + sign * side * extent + w - (w * side).sum(axis=1, keepdims=True) * side)
            for sign, w in zip((1.0, -1.0), wobble, strict=True))
    ok = (length > 1e-3 * extent * np.linalg.norm(direction, axis=1, keepdims=True))[:, 0]
    first = run(origin, direction, np.stack([edge[:, 0], edge[:, 1], c], axis=1))
    second = run(origin, direction, np.stack([edge[:, 1], edge[:, 0], d], axis=1))
    lost = ok & ~is_hit(first) & ~is_hit(second)
    assert ok.sum() > 0.5 * n
    assert not lost.any(), (origin[lost][0], direction[lost][0], edge[lost][0], c[lost][0], d[lost][0])


def adversarial_hits(rng, n):
    """Return triangles of extreme proportions, flat in some axes, and rays aimed at their edges from very near and far."""
    scale = 10.0 ** rng.uniform(-4, 4, (n, 1, 3)) * np.where(rng.random((n, 1, 3)) < 0.3, 0.0, 1.0)
    triangle = rng.uniform(-1.0, 1.0, (n, 3, 3)) * scale
    same = rng.random((n, 1, 3)) < 0.3
    triangle[:, 1:2] = np.where(same, triangle[:, :1], triangle[:, 1:2])
    triangle = np.where(rng.random((n, 1, 3)) < 0.3, np.round(triangle), triangle)
    moved = 10.0 ** rng.uniform(-3, 5, (n, 1, 1)) * rng.normal(size=(n, 1, 3))
    triangle = rounded(triangle + np.where(rng.random((n, 1, 1)) < 0.5, 0.0, moved))
    w = np.where(rng.random((n, 3)) < 0.3, 0.0, rng.dirichlet([0.3, 0.3, 0.3], n))
    w = np.where(w.sum(axis=1, keepdims=True) > 0.0, w, [1.0, 0.0, 0.0])
    target = np.einsum("ni,nij->nj", w / w.sum(axis=1, keepdims=True), triangle)
    extent = np.abs(triangle[:, 1:] - triangle[:, :1]).max(axis=(1, 2))[:, None]
    target += rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-9, -3, (n, 1)) * extent * (rng.random((n, 1)) < 0.7)
    direction = rng.normal(size=(n, 3)) * 10.0 ** (rng.uniform(-6, 0, (n, 3)) * (rng.random((n, 3)) < 0.5))
    direction = np.where(rng.random((n, 3)) < 0.1, 0.0, direction)
    direction[~direction.any(axis=1), 0] = 1.0
    origin = target - direction * extent * 10.0 ** rng.uniform(-6, 3, (n, 1))
    return rounded(origin), rounded(direction), triangle


def test_a_hit_is_never_outside_the_triangles_padded_box():
    # Otherwise traversal may cull the box of the only triangle that a ray near an edge hits, and the ray leaks.
    for seed in range(4):
        rays = adversarial_hits(np.random.default_rng(seed), 200_000)
        line, unit = run(*rays, which="line"), run(*rays)
        promised = is_hit(line) & (line["t"] >= 0.0)
        assert promised.sum() > 20_000
        assert is_hit(unit)[promised].all()
        assert (is_hit(line) | ~is_hit(unit)).all()


def test_t_when_seen_nearly_edge_on():
    # A floor 2000 wide, seen from a height of 1e-6: the areas cancel to a millionth, but t must stay accurate.
    rng = np.random.default_rng(4)
    n = 20_000
    floor = np.array([[-1000.0, 0.0, -1000.0], [1000.0, 0.0, -1000.0], [0.0, 0.0, 1000.0]])
    direction = np.stack([rng.uniform(-0.5, 0.5, n), -(10.0 ** rng.uniform(-5, -1, n)), np.ones(n)], axis=1)
    origin = np.stack([rng.uniform(-5, 5, n), 10.0 ** rng.uniform(-6, -1, n), rng.uniform(-5, 5, n)], axis=1)
    origin, direction = rounded(origin), rounded(direction)
    hits = run(origin, direction, floor)
    t = -origin[:, 1] / direction[:, 1]
    inside = np.abs(origin + t[:, None] * direction).max(axis=1) < 300.0
    assert inside.sum() > 5000 and is_hit(hits)[inside].all()
    assert np.abs(hits["t"][inside] / t[inside] - 1.0).max() < 1e-6
    tilted = floor @ np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    o, d = (rounded(a @ np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])) for a in (origin, direction))
    expected = exact(o, d, np.broadcast_to(rounded(tilted), (n, 3, 3)))[0]
    line = run(o, d, tilted)
    slope = np.abs(direction[:, 1])
    seen = inside & is_hit(line) & (expected > 0.0)
    # The rounding of sheared corners moves the plane by a few u of its size: 2000 u / slope along the ray.
    assert (np.abs(line["t"] - expected)[seen] <= 16.0 * 2000.0 * 2.0**-24 / slope[seen]).all()


@settings(max_examples=60, deadline=None)
@given(power=st.integers(-100, 100), seed=st.integers(0, 2**32 - 1))
def test_nothing_depends_on_the_scale(power, seed):
    origin, direction, triangle = aimed_rays(np.random.default_rng(seed), 300, spread=0.2)
    scale = 2.0**power
    reference = run(origin, direction, triangle)
    scaled = run(origin * scale, direction, triangle * scale)
    assert np.array_equal(is_hit(scaled), is_hit(reference))
    hit = is_hit(reference)
    assert np.array_equal(scaled["t"][hit], (reference["t"][hit] * np.float64(scale)).astype(np.float32))
    assert np.array_equal(scaled["u"][hit], reference["u"][hit]) and np.array_equal(scaled["v"][hit], reference["v"][hit])
    longer = run(origin, direction * scale, triangle)
    assert np.array_equal(is_hit(longer), hit)
    assert np.array_equal((longer["t"][hit] * np.float64(scale)).astype(np.float32), reference["t"][hit])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), order=st.permutations(range(3)))
def test_any_order_of_the_corners_gives_the_same_decision_and_point(seed, order):
    # Decisions agree to the last bit: a new order permutes the areas and may negate all of them. Only the sum of t has another order.
    origin, direction, triangle = adversarial_hits(np.random.default_rng(seed), 2000)
    reference, turned = run(origin, direction, triangle, which="line"), run(origin, direction, triangle[:, order], which="line")
    hit = is_hit(reference)
    assert hit.sum() > 200 and np.array_equal(is_hit(turned), hit)
    names = ("w", "u", "v")
    weights = {"u": reference["u"][hit], "v": reference["v"][hit]}
    for place, corner in enumerate(order):
        if place and corner:
            assert np.allclose(turned[names[place]][hit], weights[names[corner]], rtol=2.0**-22, atol=1e-30)
    size = np.abs(triangle - origin[:, None]).max(axis=(1, 2)) / np.abs(direction).max(axis=1)
    assert (np.abs(turned["t"][hit] - reference["t"][hit]) <= 2.0**-22 * size[hit]).all()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), power=st.integers(-8, 8), step=st.tuples(*[st.integers(-64, 64)] * 3))
def test_moving_everything_by_powers_of_two_changes_no_bit(seed, power, step):
    # Corners, origins and displacements are integers up to 2^12. No sum is rounded, so that no bit may change.
    rng = np.random.default_rng(seed)
    triangle, target = rng.integers(-2048, 2049, (500, 3, 3)), rng.integers(-2048, 2049, (500, 3))
    direction = rng.integers(-512, 513, (500, 3))
    direction[~direction.any(axis=1), 0] = 1
    origin = target - direction
    scale, moved = 2.0**power, np.array(step) * 64.0
    reference = run(origin * scale, direction, triangle * scale)
    shifted = run((origin + moved) * scale, direction, (triangle + moved) * scale)
    # Only t may change, as it is clamped to the padded box, whose padding depends on the position: this happens only at edges.
    line, other = (run(o * scale, direction, v * scale, which="line")
                   for o, v in ((origin, triangle), (origin + moved, triangle + moved)))
    assert np.array_equal(line, other) and np.array_equal(is_hit(shifted), is_hit(reference))
    assert np.array_equal(shifted["t"], reference["t"])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_neighbours_see_their_edge_from_both_sides(seed):
    # Two triangles share an edge. The areas of a ray at the edge are exact negatives in the two triangles. So the order of the
    # triangles does not decide which triangle is hit, and a ray at the edge, within the width of both, hits one.
    rng = np.random.default_rng(seed)
    n = 2000
    edge = rounded(rng.normal(size=(n, 2, 3)) * 10.0 ** rng.uniform(-3, 3, (n, 1, 1)) + rng.normal(size=(n, 1, 3)))
    direction = directions(rng, n)
    across = np.cross(edge[:, 1] - edge[:, 0], direction)
    middle = edge.mean(axis=1)
    c, d = (rounded(middle + sign * across + rng.uniform(-0.4, 0.4, (n, 3)) * np.linalg.norm(across, axis=1, keepdims=True))
            for sign in (1.0, -1.0))
    target = edge[:, 0] + rng.uniform(0.3, 0.7, (n, 1)) * (edge[:, 1] - edge[:, 0])
    origin = rounded(target - direction * 10.0 ** rng.uniform(-2, 2, (n, 1)))
    first = is_hit(run(origin, direction, np.stack([edge[:, 0], edge[:, 1], c], axis=1), which="line"))
    exchanged = is_hit(run(origin, direction, np.stack([edge[:, 1], edge[:, 0], c], axis=1), which="line"))
    second = is_hit(run(origin, direction, np.stack([edge[:, 1], edge[:, 0], d], axis=1), which="line"))
    wide = np.linalg.norm(across, axis=1) > 1e-2 * np.linalg.norm(edge[:, 1] - edge[:, 0], axis=1)
    assert np.array_equal(first, exchanged)
    assert (first | second)[wide].all() and wide.sum() > 1000 and 500 < first.sum() < 1500


def test_edge_on_is_a_miss():
    triangle = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    rng = np.random.default_rng(6)
    direction = rng.normal(size=(500, 3))
    direction[:, 1] = 0.0
    origin = np.array([0.5, 0.0, 0.5]) - 3.0 * direction
    origin[:, 1] = 0.0
    assert not is_hit(run(origin, direction, triangle)).any()


def test_triangles_without_area_are_missed():
    rng = np.random.default_rng(7)
    n = 3000
    a, b = rng.normal(size=(2, n, 3))
    direction = rng.normal(size=(n, 3))
    point = np.stack([a, a, a], axis=1)
    assert not is_hit(run(a - direction, direction, point)).any()
    for order in ([0, 0, 1], [0, 1, 0], [1, 0, 0]):  # Two corners are equal.
        needle = np.stack([a, b], axis=1)[:, order]
        middle = 0.5 * (a + b)
        assert not is_hit(run(middle - direction, direction, needle)).any()
    for axis in range(3):  # Three points on a line along an axis.
        line = np.repeat(a[:, None], 3, axis=1)
        line[:, :, axis] = rng.normal(size=(n, 3))
        target = line[:, 0] + rng.random((n, 1)) * (line[:, 1] - line[:, 0])
        assert not is_hit(run(target - direction, direction, line)).any()


@pytest.mark.parametrize(("origin", "direction", "triangle", "t"), [
    # The ray starts in a face of the triangle's box, and its x changes by less than float32 resolves. The sheared corners do not show
    # this change, while the slab of x ends at the ray's origin.
    ((0.0, 3.6090652682815795e-20, 3.338891601232995e-20), (-2.652004651570872e-37, 0.0, 0.29204800724983215),
     ((-2e-20, 1e-20, -3e-20), (0.0, 4e-20, -3e-20), (0.0, 3e-20, 4e-20)), -1.23e-19),
    ((0.0, 3.6090652682815795e-20, -2.5e-20), (2.652004651570872e-37, 0.0, 0.29204800724983215),
     ((-2e-20, 1e-20, -3e-20), (0.0, 4e-20, -3e-20), (0.0, 3e-20, 4e-20)), 7.66e-20),
    ((0.0, 0.0, 0.0), (4e-39, 0.0, 1.0), ((-1.0, -1.0, 1e-7), (0.0, -1.0, 1.2e-7), (0.0, 1.0, -1e-7)), 1e-8),
    ((0.0, 0.0, 0.0), (4e-39, 0.0, 1.0), ((-1.0, -1.0, 1e-7), (0.0, -1.0, 1e-7), (0.0, 1.0, 1e-7)), 1e-7),
    # The shear itself underflows.
    ((0.0, 0.0, 1.5), (1e-38, 0.0, 1e18), ((-1.0, -1.0, 2.0), (0.0, -1.0, 4.0), (0.0, 1.0, 1.0)), 1e-18),
    ((0.0, 0.0, 3.5), (-1e-38, 0.0, 1e18), ((-1.0, -1.0, 2.0), (0.0, -1.0, 4.0), (0.0, 1.0, 1.0)), -1e-18),
])
def test_t_where_the_shear_underflows(origin, direction, triangle, t):
    for axes in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):  # The same case along every axis.
        hit = run(np.array(origin)[axes], np.array(direction)[axes], np.array(triangle)[:, axes])
        assert is_hit(hit).all() and np.allclose(hit["t"], t, rtol=5e-3, atol=0.0)


def test_published_collinear_triangle_is_missed():
    assert not is_hit(run(BAD_ORIGIN, BAD_DIRECTION, BAD_TRIANGLE)).any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_coordinates_that_are_not_finite_miss(bad):
    triangle = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    origin, direction = np.array([0.0, 0.0, -1.0]), np.array([0.01, 0.02, 1.0])
    assert is_hit(run(origin, direction, triangle)).all()
    for corner in range(3):
        for axis in range(3):
            broken = triangle.copy()
            broken[corner, axis] = bad
            hit = run(origin, direction, broken)
            assert not is_hit(hit).any() or np.isfinite(hit["t"]).all()
            if np.isnan(bad):
                assert not is_hit(hit).any()
    if np.isnan(bad):
        for axis in range(3):
            o, d = origin.copy(), direction.copy()
            o[axis], d[axis] = bad, bad
            assert not is_hit(run(o, direction, triangle)).any()
            assert not is_hit(run(origin, d, triangle)).any()


def test_decisions_on_exact_coordinates_are_exact():
    # With small integers and a direction along z nothing is rounded: even rays at edges and corners are decided exactly.
    rng = np.random.default_rng(8)
    n = 4000
    triangle = rng.integers(-4, 5, (n, 3, 3)).astype(float)
    origin = np.concatenate([rng.integers(-4, 5, (n, 2)), np.full((n, 1), -16.0)], axis=1).astype(float)
    direction = np.array([0.0, 0.0, 1.0])
    hits = run(origin, direction, triangle)
    on_edge = 0
    for i in range(n):
        solution = exact_fraction(origin[i], direction, triangle[i])
        expected = solution is not None and min(solution[1], solution[2], 1 - solution[1] - solution[2]) >= 0
        assert is_hit(hits[i : i + 1])[0] == expected, (origin[i], triangle[i])
        if expected:
            on_edge += min(solution[1], solution[2], 1 - solution[1] - solution[2]) == 0
            assert abs(hits["t"][i] - float(solution[0])) <= 2.0**-23 * 20.0
            assert abs(hits["u"][i] - float(solution[1])) <= 2.0**-24
    assert on_edge > 200


@kernel
def products_kernel(m: wp.array(dtype=wp.vec4), forth: wp.array(dtype=wp.float32), back: wp.array(dtype=wp.float32)):
    i = wp.tid()
    forth[i] = m[i][0] * m[i][1] - m[i][2] * m[i][3]
    back[i] = m[i][2] * m[i][3] - m[i][0] * m[i][1]


def test_kernels_are_compiled_without_fused_multiply_add():
    # Each product must be rounded by itself: the areas that two triangles compute at their common edge must be exact negatives.
    # The difference of two nearly equal products shows a fused multiply-add.
    rng = np.random.default_rng(9)
    m = rng.normal(size=(20_000, 4)).astype(np.float32)
    m[:, 3] = m[:, 0] * m[:, 1] / m[:, 2]
    assert products_kernel.module.options["fuse_fp"] is False  # On a CPU without the instruction, only the option shows it.
    forth, back = zeros(len(m)), zeros(len(m))
    launch(products_kernel, len(m), wp.array(m, dtype=wp.vec4, device=DEVICE), forth, back)
    assert np.array_equal(forth.numpy(), -back.numpy())
    assert np.array_equal(forth.numpy(), m[:, 0] * m[:, 1] - m[:, 2] * m[:, 3])


# --- without float64 --------------------------------------------------------------------------------------------------


@kernel
def crossings_kernel(
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    v0: wp.array(dtype=wp.vec3),
    v1: wp.array(dtype=wp.vec3),
    v2: wp.array(dtype=wp.vec3),
    sure: wp.array(dtype=Hit),
    exact: wp.array(dtype=Hit),
):
    i = wp.tid()
    ray = Ray()
    ray.direction = direction[i]
    shear = triangle_ray(ray)
    a = to_ray_space(v0[i] - origin[i], shear)
    b = to_ray_space(v1[i] - origin[i], shear)
    c = to_ray_space(v2[i] - origin[i], shear)
    sure[i] = sure_crossing(a, b, c, shear.shear_z)
    exact[i] = crossing(a, b, c, shear.shear_z)


def without_float64(origin, direction, triangle):
    """Return the mask (N,) of hits that float-float arithmetic is certain of, and all hits. Certain hits have float64's bits."""
    n = len(origin)
    sure, exact = zeros(n, Hit), zeros(n, Hit)
    triangle = np.asarray(triangle, np.float32)
    launch(crossings_kernel, n, *(vec3s(a) for a in (origin, direction, *(triangle[:, i] for i in range(3)))), sure, exact)
    sure, exact = sure.numpy(), exact.numpy()
    told = is_hit(sure)
    assert sure[told].tobytes() == exact[told].tobytes()
    return told, is_hit(exact)


def test_float_float_arithmetic_is_certain_but_for_hard_cases():
    told, hit = without_float64(*aimed_rays(np.random.default_rng(13), 200_000, spread=0.2))
    assert hit.sum() > 50_000 and 0 < (hit & ~told).sum() < 1e-3 * hit.sum()


@pytest.mark.parametrize("seed", range(3))
def test_certain_float_float_hits_have_the_bits_of_float64(seed):
    """The triangles have extreme proportions. Rays have all lengths and scales, so that many values underflow or overflow."""
    origin, direction, triangle = adversarial_hits(np.random.default_rng(seed), 200_000)
    told, hit = without_float64(origin, direction, triangle)
    assert 20_000 < told.sum() < hit.sum() - 10_000
    rng = np.random.default_rng(seed)
    for exponents in ((-60, 60), (-120, 120)):
        scale, length = np.exp2(rng.integers(*exponents, (2, len(origin), 1)))
        with np.errstate(over="ignore"):
            turned = rounded(direction * np.clip(length, 2.0**-60, 2.0**60))
            given = rounded(origin * scale), turned, rounded(triangle * scale[:, None])
        assert without_float64(*given)[0].sum() > 5000


@pytest.mark.parametrize("large", range(3))
@pytest.mark.parametrize("swap", [False, True])
def test_float_float_arithmetic_is_not_certain_beside_a_midpoint(large, swap):
    """One product of coordinates is 2^25 times as large as all others, so that an area over the sum of all is 1 - 2^-25, less than
    u^2 from the midpoint of two float32. It is u or v and, by the choice of z, also t."""
    rng = np.random.default_rng(14)
    exponent = rng.choice([-10.0, 10.0], 1000)
    x, y = rounded(rng.uniform(1.0, 2.0, (2, 1000)) * np.exp2([exponent, -exponent]))
    part = rng.uniform(0.5, 1.5, 1000)
    triangle = np.zeros((1000, 3, 3))
    triangle[:, large] = np.stack([(part - 2.0) * x, -part * y, np.full(1000, 2.0**26 - 2.0)], axis=1) / (2.0**26 - 2.0)
    triangle[:, (large + 1) % 3, 1], triangle[:, (large + 2) % 3, 0] = y, x
    triangle = triangle[..., [1, 0, 2]] if swap else triangle
    told, hit = without_float64(np.zeros((1000, 3)), np.broadcast_to([0.0, 0.0, 1.0], (1000, 3)), triangle)
    assert hit.all() and not told.any()


def test_rays_through_an_edge_or_from_the_plane_are_hard_cases():
    square = np.array([[-1.0, -1.0, 0.0], [3.0, -1.0, 0.0], [-1.0, 3.0, 0.0]])
    origin = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])
    told, hit = without_float64(origin, np.broadcast_to([0.0, 0.0, -1.0], (4, 3)), np.broadcast_to(square, (4, 3, 3)))
    assert told.tolist() == [True, False, False, False] and hit.tolist()[:3] == [True, True, True]


# --- every test in the table ------------------------------------------------------------------------------------------


def closest(test, origin, direction, triangle):
    """Return the closest hit of each ray among the triangles, by the test with the name `test`."""
    n = len(triangle)
    geometry = Geometry(np.asarray(triangle, np.float32).reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3),
                        np.zeros((0, 4), np.float32))
    return build(geometry, "brute_force", triangle=test).closest_hit(origin, direction)


def test_every_test_names_a_layout():
    assert {test.layout for test in RAY_TRIANGLE.values()} == set(LAYOUTS) and next(iter(RAY_TRIANGLE)) == "watertight"


@pytest.mark.parametrize("test", RAY_TRIANGLE)
def test_every_test_agrees_with_float64_on_sound_triangles(test):
    origin, direction, triangle = aimed_rays(np.random.default_rng(10), 3000)
    for i in range(60):
        hits = closest(test, origin, direction, triangle[i : i + 1])
        t, u, v = exact(origin, direction, np.broadcast_to(triangle[i], (len(origin), 3, 3)))
        corner = triangle[i]
        normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
        slope = np.abs(direction @ normal) / (np.linalg.norm(normal) * np.linalg.norm(direction, axis=1))
        margin = np.minimum(np.minimum(u, v), 1.0 - u - v)
        sound = (slope > 0.2) & (np.abs(margin) > 1e-3)
        hit = hits.prim_id == 0
        assert np.array_equal(hit[sound], ((margin > 0.0) & (t >= 0.0))[sound])
        on = hit & sound
        assert np.allclose(hits.t[on], t[on], rtol=1e-4, atol=1e-4 / np.linalg.norm(direction[on], axis=1).min(initial=1.0))
        assert np.allclose(hits.u[on], u[on], atol=5e-4) and np.allclose(hits.v[on], v[on], atol=5e-4)
        assert (~on | (hits.u + hits.v <= 1.0 + 1e-6)).all()


@pytest.mark.parametrize("test", RAY_TRIANGLE)
def test_every_test_hits_edges_and_corners_where_nothing_is_rounded(test):
    # u or v is exactly 0, or their sum exactly 1.
    x, y = (a.reshape(-1) for a in np.mgrid[-1:6, -1:6])
    origin = np.stack([x, y, 2 + 0 * x], axis=1)
    hits = closest(test, origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape), [[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]]])
    assert np.array_equal(hits.prim_id == 0, (x >= 0) & (y >= 0) & (x + y <= 4))


@pytest.mark.parametrize("test", RAY_TRIANGLE)
def test_every_test_misses_triangles_without_area_and_behind(test):
    rng = np.random.default_rng(11)
    a, b = rounded(rng.normal(size=(2, 3)))
    direction = rounded(rng.normal(size=(500, 3)))
    # The determinant of a needle is rounding noise, not 0, in Moeller and Trumbore's test. So that test hits some needles.
    needles = ([a, a, b], [a, b, a], [b, a, a]) if test != "moeller_trumbore" else ()
    for triangle in ([a, a, a], *needles):
        for target in (a, 0.5 * (a + b)):
            assert (closest(test, target - direction, direction, [triangle]).prim_id == -1).all()
    square = np.array([[-1.0, -1.0, 0.0], [3.0, -1.0, 0.0], [-1.0, 3.0, 0.0]])
    hits = closest(test, [[0.0, 0.0, 2.0]] * 2, [[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]], [square])
    assert hits.prim_id.tolist() == [0, -1] and hits.t[0] == 4.0
    parallel = closest(test, [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [[1.0, 0.5, 0.0]] * 2, [square])
    assert (parallel.prim_id == -1).all()


@pytest.mark.parametrize("test", RAY_TRIANGLE)
def test_every_test_answers_the_same_from_every_structure(test):
    rng = np.random.default_rng(12)
    corners = rng.uniform(-1.0, 1.0, (300, 1, 3)) + 0.3 * rng.normal(size=(300, 3, 3))
    geometry = Geometry(corners.reshape(-1, 3).astype(np.float32), np.arange(900, dtype=np.int32).reshape(-1, 3),
                        np.zeros((0, 4), np.float32))
    origin = rounded(3.0 * rng.normal(size=(20_000, 3)))
    direction = rounded(rng.uniform(-1.0, 1.0, (20_000, 3)) - origin)
    brute, tree = (build(geometry, name, triangle=test).closest_hit(origin, direction) for name in ("brute_force", "bvh"))
    differ = brute.prim_id != tree.prim_id
    # Only the default test promises the same bits from every structure: the t of other tests may lie before the triangle's box.
    assert differ.mean() <= (0.0 if test == "watertight" else 1e-3)
    same = ~differ & (brute.prim_id >= 0)
    assert same.sum() > 5000 and np.array_equal(brute.t[same], tree.t[same])
