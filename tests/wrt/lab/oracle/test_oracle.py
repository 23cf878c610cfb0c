"""The oracle against rational arithmetic, ray by ray, and its error bounds against a float32 watertight test in NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest

from wrt.lab.oracle.bounds import triangle_bounds
from wrt.lab.oracle.exact import sphere_crossings, triangle_crossings
from wrt.lab.oracle.oracle import Place, Reference, closest, reference_of, sure, t_bound

Row = list[Fraction]


def fractions(row: np.ndarray) -> Row:
    return [Fraction(float(x)) for x in row]


def minus(a: Row, b: Row) -> Row:
    return [x - y for x, y in zip(a, b, strict=True)]


def times(a: Row, b: Row) -> Row:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: Row, b: Row) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def by_cramer(origin: np.ndarray, direction: np.ndarray, triangle: np.ndarray):
    """Place and (t, u, v) of one line and triangle in rational numbers, by Cramer's rule on two edges."""
    o, d = fractions(origin), fractions(direction)
    v0, v1, v2 = (fractions(v) for v in triangle)
    e1, e2, s = minus(v1, v0), minus(v2, v0), minus(o, v0)
    p, q = times(d, e2), times(s, e1)
    determinant = dot(e1, p)
    if not any(times(e1, e2)):
        return Place.DEGENERATE, None
    if determinant == 0:
        return (Place.COPLANAR if dot(times(e1, e2), s) == 0 else Place.OUTSIDE), None
    t, u, v = dot(e2, q) / determinant, dot(s, p) / determinant, dot(d, q) / determinant
    weights = (1 - u - v, u, v)
    place = Place.OUTSIDE if min(weights) < 0 else Place(Place.INSIDE + sum(w == 0 for w in weights))
    return place, (t, u, v)


