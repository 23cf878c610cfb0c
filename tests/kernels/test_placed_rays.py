"""Rays in float64 near a mesh in float32, and the points that they hit."""

from fractions import Fraction

import numpy as np
import warp as wp

from wrt.accel.queries.raw_launches import RowKernel
from wrt.core.warp_private import array_record, record_of
from wrt.kernels.placed_rays import Placement, locate_hits, place_rays, split_rays

PLACE, LOCATE, SPLIT = RowKernel(place_rays, 2), RowKernel(locate_hits, 6), RowKernel(split_rays, 1)
ODD = [0.0, -0.0, np.nan, np.inf, -np.inf, 1e300, -1e-300, 5e-324, 1e37, 2e37, 1.0]


def placed(origins, directions, *, shift=(0.0, 0.0, 0.0), exponent=0, center=(0.0, 0.0, 0.0), radius=1.0, threads=1):
    """Return placed origins, directions and valid; near: 4 radii."""
    place = Placement()
    place.shift, place.center, place.radius, place.near = wp.vec3d(*shift), wp.vec3d(*center), radius, 4.0 * radius
    place.scale, place.scale_again = 2.0 ** (exponent // 2), 2.0 ** (exponent - exponent // 2)
    origins, directions, t_max = PLACE.rows(len(origins), (origins, directions), record_of(place), threads=threads)
    valid = t_max == np.inf
    assert (t_max[~valid] == -np.inf).all()
    return origins, directions, valid


def random_rays(n, seed):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 3)), rng.normal(size=(n, 3))


def test_near_rays_are_shifted_scaled_and_rounded_once():
    origins, directions = random_rays(1000, 0)
    shift, exponent = np.array([3.0, -5.0, 7.0]), -5
    got, turned, valid = placed(64.0 * origins + shift, directions, shift=shift, exponent=exponent, radius=10.0)
    np.testing.assert_array_equal(got, ((64.0 * origins + shift - shift) / 32.0).astype(np.float32))
    np.testing.assert_array_equal(turned, directions.astype(np.float32))
    assert valid.all()


def test_far_origins_move_along_their_rays_to_two_radii_before_the_center():
    origins, directions = random_rays(1000, 1)
    origins *= 1e9 / np.linalg.norm(origins, axis=1)[:, None]
    center = np.array([1.0, 2.0, 3.0])
    directions -= origins / 1e9 * (1.0 + np.einsum("ij,ij->i", directions, origins) / 1e9)[:, None]  # towards the center's side
    got, turned, valid = placed(origins, directions, center=center, radius=0.5)
    unit = turned / np.linalg.norm(turned, axis=1)[:, None]
    ahead = np.einsum("ij,ij->i", center - got, unit)
    forward = np.einsum("ij,ij->i", center - origins, unit) > 1.0
    assert valid.all() and forward.mean() > 0.9
    # Each moved origin has float32 coordinates of up to the ray's distance from the center.
    away = np.linalg.norm(got - center, axis=1)
    assert (np.abs(ahead - 1.0)[forward] <= 1e-6 * (1.0 + away[forward])).all()


def test_directions_of_any_length_keep_their_direction():
    _, directions = random_rays(500, 2)
    for exponent in (-1050, -300, -31, 31, 300, 900):
        _, turned, valid = placed(np.zeros((500, 3)), np.ldexp(directions, exponent))
        longest = np.abs(turned).max(axis=1)
        assert valid.all() and (longest > 2.0**-31).all() and (longest < 2.0**31).all()
        given = np.ldexp(directions, exponent)
        np.testing.assert_allclose(turned / longest[:, None], given / np.abs(given).max(axis=1)[:, None], rtol=0.0, atol=2.0**-23)


def test_only_rays_with_finite_near_origins_and_directions_are_valid():
    grid = np.ascontiguousarray(np.array(np.meshgrid(ODD, ODD, ODD)).reshape(3, -1).T)
    ones = np.ones_like(grid)
    _, _, valid = placed(ones, grid)
    np.testing.assert_array_equal(valid, np.isfinite(grid).all(axis=1) & grid.any(axis=1))
    origins, _, valid = placed(grid, ones, radius=1e38)  # no origin is far
    finite = np.isfinite(grid).all(axis=1)
    np.testing.assert_array_equal(valid, finite & (np.abs(np.where(finite[:, None], grid, 0.0)) <= 1e37).all(axis=1))
    assert np.isfinite(origins[valid]).all()


def exact_point(corners, origin, direction):
    """Return the point where a line meets a triangle's plane, in rational arithmetic."""
    a, b, c, o, d = ([Fraction(float(x)) for x in v] for v in (*corners, origin, direction))
    def minus(x, y): return [p - q for p, q in zip(x, y, strict=True)]
    def dot(x, y): return sum(p * q for p, q in zip(x, y, strict=True))
    e, f = minus(b, a), minus(c, a)
    normal = [e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]]
    t = dot(minus(a, o), normal) / dot(d, normal)
    return [float(p + t * q) for p, q in zip(o, d, strict=True)]


def test_points_are_where_the_lines_meet_the_planes():
    rng = np.random.default_rng(4)
    corners = rng.normal(size=(200, 3, 3))
    weights = rng.dirichlet([1.0, 1.0, 1.0], 200)
    targets = np.einsum("nk,nkj->nj", weights, corners)
    origins = rng.normal(size=(200, 3))
    faces = np.arange(600, dtype=np.int32).reshape(-1, 3)
    ways, vertices = targets - origins, corners.reshape(-1, 3)
    hits = np.arange(200), np.arange(200), weights[:, 1].astype(np.float32), weights[:, 2].astype(np.float32)

    def located(ways):
        return LOCATE.rows(200, (origins, ways, *hits), array_record(vertices), array_record(faces))[0]

    expected = np.array([exact_point(*row) for row in zip(corners, origins, ways, strict=True)])
    np.testing.assert_allclose(located(ways), expected, rtol=0.0, atol=1e-11)
    # Lines that miss in float64, and lines in the plane, have the point at u and v.
    np.testing.assert_allclose(located(np.full((200, 3), np.nan)), targets, rtol=0.0, atol=1e-6)


def test_rows_of_six_are_split_and_checked():
    odd = np.array([0.0, np.nan, np.inf, 1e37, 1.1e37, -3e38, 1.0], np.float32)
    rows = np.array(np.meshgrid(*[odd] * 2, [0.0, 1.0, np.nan, -1e-45], [0.0, -np.inf], [0.0], [2.0, 0.0], indexing="ij"), np.float32)
    rows = np.ascontiguousarray(rows.reshape(6, -1).T)
    origins, directions, t_max = SPLIT.rows(len(rows), (rows,))
    finite = np.isfinite(rows).all(axis=1)
    valid = finite & (np.abs(rows[:, :3]) <= np.float32(1e37)).all(axis=1) & rows[:, 3:].any(axis=1)
    np.testing.assert_array_equal(t_max, np.where(valid, np.inf, -np.inf))
    np.testing.assert_array_equal(np.concatenate([origins, directions], axis=1)[valid], rows[valid])
    assert np.isfinite(origins).all() and directions.any(axis=1).all()  # a query accepts all rays
