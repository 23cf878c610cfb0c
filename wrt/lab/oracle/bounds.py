"""Forward error bounds of the watertight triangle test and of the sphere test in float32.

u = 2^-24 is float32's unit roundoff. gamma(n) = n u / (1 - n u) bounds the relative error of n successive roundings (Higham 2002, lemma
3.1).

*The triangle test* (Woop, Benthin and Wald 2013). Let z be the axis of the direction's largest component, and x and y the other axes. Let
X, Y, Z be a corner minus the origin, exact. The test shears the corner: x' = X - S Z with S = d_x / d_z. In float32, X has one rounding
and the last subtraction another; S, Z, their product and the subtraction have four:
    |fl(x') - x'| <= e_x = gamma(2) |X| + gamma(4) |S Z| + eta,
with eta = 2^-149 (1 + |Z|) for underflow. The signs of the areas are exact for the rounded corners, because the test computes them in
float64, where the products are exact. So a reported hit has weights l_i >= 0 with sum 1 and sum l_i fl(x'_i) = 0. The point P = sum l_i v_i
*of the triangle* therefore has the sheared coordinates (x, y) with |x| <= delta_x = max e_x and |y| <= delta_y = max e_y.
- `touches`: a hit may be reported only if the rectangle +-delta meets the exact sheared triangle (tested by separating axes).
- Weights: l is also the exact barycentric coordinate of (x, y). With the sheared edge E opposite corner i and the sheared area
  d.N / d_z / 2, where N is the cross product of two edges,
      |l_i - exact| <= (|E_y| delta_x + |E_x| delta_y) / |twice the sheared area|.
  A hit whose three exact weights are larger than this is always found: rounding the corners brings no weight to 0.
- t: P lies at t_P = sum l_i Z_i / d_z, and the slope of the plane gives |t_P - exact| <= (|N_x| delta_x + |N_y| delta_y) / |d.N|.
  The computed sum has three roundings (Z, 1 / d_z, the result). Clamping t to the triangle's box adds at most 7: the slabs have three,
  and P leaves their planes only by its own errors. Together the bound is gamma(10) T.
  T = |t_P| if all Z have one sign, else max |Z| / |d_z|.
- The clamp divides eta by d_x, which may be tiny. If |d_x t| and S are above 2^-120, eta moves t by less than 2^-28 T. Otherwise the test
  clamps t to a padded box, so that eta moves no t (kernels.units.triangle.underflowed). Very short and very long directions are first
  scaled by a power of two, and t is scaled back.

*The sphere test* runs in float64 and rounds once. The box to which t is clamped contains the sphere, so only the rounding of the slabs
counts: gamma(5) |t|. At grazing angles the error of float64 itself grows: see `sphere_bounds`."""

from dataclasses import dataclass

import numpy as np

from wrt.lab.oracle.exact import Crossings

UNIT_32 = 2.0**-24
TINY_32 = 2.0**-149
LARGEST_32 = float(np.finfo(np.float32).max)
SLACK = 1.0 + 1e-9  # covers the rounding of the bounds themselves, which are computed in float64