def assert_exact(origin: np.ndarray, direction: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """The oracle agrees with rational numbers on all rows; returns the places."""
    found = cross(origin, direction, triangle)
    hit_only = triangle_crossings(*(np.ascontiguousarray(x.T.astype(float)) for x in (origin, direction)),
                                  tuple(np.ascontiguousarray(triangle[:, i].T.astype(float)) for i in range(3)))
    for i in range(len(origin)):
        place, numbers = by_cramer(origin[i], direction[i], triangle[i])
        assert found.place[i] == place, (i, origin[i].tolist(), direction[i].tolist(), triangle[i].tolist())
        assert hit_only.hit[i] == (Place.INSIDE <= place <= Place.VERTEX)
        if numbers is None:
            assert np.isinf(found.t[i]) and found.slope[i] == 0.0
            continue
        for value, exact, scale in zip((found.t[i], found.u[i], found.v[i]), numbers, (0, 1, 1), strict=True):
            assert abs(Fraction(float(value)) - exact) <= Fraction(1e-14) * max(abs(exact), scale)
        assert abs(Fraction(float(found.t[i])) - numbers[0]) <= Fraction(float(found.t_error[i]))
        if hit_only.hit[i]:
            assert abs(Fraction(float(hit_only.t[i])) - numbers[0]) <= Fraction(float(hit_only.t_error[i]))
            assert hit_only.t_error[i] <= 1e-14 * abs(hit_only.t[i])
    return found.place


def test_small_whole_numbers_meet_every_case() -> None:
    rng = np.random.default_rng(1)
    origin, direction = rng.integers(-2, 3, (2, 3000, 3)).astype(np.float32)
    direction[~direction.any(axis=1), 0] = 1.0
    place = assert_exact(origin, direction, rng.integers(-2, 3, (3000, 3, 3)).astype(np.float32))
    assert (np.bincount(place, minlength=6) > 30).all()


def adversarial(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """float32 rays at, or some float32 steps beside, the edges and corners of triangles of every size and proportion."""
    size = 10.0 ** rng.uniform(-12, 12, (n, 1, 1)) * 10.0 ** (rng.uniform(-6, 0, (n, 1, 3)) * (rng.random((n, 1, 3)) < 0.5))
    triangle = rng.uniform(-1, 1, (n, 3, 3)) * size + rng.normal(size=(n, 1, 3)) * 10.0 ** rng.uniform(-6, 3, (n, 1, 1)) * size
    triangle = triangle.astype(np.float32)
    weights = np.where(rng.random((n, 3)) < 0.3, 0.0, rng.dirichlet([0.3] * 3, n))
    weights[~weights.any(axis=1), 0] = 1.0
    target = np.einsum("ni,nij->nj", weights / weights.sum(axis=1, keepdims=True), triangle.astype(float))
    extent = np.abs(triangle[:, 1:] - triangle[:, :1]).max(axis=(1, 2))[:, None].astype(float)
    origin = target - rng.normal(size=(n, 3)) * extent * 10.0 ** rng.uniform(-5, 4, (n, 1))
    grid = rng.random((n, 1)) < 0.3  # on a common power of two: target - origin is then often exact
    step = 2.0 ** np.floor(np.log2(np.abs(triangle).max(axis=(1, 2))[:, None] + 1e-30) - 18)
    origin = np.where(grid, np.round(origin / step) * step, origin).astype(np.float32)
    direction = (target - origin) * np.where(rng.random((n, 1)) < 0.5, 1.0, 10.0 ** rng.uniform(-10, 10, (n, 1)))
    direction = np.where(rng.random((n, 3)) < 0.05, 0.0, direction).astype(np.float32)
    direction[~direction.any(axis=1), 0] = 1.0
    return origin, direction, triangle


def test_adversarial_lines() -> None:
    place = assert_exact(*adversarial(np.random.default_rng(2), 3000))
    assert (np.bincount(place, minlength=6)[[Place.OUTSIDE, Place.INSIDE, Place.VERTEX]] > 50).all()


def test_the_whole_range_of_float32() -> None:
    rng = np.random.default_rng(3)
    with np.errstate(under="ignore"):
        rows = np.ldexp(rng.uniform(-1, 1, (5, 1500, 3)), rng.integers(-148, 127, (5, 1500, 3))).astype(np.float32)
    rows[1, ~rows[1].any(axis=1), 0] = 1.0
    rows[4, ::3] = 0.0  # a corner at the origin of the coordinates
    rows[3, ::2] = rows[2, ::2] * np.float32(0.5)
    assert_exact(rows[0], rows[1], np.stack([rows[2], rows[3], rows[4]], axis=1))


def test_a_point_of_the_plane_that_no_float_tells_from_the_edge() -> None:
    # The ray passes the edge by 2^-60 of its length: float64 cannot see it, and the answer must not be EDGE.
    triangle = np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1]]] * 2, np.float32)
    origin = np.array([[0.25, 2.0**-60, 0], [0.25, -(2.0**-60), 0]], np.float32)
    assert cross(origin, np.array([[0, 0, 1]] * 2), triangle).place.tolist() == [Place.INSIDE, Place.OUTSIDE]
    origin[:, 1] = 0.0
    assert cross(origin, np.array([[0, 0, 1]] * 2), triangle).place.tolist() == [Place.EDGE] * 2


# --- many triangles -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Shape:
    vertices: np.ndarray
    faces: np.ndarray
    spheres: np.ndarray


def geometry_of(triangles: np.ndarray, spheres: np.ndarray | None = None) -> Shape:
    corners = np.asarray(triangles, np.float32).reshape(-1, 3)
    return Shape(corners, np.arange(len(corners)).reshape(-1, 3), np.zeros((0, 4)) if spheres is None else spheres)


def cross(origin, direction, triangles):
    """Ray i's line against triangle i."""
    return Reference(geometry_of(triangles)).against(origin, direction, np.arange(len(triangles)))[0]


def all_hits(geometry, *asked):
    return reference_of(geometry).all_hits(*asked)


def brute_force(origin, direction, triangles, t_min, t_max):
    """All hits of one ray as (t, prim_id), sorted, in rational numbers."""
    out = []
    for prim_id, triangle in enumerate(triangles):
        place, numbers = by_cramer(origin, direction, triangle)
        if Place.INSIDE <= place <= Place.VERTEX and t_min <= numbers[0] <= t_max:
            out.append((numbers[0], prim_id))
    return sorted(out)


