"""Rays at open surfaces, bad triangles and spheres; for most rays only the oracle knows the right answer."""

from dataclasses import replace
from functools import cache

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.lab.hard_cases.common import HIT, MISS, UNKNOWN, HardCase, cube, hard_case, in_ball, joined, soup, sphere, surface, unit_vectors

# pbrt-v4, shapes_test, Triangle.BadCases: three collinear points and a ray that must miss them (published numbers).
BAD_TRIANGLE = ((-1113.45459, -79.049614, -56.2431908), (-1113.45459, -87.0922699, -56.2431908), (-1113.45459, -79.2090149, -56.2431908))
BAD_ORIGIN, BAD_DIRECTION, BAD_T_MAX = (-1081.47925, 99.9999542, 87.7701111), (-32.1072998, -183.355865, -144.607635), 0.9999
TURN = np.array([[np.cos(0.4), np.sin(0.4), 0.0], [-np.sin(0.4), np.cos(0.4), 0.0], [0.0, 0.0, 1.0]])


def _signed_powers(rng: np.random.Generator, shape: tuple[int, ...], low: float, high: float) -> np.ndarray:
    """Return random numbers +-10^U(low, high), where U is uniform."""
    return rng.choice([-1.0, 1.0], shape) * 10.0 ** rng.uniform(low, high, shape)


def _points(geometry: Geometry, rng: np.random.Generator, n: int, spread: float = 1.0) -> np.ndarray:
    """Return (n, 3) float64 points inside random triangles; a spread below 1 concentrates them near corners and edges."""
    corners = geometry.vertices[geometry.faces[rng.integers(len(geometry.faces), size=n)]].astype(np.float64)
    return np.einsum("ni,nij->nj", rng.dirichlet([spread] * 3, n), corners)


def _towards(geometry: Geometry, rng: np.random.Generator, origins: np.ndarray, points: np.ndarray) -> HardCase:
    origins = origins.astype(np.float32)
    return hard_case(geometry, origins, points - origins.astype(np.float64), UNKNOWN)


def respawned_triangles(rng: np.random.Generator, n: int) -> HardCase:
    """C (pbrt-v4, Triangle.Reintersect): 8 triangles and origins with coordinates +-10^U(-8, 8), and rays aimed at the triangles.
    A ray from the hit along next_directions must not hit the same triangle, on either side."""
    geometry = soup(_signed_powers(rng, (8, 3, 3), -8.0, 8.0))
    case = _towards(geometry, rng, _signed_powers(rng, (n, 3), -8.0, 8.0), _points(geometry, rng, n))
    return replace(case, next_directions=unit_vectors(rng, n).astype(np.float32))


def respawned_spheres(rng: np.random.Generator, n: int) -> HardCase:
    """C: 8 spheres of radius 10^U(-4, 4), up to 1e4 from the point 0, and rays aimed at them from outside and inside.
    A ray from the hit to the outside of the sphere must not hit the sphere again. Centres are at most 2^22 radii from 0: a sphere
    smaller than the float32 spacing at its centre has no outside."""
    radius = 10.0 ** rng.uniform(-4.0, 4.0, (8, 1))
    moved = np.minimum(10.0 ** rng.uniform(-4.0, 4.0, (8, 1)), 2.0**22 * radius)
    spheres = np.concatenate([unit_vectors(rng, 8) * moved, radius], axis=1)
    geometry = surface(np.zeros((0, 3)), np.zeros((0, 3)), spheres)
    chosen = geometry.spheres[rng.integers(8, size=n)].astype(np.float64)
    away = np.where(rng.random((n, 1)) < 0.25, 0.5, 10.0 ** rng.uniform(0.0, 3.0, (n, 1)))
    origins = chosen[:, :3] + chosen[:, 3:] * away * unit_vectors(rng, n)
    case = _towards(geometry, rng, origins, chosen[:, :3] + chosen[:, 3:] * in_ball(rng, n, 0.98))
    return replace(case, next_directions=unit_vectors(rng, n).astype(np.float32))


@cache
def _without_area() -> Geometry:
    """Return triangles with exactly collinear corners (multiples of 1/8): a third have distinct corners, two thirds repeated corners."""
    rng = np.random.default_rng(0)
    start, step = rng.integers(-8, 9, (2, 96, 1, 3)) / 8.0
    along = np.stack([rng.permutation(4)[:3] for _ in range(96)])[:, :, None]
    along[32:64, 1] = along[32:64, 0]
    along[64:] = along[64:, :1]
    return soup(start + along * step)