def gamma(n: int) -> float:
    """Return the bound on the relative error of n successive float32 roundings."""
    return n * UNIT_32 / (1.0 - n * UNIT_32)


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds on the absolute errors of hits, float64; inf means no bound.
    - t, u, v: (N,); w: (3, N), for the weights of v0, v1, v2 before rounding; touches: (N,) bool, False if a hit must not be reported."""

    t: np.ndarray
    u: np.ndarray
    v: np.ndarray
    w: np.ndarray
    touches: np.ndarray


def sure(crossings: Crossings, bounds: Bounds) -> np.ndarray:
    """Return flags of the hits that the watertight test must report: their exact weights are above the bounds. (N,) bool."""
    weights = np.stack([1.0 - crossings.u - crossings.v, crossings.u, crossings.v])
    return crossings.hit & (weights > bounds.w + 1e-13).all(axis=0)


def triangle_bounds(o: np.ndarray, d: np.ndarray, v: tuple[np.ndarray, np.ndarray, np.ndarray], crossings: Crossings) -> Bounds:
    """Return bounds for ray i and triangle i; o, d, v: arguments of `triangle_crossings`, a column for each ray; crossings: its result."""
    column = np.arange(d.shape[1])
    kz = np.argmax(np.abs(d), axis=0)
    kx, ky = (kz + 1) % 3, (kz + 2) % 3
    d_z = d[kz, column]
    shear = d[kx, column] / d_z, d[ky, column] / d_z
    local = [corner - o for corner in v]
    z = np.stack([p[kz, column] for p in local])
    flat, delta = [], []  # sheared corners (3, N) along x and along y, and bounds on their errors
    for axis, s in ((kx, shear[0]), (ky, shear[1])):
        across = np.stack([p[axis, column] for p in local])
        error = gamma(2) * np.abs(across) + gamma(4) * np.abs(s * z) + TINY_32 * (1.0 + np.abs(z))
        flat.append(across - s * z)
        delta.append(SLACK * error.max(axis=0))

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        area = np.abs(crossings.slope / d_z)
        w = np.stack([(np.abs(flat[1][i] - flat[1][j]) * delta[0] + np.abs(flat[0][i] - flat[0][j]) * delta[1]) / area
                      for i, j in ((1, 2), (2, 0), (0, 1))]) * SLACK
        normal, rounding = _normal(v)
        lean = (normal[kx, column] + rounding[kx, column]) * delta[0] + (normal[ky, column] + rounding[ky, column]) * delta[1]
        lean *= SLACK / np.abs(crossings.slope)
        one_sided = (z >= 0.0).all(axis=0) | (z <= 0.0).all(axis=0)
        reach = np.where(one_sided, np.abs(crossings.t) + lean, np.abs(z).max(axis=0) / np.abs(d_z))
        t = SLACK * (lean + (gamma(10) + 2.0**-28) * reach) + 2.0 * TINY_32 * np.where(np.abs(d_z) < 2.0**-64, 2.0**96, 1.0)
    # If a difference overflows, there is no bound.
    lost = np.abs(np.stack(local)).max(axis=(0, 1)) > LARGEST_32
    unknown = lost | ~(np.abs(crossings.slope) > 0.0)
    t, w = np.where(unknown, np.inf, t), np.where(unknown, np.inf, w)
    u, v_weight = w[1:] + UNIT_32 * (np.abs([crossings.u, crossings.v]) + w[1:]) + TINY_32
    return Bounds(t, np.where(unknown, np.inf, u), np.where(unknown, np.inf, v_weight), w, _meets_rectangle(flat, delta) | lost)


def _normal(v: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the absolute components of the triangles' normals, and bounds on their rounding in float64, (3, N) each."""
    e1, e2 = v[1] - v[0], v[2] - v[0]
    left = np.stack([e1[j] * e2[k] for j, k in ((1, 2), (2, 0), (0, 1))])
    right = np.stack([e1[k] * e2[j] for j, k in ((1, 2), (2, 0), (0, 1))])
    return np.abs(left - right), 8.0 * 2.0**-53 * (np.abs(left) + np.abs(right))


def _meets_rectangle(flat: list[np.ndarray], delta: list[np.ndarray]) -> np.ndarray:
    """Return flags of the triangles `flat` (x, y of three corners) that meet the rectangles |x| <= delta[0], |y| <= delta[1]."""
    x, y = flat
    axes = [(np.ones_like(delta[0]), np.zeros_like(delta[0])), (np.zeros_like(delta[0]), np.ones_like(delta[0]))]
    axes += [(y[j] - y[i], x[i] - x[j]) for i, j in ((0, 1), (1, 2), (2, 0))]
    meets = np.ones(len(delta[0]), dtype=bool)
    for a_x, a_y in axes:
        along = a_x * x + a_y * y
        rounding = 8.0 * 2.0**-53 * (np.abs(a_x * x) + np.abs(a_y * y)).max(axis=0)
        reach = np.abs(a_x) * delta[0] + np.abs(a_y) * delta[1] + rounding
        meets &= (along.min(axis=0) <= reach) & (along.max(axis=0) >= -reach)
    return meets


def sphere_bounds(o: np.ndarray, d: np.ndarray, center: np.ndarray, radius: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds (N,) on the error of t in the sphere test for the crossing at t, and flags of the rays whose hit may be reported.

    - f = o - centre; n: the vector from the centre to the nearest point of the line; s: half the chord.
    - The error of the float64 discriminant r^2 - |n|^2 is at most D = 2^-53 (32 |f| (r + 2^-48 |f|) + 8 r^2).
    - The error of t is at most min(D / s, sqrt(D)) / |d|. Near a root t = 0, |f|^2 - r^2 has an error of 2^-50 (|f|^2 + r^2).
    Arguments as for `sphere_crossings`; t may be NaN on a miss."""
    unit = 2.0**-53
    a, ff, rr = (d * d).sum(axis=0), ((o - center) ** 2).sum(axis=0), radius * radius
    f = o - center
    b = (d * f).sum(axis=0)
    cross = np.stack([d[j] * f[k] - d[k] * f[j] for j, k in ((1, 2), (2, 0), (0, 1))])
    chord = rr - (cross * cross).sum(axis=0) / a
    wrong = unit * (32.0 * np.sqrt(ff) * (radius + 2.0**-48 * np.sqrt(ff)) + 8.0 * rr)
    half = np.sqrt(np.maximum(chord, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        grazing = np.minimum(np.where(half > 0.0, wrong / half, np.inf), np.sqrt(wrong)) / np.sqrt(a)
        start = 8.0 * unit * (ff + rr) / np.maximum(np.abs(b), np.sqrt(a) * half)
        bound = SLACK * (gamma(5) * np.abs(t) + 2.0 * grazing + start + 8.0 * unit * np.abs(b) / a) + 2.0 * TINY_32
    return np.where(np.isnan(bound), np.inf, bound), chord >= -wrong