@pytest.mark.parametrize("kind", ["whole", "soup", "coincident"])
def test_closest_and_all_hits_against_rational_numbers(kind: str) -> None:
    rng = np.random.default_rng(4)
    if kind == "soup":
        triangles = rng.uniform(-1, 1, (40, 1, 3)) + 0.5 * rng.normal(size=(40, 3, 3))
    else:
        triangles = rng.integers(-3, 4, (40, 3, 3))
    triangles = np.repeat(triangles, 2, axis=0)[rng.permutation(80)] if kind == "coincident" else triangles
    triangles = triangles.astype(np.float32)
    n = 100
    origin = rng.integers(-4, 5, (n, 3)).astype(np.float32)
    direction = (triangles[rng.integers(len(triangles), size=n), rng.integers(3, size=n)] - origin).astype(np.float32)
    direction[~direction.any(axis=1), 0] = 1.0
    t_min = rng.choice([0.0, 0.5, 1.0], n).astype(np.float32)
    t_max = rng.choice([1.0, 1.5, np.inf], n).astype(np.float32)
    geometry = geometry_of(triangles)
    hits, answer = all_hits(geometry, origin, direction, t_min, t_max), closest(geometry, origin, direction, t_min, t_max)
    ties = 0
    for i in range(n):
        end = Fraction(10) ** 60 if np.isinf(t_max[i]) else Fraction(float(t_max[i]))
        truth = brute_force(origin[i], direction[i], triangles, Fraction(float(t_min[i])), end)
        mine = hits[hits.ray == i]
        assert sorted(mine.prim_id.tolist()) == sorted(prim_id for _, prim_id in truth)
        assert (np.diff(mine.t) >= 0.0).all()
        if not truth:
            assert answer.prim_id[i] == -1 and np.isinf(answer.t[i]) and not answer.tie[i]
            continue
        assert (answer.prim_id[i], answer.t[i]) == (truth[0][1], pytest.approx(float(truth[0][0]), rel=1e-14))
        tied = [prim_id for t, prim_id in truth if t == truth[0][0]]
        assert answer.tie[i] == (len(tied) > 1)
        if len(tied) > 1:
            assert answer.ties[i].tolist() == tied
            ties += 1
    assert kind == "soup" or ties > 20


def test_the_segment_is_closed_to_the_last_bit() -> None:
    # t = 1/3 is no float: the hit is between two of them, and only a segment that has both sides of it contains it.
    geometry = geometry_of(np.array([[[-1, -1, 1], [3, -1, 1], [-1, 3, 1]]]))
    low = np.float32(1 / 3) if float(np.float32(1 / 3)) < 1 / 3 else np.nextafter(np.float32(1 / 3), np.float32(0))
    high = np.nextafter(low, np.float32(1))
    origin, direction = np.zeros((1, 3)), np.array([[0.0, 0.0, 3.0]])
    found = [len(all_hits(geometry, origin, direction, *ends)) for ends in ((0, low), (low, high), (high, 1), (0, high))]
    assert found == [0, 1, 0, 1]
    direction[0, 2] = 2.0  # t = 1/2 is one
    assert [len(all_hits(geometry, origin, direction, *ends)) for ends in ((0, 0.5), (0.5, 0.5), (0.5, 1))] == [1, 1, 1]
    step = np.nextafter(np.float32(0.5), np.float32(1))
    assert len(all_hits(geometry, origin, direction, step, 1.0)) == 0


def test_the_tree_loses_nothing() -> None:
    rng = np.random.default_rng(5)
    size = 10.0 ** rng.uniform(-6, 2, (700, 1, 1))
    triangles = rng.integers(-4, 5, (700, 1, 3)) / 2.0 + size * rng.normal(size=(700, 3, 3))
    triangles[::3] = rng.integers(-4, 5, (234, 3, 3)) / 2.0  # in the planes of other boxes
    spheres = np.concatenate([rng.integers(-2, 3, (20, 3)), rng.integers(1, 3, (20, 1)) / 2.0], axis=1)
    reference = Reference(geometry_of(triangles, spheres))
    n = 150
    origin = rng.integers(-8, 9, (n, 3)) / 2.0
    direction = np.where(rng.random((n, 3)) < 0.4, rng.choice([0.0, -0.0], (n, 3)), rng.normal(size=(n, 3)))
    direction[~direction.any(axis=1), 1] = -1.0
    hits = reference.all_hits(origin, direction)
    ray, prim_id = (x.reshape(-1) for x in np.meshgrid(np.arange(n), np.arange(700), indexing="ij"))
    found, _ = reference.against(origin[ray], direction[ray], prim_id)
    expected = {(r, p) for r, p in zip(ray[found.hit & (found.t >= 0)], prim_id[found.hit & (found.t >= 0)], strict=True)}
    on_triangle = hits.prim_id < 700
    assert {(r, p) for r, p in zip(hits.ray[on_triangle], hits.prim_id[on_triangle], strict=True)} == expected
    assert len(expected) > 1500
    ray, prim_id = (x.reshape(-1) for x in np.meshgrid(np.arange(n), np.arange(700, 720), indexing="ij"))
    balls, _, _ = reference.against_sphere(origin[ray], direction[ray], prim_id)
    crossings = (balls.hit & (balls.t[0] >= 0)).sum() + (balls.hit & (balls.t[1] >= 0) & ~balls.touching).sum()
    assert crossings == (~on_triangle).sum() > 50


