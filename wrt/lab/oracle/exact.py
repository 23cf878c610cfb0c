"""Exact crossings of lines with triangles and spheres.

Inputs are float32 values in float64: integers times powers of two. The sign of a float64 result is accepted if the result exceeds a
bound on its error. This is a static filter (Shewchuk 1997, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric
Predicates"). The few other signs are recomputed in Python's integers. A product of three float32 neither over- nor underflows in float64.

For a triangle with corners v0, v1, v2, let `a, b, c = v0 - o, v1 - o, v2 - o` and `N = (v1 - v0) x (v2 - v0)`. The line `o + t d` meets
the plane at `t = a.N / d.N`. There the barycentric of v0 is `w0 = d.(b x c) / d.N`. The triple products of w0, w1, w2 add up to `d.N`.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from wrt.scene.clean import whole_numbers

UNIT = 2.0**-53  # unit roundoff of float64
ACCURATE = 1e-14  # larger errors, relative in t and absolute in u and v, are recomputed in integers

# Error bound of a triple product of differences, relative to the sum of its terms' magnitudes. Both have 8 roundings in sequence.
TRIPLE = 10.0 * UNIT


class Place(IntEnum):
    """Location of the intersection of a line with the plane of a triangle; INSIDE, EDGE and VERTEX are hits.

    COPLANAR: the line lies in the plane; a line parallel to the plane is OUTSIDE. DEGENERATE: the triangle has no area."""

    OUTSIDE = 0
    INSIDE = 1
    EDGE = 2
    VERTEX = 3
    COPLANAR = 4
    DEGENERATE = 5


@dataclass(frozen=True, eq=False)
class Crossings:
    """Intersections of N lines with the planes of N triangles, (N,) each.

    t, u and v are inf or NaN for a line parallel to the plane. Misses can have NaN in all fields but `place`."""

    place: np.ndarray  # int8, values of Place.
    t: np.ndarray  # float64, in units of the direction's length.
    u: np.ndarray  # float64, barycentric of v1.
    v: np.ndarray  # float64, barycentric of v2.
    t_error: np.ndarray  # Bound on |t - exact t|.
    slope: np.ndarray  # d.N, as the module's docstring defines it.

    @property
    def hit(self) -> np.ndarray:
        return (self.place >= Place.INSIDE) & (self.place <= Place.VERTEX)


def _triple(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a . (b x c) of (3, N) arrays whose entries have at most one rounding, and a bound on the error of the result."""
    value = np.zeros(a.shape[1])
    size = np.zeros(a.shape[1])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        left, right = b[j] * c[k], b[k] * c[j]
        value += a[i] * (left - right)
        size += np.abs(a[i]) * (np.abs(left) + np.abs(right))
    return value, TRIPLE * size


def _triple_exact(a: list[Any], b: list[Any], c: list[Any]) -> Any:
    return (a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0]))


def exact_plane(o: np.ndarray, d: np.ndarray, v: tuple[np.ndarray, ...]) -> tuple[Any, Any, Any, int]:
    """Return integers w, (q, slope, p), normal, s: barycentrics w[i] / slope, t = q / slope * 2^s, d.N = slope * 2^p; normal is along N."""
    (origin, *corners), k = whole_numbers(o, *v)
    (direction,), k_d = whole_numbers(d)
    a, b, c = ([p - q for p, q in zip(corner, origin, strict=True)] for corner in corners)
    e1, e2 = ([p - q for p, q in zip(edge, a, strict=True)] for edge in (b, c))
    weights = [_triple_exact(direction, *pair) for pair in ((b, c), (c, a), (a, b))]
    normal = [e1[1] * e2[2] - e1[2] * e2[1], e1[2] * e2[0] - e1[0] * e2[2], e1[0] * e2[1] - e1[1] * e2[0]]
    numerator = a[0] * normal[0] + a[1] * normal[1] + a[2] * normal[2]
    slope = weights[0] + weights[1] + weights[2]
    return weights, (numerator, slope, 2 * k + k_d), normal, k - k_d


def _sign(x: Any) -> np.ndarray:
    return (x > 0).astype(np.int8) - (x < 0).astype(np.int8)


def _resolve(rows: np.ndarray, o: np.ndarray, d: np.ndarray, v: tuple[np.ndarray, ...], out: Crossings) -> None:
    """Overwrite the entries `rows` of `out` with results of integer arithmetic, whose t, u and v are correctly rounded."""
    weights, (numerator, slope, slope_power), normal, power = exact_plane(o[:, rows], d[:, rows], tuple(corner[:, rows] for corner in v))
    w_sign = np.stack([_sign(w) for w in weights])
    slope_sign = _sign(slope)
    zeros = (w_sign == 0).sum(axis=0)
    inside = (slope_sign != 0) & (w_sign * slope_sign >= 0).all(axis=0)
    flat = slope_sign == 0
    degenerate = np.stack([_sign(x) == 0 for x in normal]).all(axis=0)
    place = np.where(inside, Place.INSIDE + zeros, Place.OUTSIDE)
    place = np.where(flat & (_sign(numerator) == 0), Place.COPLANAR, place)
    out.place[rows] = np.where(degenerate, Place.DEGENERATE, place)

    safe = np.where(flat, 1, slope)
    t, u, v_weight = ((x / safe).astype(np.float64) for x in (numerator, weights[1], weights[2]))
    out.t[rows] = np.where(flat, np.inf, np.ldexp(t, power))
    out.u[rows] = np.where(flat, np.nan, u)
    out.v[rows] = np.where(flat, np.nan, v_weight)
    out.t_error[rows] = UNIT * np.abs(out.t[rows])
    out.slope[rows] = np.ldexp(slope.astype(np.float64), slope_power)