@cache
def _line_through_zero() -> Geometry:
    """Return triangles with corners on a line through 0. Coordinates differ by up to 2^60, so that float64 rounds their differences."""
    rng = np.random.default_rng(0)
    step = rng.uniform(-4.0, 4.0, (96, 1, 3)).astype(np.float32).astype(np.float64)
    return soup(2.0 ** -rng.integers(0, 60, (96, 3, 1)) * step)


def without_area(rng: np.random.Generator, n: int, *, wide: bool = False) -> HardCase:
    """D: triangles with collinear or repeated corners, which must never be hit. wide: coordinates of very different size."""
    geometry = _line_through_zero() if wide else _without_area()
    origins = in_ball(rng, n, 4.0)
    origins[::2] = (origins[::2] * 8.0).round() / 8.0
    return replace(_towards(geometry, rng, origins, _points(geometry, rng, n)), expected=np.full(n, MISS, np.int8))


def among_bad(rng: np.random.Generator, n: int) -> HardCase:
    """D: triangles without area inside a closed sphere: rays aimed at the triangles must hit the sphere."""
    origins = in_ball(rng, n, 0.5).astype(np.float32)
    directions = _points(_without_area(), rng, n) - origins.astype(np.float64)
    return hard_case(joined(sphere(32, 16, 8.0), _without_area()), origins, directions, HIT, closed=True)


def published_bad(rng: np.random.Generator, n: int) -> HardCase:
    """D: pbrt's three collinear points. The first ray is the published one; other rays differ from it by some float32 steps."""
    steps = rng.integers(-8, 9, (2, n, 3)) * 2.0**-24
    steps[:, :1] = 0.0
    origins, directions = (np.array(x) * (1.0 + s) for x, s in zip((BAD_ORIGIN, BAD_DIRECTION), steps, strict=True))
    return hard_case(soup(np.array([BAD_TRIANGLE])), origins, directions, MISS, t_max=BAD_T_MAX)


def huge(rng: np.random.Generator, n: int) -> HardCase:
    """D: triangles of size 1e30, whose areas overflow float32; origins up to 1e30."""
    geometry = soup(1e30 * rng.uniform(-1.0, 1.0, (32, 3, 3)))
    origins = 1e30 * rng.uniform(-1.0, 1.0, (n, 3)) * 10.0 ** (-30.0 * (rng.random((n, 1)) < 0.3))
    case = _towards(geometry, rng, origins, _points(geometry, rng, n))
    wide = case.directions.astype(np.float64)
    shorter = wide / np.where(rng.random((n, 1)) < 0.5, np.linalg.norm(wide, axis=1, keepdims=True), 1.0)
    return replace(case, directions=shorter.astype(np.float32))


def tiny(rng: np.random.Generator, n: int) -> HardCase:
    """D: triangles of size 1e-42 to 1e-36, mostly denormal, seen from 1e-42 to 1e-30 away."""
    size = 10.0 ** rng.uniform(-42.0, -36.0, (32, 1, 1))
    geometry = soup(size * rng.uniform(-1.0, 1.0, (32, 3, 3)))
    origins = in_ball(rng, n) * 10.0 ** rng.uniform(-42.0, -30.0, (n, 1))
    origins = origins.astype(np.float32)
    directions = _points(geometry, rng, n) - origins.astype(np.float64)
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    return hard_case(geometry, origins, directions / np.where(length > 0.0, length, 1.0), UNKNOWN)


def tiny_components(rng: np.random.Generator, n: int) -> HardCase:
    """I: triangles of size 1e-20 to 1 with corners on a lattice, and directions of length 1e-15 to 1e15 with up to two tiny components.
    A tiny component is 2^-20 to 2^-149 of the longest. On its axis the origin has exactly the target's coordinate, mostly on a face of
    the triangle's box. Half of the rays point away from their target."""
    corners = rng.integers(-4, 5, (32, 3, 3)) * 10.0 ** rng.uniform(-20.0, 0.0, (32, 1, 1))
    geometry = soup(corners)
    chosen, weights = rng.integers(32, size=n), rng.dirichlet([0.3] * 3, n)
    weights[rng.random(n) < 0.6] = (0.0, 0.0, 1.0)  # a corner
    weights = np.where((rng.random(n) < 0.4)[:, None], weights.round(), weights)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    corners = geometry.vertices.reshape(32, 3, 3)[chosen].astype(np.float64)
    target = np.einsum("ni,nij->nj", weights, corners).astype(np.float32).astype(np.float64)
    way = rng.normal(size=(n, 3)) * np.abs(corners).max(axis=(1, 2))[:, None] * 10.0 ** rng.uniform(-2.0, 2.0, (n, 1))
    tiny = rng.random((n, 3)) < 0.6
    tiny[np.arange(n), rng.integers(3, size=n)] = False
    origins = np.where(tiny, target, target - way).astype(np.float32)
    directions = (target - origins) * rng.choice([-1.0, 1.0], (n, 1))
    longest = np.abs(directions).max(axis=1, keepdims=True)
    directions = np.where(tiny, longest * _signed_powers(rng, (n, 3), -45.0, -6.0), directions)
    length = 10.0 ** rng.uniform(-15.0, 15.0, (n, 1))
    return hard_case(geometry, origins, directions / np.where(longest > 0.0, longest, 1.0) * length, UNKNOWN)