def test_rays_and_triangles_that_are_not_finite_hit_nothing() -> None:
    rng = np.random.default_rng(6)
    good = np.array([[[-1, -1, 1], [3, -1, 1], [-1, 3, 1]]])
    bad = np.repeat(good, 27, axis=0).astype(float)
    for i in range(27):
        bad[i].flat[i // 3] = (np.nan, np.inf, -np.inf)[i % 3]
    geometry = geometry_of(np.concatenate([bad, good]))
    origin, direction = np.zeros((40, 3)), np.array([[0.0, 0.0, 1.0]] * 40)
    rows = np.concatenate([origin, direction], axis=1)
    rows[np.arange(18), np.arange(18) // 3] = np.tile([np.nan, np.inf, -np.inf], 6)
    rows[18, 3:] = 0.0
    rows[19:, 3:5] = 0.1 * rng.normal(size=(21, 2))
    answer = closest(geometry, rows[:, :3], rows[:, 3:])
    assert (answer.prim_id == np.where(np.arange(40) < 19, -1, 27)).all()


def test_an_empty_geometry_and_no_rays() -> None:
    nothing = geometry_of(np.zeros((0, 3, 3)))
    assert closest(nothing, np.zeros((3, 3)), np.ones((3, 3))).prim_id.tolist() == [-1] * 3
    assert len(all_hits(geometry_of(np.eye(3)[None]), np.zeros((0, 3)), np.zeros((0, 3)))) == 0


# --- spheres --------------------------------------------------------------------------------------------------------


def sphere_roots(o, d, center, radius) -> list[Decimal]:
    """Both t to 60 digits, none on a miss; the discriminant is rational."""
    f = minus(fractions(o), fractions(center))
    w, r = fractions(d), Fraction(float(radius))
    a, b, c = dot(w, w), dot(w, f), dot(f, f) - r * r
    discriminant = b * b - a * c
    if discriminant < 0:
        return []
    with localcontext() as context:
        context.prec = 400

        def decimal(x: Fraction) -> Decimal:
            return Decimal(x.numerator) / Decimal(x.denominator)

        root = decimal(discriminant).sqrt()
        return sorted([(decimal(-b) - root) / decimal(a), (decimal(-b) + root) / decimal(a)])


def test_spheres_against_400_digits() -> None:
    rng = np.random.default_rng(7)
    n = 1500
    radius = (10.0 ** rng.uniform(-6, 6, n)).astype(np.float32)
    center = (rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-6, 6, (n, 1))).astype(np.float32)
    side = rng.normal(size=(n, 3))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    reach = rng.choice([0.3, 0.999, 1.0 - 1e-7, 1.0, 1.0 + 1e-7], n)[:, None]
    along = np.cross(side, rng.normal(size=(n, 3))) * 10.0 ** rng.uniform(-4, 4, (n, 1))
    origin = (center + radius[:, None] * (side * reach + along)).astype(np.float32)
    origin[::5] = (center + radius[:, None] * side)[::5]  # on the surface
    direction = (along * 10.0 ** rng.uniform(-8, 8, (n, 1))).astype(np.float32)
    columns = [np.ascontiguousarray(x.T.astype(float)) for x in (origin, direction, center)]
    found = sphere_crossings(*columns, radius.astype(float))
    for i in range(n):
        roots = sphere_roots(origin[i], direction[i], center[i], radius[i])
        assert found.hit[i] == bool(roots)
        for t, exact in zip(found.t[:, i], roots, strict=False):
            assert abs(Decimal(float(t)) - exact) <= Decimal("1e-14") * abs(exact)
    assert 100 < found.hit.sum() < n - 100


def test_a_line_that_only_touches_a_sphere_hits_it_once() -> None:
    spheres = np.array([[0.0, 0.0, 3.0, 1.0]])
    geometry = geometry_of(np.zeros((0, 3, 3)), spheres)
    origin = np.array([[1.0, 0, 0], [np.nextafter(np.float32(1), np.float32(2)), 0, 0], [0, 0, 0], [0, 0, 3], [0, 0, 2]])
    hits = all_hits(geometry, origin, np.array([[0.0, 0.0, 2.0]] * 5))
    assert hits.ray.tolist() == [0, 2, 2, 3, 4, 4] and hits.t.tolist() == [1.5, 1.0, 2.0, 0.5, 0.0, 1.0]
    assert hits.place.tolist() == [Place.EDGE] + [Place.INSIDE] * 5
    assert closest(geometry, origin, np.array([[0.0, 0.0, 2.0]] * 5)).t.tolist() == [1.5, np.inf, 1.0, 0.5, 0.0]


# --- bounds ---------------------------------------------------------------------------------------------------------


def watertight_float32(origin: np.ndarray, direction: np.ndarray, triangle: np.ndarray):
    """Woop, Benthin and Wald 2013 in NumPy float32, areas in float64: hit, t, u, v."""
    row = np.arange(len(origin))
    kz = np.abs(direction).argmax(axis=1)
    kx, ky = (kz + 1) % 3, (kz + 2) % 3
    d_z = direction[row, kz]
    shear_x, shear_y, shear_z = direction[row, kx] / d_z, direction[row, ky] / d_z, np.float32(1) / d_z
    local = triangle - origin[:, None]
    z = local[row, :, kz]
    x = (local[row, :, kx] - shear_x[:, None] * z).astype(np.float64)
    y = (local[row, :, ky] - shear_y[:, None] * z).astype(np.float64)
    assert local.dtype == z.dtype == shear_z.dtype == np.float32
    w = np.stack([x[:, (i + 2) % 3] * y[:, (i + 1) % 3] - y[:, (i + 2) % 3] * x[:, (i + 1) % 3] for i in range(3)], axis=1)
    area = w.sum(axis=1)
    hit = ((w >= 0).all(axis=1) | (w <= 0).all(axis=1)) & (area != 0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t, u, v = ((w * z).sum(axis=1) / area * shear_z).astype(np.float32), w[:, 1] / area, w[:, 2] / area
    return hit, t, u.astype(np.float32), v.astype(np.float32)


def test_bounds_hold_for_the_watertight_test_and_are_not_idle() -> None:
    worst = np.zeros(3)
    for seed in range(3):
        origin, direction, triangle = adversarial(np.random.default_rng(seed), 30_000)
        o, d = (np.ascontiguousarray(x.T.astype(float)) for x in (origin, direction))
        v = tuple(np.ascontiguousarray(triangle[:, i].T.astype(float)) for i in range(3))
        exact = triangle_crossings(o, d, v, all_rows=True)
        bound = triangle_bounds(o, d, v, exact)
        hit, *said = watertight_float32(origin, direction, triangle)
        assert bound.touches[hit].all() and bound.touches[exact.hit].all()
        assert hit[sure(exact, bound)].all()
        known = hit & (exact.slope != 0.0)
        assert known.sum() > 8000 and (sure(exact, bound) & hit).sum() > 3000 and (~bound.touches).sum() > 1000
        np.testing.assert_array_equal(t_bound(origin, direction, triangle), bound.t)
        for k, name in enumerate("tuv"):
            error = np.abs(said[k].astype(float) - getattr(exact, name))[known]
            limit = getattr(bound, name)[known]
            assert (error <= limit).all()
            worst[k] = max(worst[k], (error / limit).max())
    assert (worst > 0.25).all()  # a bound four times tighter would fail


def test_nothing_is_promised_where_differences_overflow_or_in_the_plane() -> None:
    triangle = np.array([[[-1, -1, 1], [3, -1, 1], [-1, 3, 1]]])
    assert np.isinf(t_bound([[0, 0, -3e38]], [[0, 0, 1]], triangle + [0, 0, 3e38])).all()
    assert t_bound([[0, 0, 0]], [[0, 0, 1e-41]], 1e-5 * triangle)[0] < 1e31  # t is 1e36
    assert t_bound([[0, 0, 0]], [[0, 0, 1.0]], triangle)[0] < 1e-5
    assert np.isinf(t_bound([[0, 0, 1]], [[1, 1, 0]], triangle)).all()  # in the plane