def triangle_crossings(o: np.ndarray, d: np.ndarray, v: tuple[np.ndarray, np.ndarray, np.ndarray], *, all_rows: bool = False) -> Crossings:
    """Intersect line i with triangle i. Origins o, directions d and the corners v[0 .. 2]: (3, N) float64 that hold finite float32 values.

    `place` is exact. For hits the relative error of t (bound: t_error) and the errors of u and v are at most ACCURATE.

    all_rows: compute misses as accurately as hits, and distinguish COPLANAR and DEGENERATE from OUTSIDE."""
    a, b, c = (corner - o for corner in v)
    weights = np.empty((3, o.shape[1]))
    bounds = np.empty_like(weights)
    # b x c = b x (v2 - v1): the edge is short where the triangle is far, so that less cancels.
    for i, (p, e) in enumerate(((b, v[2] - v[1]), (c, v[0] - v[2]), (a, v[1] - v[0]))):
        weights[i], bounds[i] = _triple(d, p, e)
    outside = (weights > bounds).any(axis=0) & (weights < -bounds).any(axis=0)
    unknown = ~outside & (np.abs(weights) <= bounds).any(axis=0)
    place = np.where(outside, np.int8(Place.OUTSIDE), np.int8(Place.INSIDE))
    out = Crossings(place, *(np.full(o.shape[1], np.nan) for _ in range(5)))

    rows = np.arange(len(place)) if all_rows else np.flatnonzero(~outside)
    rough = np.zeros_like(unknown)
    if len(rows):
        edges = (v[1][:, rows] - v[0][:, rows], v[2][:, rows] - v[0][:, rows])
        slope, slope_error = _triple(d[:, rows], *edges)
        numerator, numerator_error = _triple(a[:, rows], *edges)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            t = numerator / slope
            u, w = weights[1, rows] / slope, weights[2, rows] / slope
            clear = np.abs(slope) - slope_error
            t_error = (numerator_error + np.abs(t) * slope_error) / clear + 2.0 * UNIT * np.abs(t)
            uv_error = (bounds[1:, rows] + np.abs([u, w]) * slope_error) / clear + 2.0 * UNIT
            good = (clear > 0.0) & (t_error <= ACCURATE * np.abs(t))
            good &= (uv_error <= ACCURATE * np.maximum(1.0, np.abs([u, w]))).all(axis=0)
        out.t[rows], out.u[rows], out.v[rows], out.t_error[rows], out.slope[rows] = t, u, w, t_error, slope
        rough[rows] = ~good
    exact = np.flatnonzero(unknown | rough)
    if len(exact):
        _resolve(exact, o, d, v, out)
    return out


@dataclass(frozen=True, eq=False)
class SphereCrossings:
    """Intersections of N lines with N spheres.

    t is NaN on a miss. A line that touches its sphere has equal t[0] and t[1]."""

    hit: np.ndarray  # (N,) bool.
    touching: np.ndarray  # (N,) bool: the line is tangent to the sphere.
    t: np.ndarray  # (2, N) float64: entry t[0] and exit t[1], in units of the direction's length.
    t_error: np.ndarray  # (2, N) bounds on |t - exact t|.


def sphere_crossings(o: np.ndarray, d: np.ndarray, center: np.ndarray, radius: np.ndarray) -> SphereCrossings:
    """Intersect line i with sphere i in integers. Origins o, directions d, center: (3, N); radius: (N,) > 0; float64 of float32 values.

    The sign of the discriminant is exact: a line that touches the sphere hits it. The relative error of t is at most 2 UNIT."""
    signs, t = np.empty(o.shape[1], np.int8), np.empty((2, o.shape[1]))
    columns = ((2.0**149 * rows).T.tolist() for rows in (o, d, center, radius[None]))  # float32 values are multiples of 2^-149
    for i, numbers in enumerate(zip(*columns, strict=True)):
        signs[i], t[:, i] = _sphere_exact(*([int(x) for x in row] for row in numbers))
    return SphereCrossings(signs >= 0, signs == 0, t, 2.0 * UNIT * np.abs(t))


def _sphere_exact(o: list[int], d: list[int], center: list[int], radius: list[int]) -> tuple[int, tuple[float, float]]:
    """Return the exact sign of the discriminant of one line and sphere, and both roots in float64, NaN if it is negative."""
    f = [p - q for p, q in zip(o, center, strict=True)]
    a, b, c = (sum(p * q for p, q in zip(x, y, strict=True)) for x, y in ((d, d), (d, f), (f, f)))
    rest = c - radius[0] ** 2
    discriminant = b * b - a * rest
    if discriminant < 0:
        return -1, (math.nan, math.nan)
    if discriminant == 0 and b == 0:
        return 0, (0.0, 0.0)
    # q adds two numbers of equal sign, so that 128 fractional bits suffice; the other root follows from the product of the roots.
    root = math.isqrt(discriminant << 256)
    q = -(b << 128) - (root if b >= 0 else -root)
    first, second = q / (a << 128), (rest << 128) / q
    return (1 if discriminant else 0), (min(first, second), max(first, second))