def slivers(rng: np.random.Generator, n: int) -> HardCase:
    """F: single triangles of aspect ratio 1e3 to 1e8. Half lie along the axes, where float32 resolves their width; half are rotated."""
    width = 10.0 ** -rng.uniform(3.0, 8.0, 32)
    corners = np.zeros((32, 3, 3))
    corners[:, 0, 0], corners[:, 1, 0], corners[:, 2, 0] = -1.0, 1.0, rng.uniform(-1.0, 1.0, 32)
    corners[:, 2, 1] = width
    turn = np.linalg.qr(rng.normal(size=(32, 3, 3)))[0]
    turn[:16] = np.eye(3)[np.stack([rng.permutation(3) for _ in range(16)])]
    geometry = soup(np.einsum("nij,nkj->nki", turn, corners) + np.where(np.arange(32)[:, None, None] % 4 == 3, 1.0, 0.0))
    points = _points(geometry, rng, n)
    return _towards(geometry, rng, points + unit_vectors(rng, n) * 10.0 ** rng.uniform(-2.0, 2.0, (n, 1)), points)


def edge_on(rng: np.random.Generator, n: int) -> HardCase:
    """F: half of the rays lie exactly in the plane of a triangle and must miss; half are inclined to it by 10^-U(3, 12) rad.
    The planes of all triangles are parallel, so a ray in one plane hits no other triangle."""
    axis = rng.integers(3)
    corners = rng.uniform(-1.0, 1.0, (24, 3, 3))
    corners[:, :, axis] = rng.integers(-4, 5, (24, 1)) / 4.0
    geometry = soup(corners)
    points = _points(geometry, rng, n)
    points[:, axis] = (points[:, axis] * 4.0).round() / 4.0
    origins = points + unit_vectors(rng, n) * 10.0 ** rng.uniform(-1.0, 1.0, (n, 1))
    exactly = rng.random(n) < 0.5
    tilt = np.where(exactly, 0.0, 10.0 ** -rng.uniform(3.0, 12.0, n))
    origins[:, axis] = points[:, axis] + tilt * np.linalg.norm(origins - points, axis=1)
    case = _towards(geometry, rng, origins, points)
    flat = case.directions[:, axis] == 0.0
    return replace(case, expected=np.where(flat, MISS, UNKNOWN).astype(np.int8))


def _square(size: float, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a grid of cells x cells quads over [-size, size]^2: the vertices' first and second coordinates, and the triangles."""
    x = np.linspace(-size, size, cells + 1)
    i, j = np.meshgrid(x, x, indexing="ij")
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1, 1)
    return i.reshape(-1), j.reshape(-1), np.concatenate([first + [0, cells + 1, cells + 2], first + [0, cells + 2, 1]])


@cache
def _floor(turned: bool) -> Geometry:
    i, j, faces = _square(100.0, 32)
    points = np.stack([i, np.zeros(i.size), j], axis=1)
    return surface(points @ (TURN if turned else np.eye(3)), faces)


def grazing(rng: np.random.Generator, n: int, *, turned: bool) -> HardCase:
    """F: rays at angles of 10^U(-7, 0) rad to a floor of 2048 triangles, horizontal or rotated.
    On the horizontal floor, at y = 0, the exact hit is `o - d * o_y / d_y`. If it is 1 % or more inside the border, the ray must
    hit, because all edges in that region have a triangle on both sides."""
    points = np.stack([rng.uniform(-90.0, 90.0, n), np.zeros(n), rng.uniform(-90.0, 90.0, n)], axis=1)
    angle, heading = 10.0 ** rng.uniform(-7.0, 0.0, n), rng.uniform(0.0, 2.0 * np.pi, n)
    away = np.stack([np.cos(heading) * np.cos(angle), np.sin(angle), np.sin(heading) * np.cos(angle)], axis=1)
    origins = points + away * 10.0 ** rng.uniform(-2.0, 1.5, (n, 1))
    if turned:
        points, origins = points @ TURN, origins @ TURN
    case = _towards(_floor(turned), rng, origins, points)
    if turned:
        return case
    o, d = case.origins.astype(np.float64), case.directions.astype(np.float64)
    hit = o - d * (o[:, 1:2] / np.where(d[:, 1:2] < 0.0, d[:, 1:2], np.inf))
    surely = (o[:, 1] > 0.0) & (d[:, 1] < 0.0) & (np.abs(hit) < 99.0).all(axis=1)
    return replace(case, expected=np.where(surely, HIT, UNKNOWN).astype(np.int8))


@cache
def _plates() -> Geometry:
    """Return four plates of 8 x 8 quads over [-1, 1]^2, at z = 1, 2, 4 and 8."""
    i, j, faces = _square(1.0, 8)
    return joined(*(surface(np.stack([i, j, np.full(81, z)], axis=1), faces) for z in (1, 2, 4, 8)))


def exact_ends(rng: np.random.Generator, n: int) -> HardCase:
    """H: t_min or t_max exactly at a hit, which counts, or one float32 step past it, where it does not count.
    All coordinates are powers of two or multiples of 1/16, so that no test rounds."""
    origins = np.concatenate([rng.integers(-15, 16, (n, 2)) / 16.0, np.zeros((n, 1))], axis=1)
    length = 2.0 ** rng.integers(-20, 21, n)
    plate = rng.integers(3, size=n)
    t = (2.0**plate / length).astype(np.float32)
    after, before = np.nextafter(t, np.float32(np.inf)), np.nextafter(2.0 * t, np.float32(0.0))
    kind = rng.integers(5, size=n)
    ends = [(t, t, HIT), (0.0 * t, t, HIT), (t, np.full_like(t, np.inf), HIT), (after, before, MISS), (after, 2.0 * t, HIT)]
    t_min, t_max, expected = (np.choose(kind, [end[i] for end in ends]) for i in range(3))
    directions = np.stack([np.zeros(n), np.zeros(n), length], axis=1)
    turn = rng.integers(3)
    geometry = _plates()
    geometry = surface(np.roll(geometry.vertices, turn, axis=1), geometry.faces)
    return hard_case(geometry, np.roll(origins, turn, axis=1), np.roll(directions, turn, axis=1), expected, t_min=t_min, t_max=t_max)


def beside_boxes(rng: np.random.Generator, n: int) -> HardCase:
    """E: rays along the axes in the planes of a cube's faces, and one float32 step inside and outside of these planes."""
    row, axis = np.arange(n), rng.integers(3, size=n)
    side = np.float32(1.0)
    places = np.array([np.nextafter(side, np.float32(2.0)), np.nextafter(side, np.float32(0.0)), 1.0, 0.5])
    origins = rng.choice([-1.0, 1.0], (n, 3)) * rng.choice(places, (n, 3))
    sign = rng.choice([-1.0, 1.0], n)
    origins[row, axis] = -3.0 * sign
    directions = np.where(rng.random((n, 3)) < 0.5, 0.0, -0.0)
    directions[row, axis] = sign
    return hard_case(surface(*cube(np.full(3, -1.0), np.full(3, 1.0))), origins, directions, UNKNOWN, closed=True)


def rays_not_finite(rng: np.random.Generator, n: int) -> HardCase:
    """I: half of the rays have a NaN or an infinity and must miss; the others must hit."""
    rows = np.concatenate([in_ball(rng, n, 0.9), unit_vectors(rng, n)], axis=1).astype(np.float32)
    bad = rng.random(n) < 0.5
    bad[:1] = True
    rows[bad, rng.integers(6, size=int(bad.sum()))] = rng.choice([np.nan, np.inf, -np.inf], int(bad.sum()))
    case = hard_case(sphere(32, 16), rows[:, :3], rows[:, 3:], np.where(bad, MISS, HIT), closed=True)
    return replace(case, refused=True)


@cache
def _sphere_not_finite() -> Geometry:
    good = sphere(32, 16)
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1.0, 1.0, (30, 3, 3))
    corners[np.arange(30), rng.integers(3, size=30), rng.integers(3, size=30)] = rng.choice([np.nan, np.inf, -np.inf], 30)
    return joined(good, soup(corners))


def mesh_not_finite(rng: np.random.Generator, n: int) -> HardCase:
    """I: a closed sphere, which must be hit, and 30 triangles with a NaN or an infinity, which must not be hit."""
    case = hard_case(_sphere_not_finite(), in_ball(rng, n, 0.9), unit_vectors(rng, n), HIT)
    return replace(case, refused=True)
