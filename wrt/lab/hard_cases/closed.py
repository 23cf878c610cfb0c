"""Rays that start inside a closed surface: every one must hit.

This is a theorem. Let the float32 surface have a winding number other than 0 around the origin of a ray. Then the ray meets a triangle
that is not parallel to it, even if some triangles have lost their area. Proof: shift the ray sideways by distances that tend to 0, in a
direction outside every plane that contains the ray and a triangle. The shifted rays start inside and miss the triangles in those planes,
so each hits another triangle. One of these finitely many triangles is hit infinitely often. The triangle is closed, so the ray itself
hits it.

A case with HIT therefore needs only origins inside. Rounding to float32 moves a vertex by less than the origin's distance to the surface,
so the surface never passes over the origin and keeps its winding number."""

from dataclasses import replace
from functools import cache

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.lab.hard_cases.common import HIT, HardCase, aimed, cube, hard_case, in_ball, joined, lat_long, sphere, surface, unit_vectors
from wrt.scene.clean import flip_collinear
from wrt.scene.shapes import teapot

POSITIONS = {"origin": (0.0, 0.0, 0.0), "1e4": (1e4, 1e4, 1e4), "far": (148376.0, 1234.0, -223423.0)}
APEX_FACES = 10_000
SHEET_GAP = 4e-5


def inside(geometry: Geometry, origins: np.ndarray, rng: np.random.Generator, aim: str) -> HardCase:
    origins = origins.astype(np.float32)
    return hard_case(geometry, origins, aimed(geometry, rng, origins, aim), HIT, closed=True)


@cache
def _dense(position: str) -> Geometry:
    geometry = sphere(400, 200, 2.0, POSITIONS[position])
    return surface(geometry.vertices, flip_collinear(geometry.vertices, geometry.faces)[0])


def dense_sphere(rng: np.random.Generator, n: int, *, position: str, aim: str) -> HardCase:
    """A: a sphere of radius 2 with 159,200 triangles, and origins in the cube of side 2 around its centre.
    The cube's corners are 0.26 from the surface; rounding moves a point 2e5 from 0 by at most 0.012. At position "far" the corners
    of 2356 faces round to a line; wrt.scene.clean.flip_collinear flips their edges, as in every scene."""  # noqa: D401
    center = np.array(POSITIONS[position])
    return inside(_dense(position), center + rng.uniform(-1.0, 1.0, (n, 3)), rng, aim)


def jittered_sphere(rng: np.random.Generator, n: int, *, aim: str) -> HardCase:
    """B (pbrt-v4, shapes_test, Triangle.Watertight): a sphere of 16 x 16 quads, each vertex at radius 1 + 5 U; origins within 0.5 of 0.
    U is uniform in [0, 1]. Corners of a face are at most 26 degrees apart, so no face is closer to 0 than cos 26 degrees = 0.89."""
    vertices, faces = lat_long(16, 16, 1.0 + 5.0 * rng.random(2 + 16 * 15))
    return inside(surface(vertices, faces), in_ball(rng, n, 0.5), rng, aim)


def needles(rng: np.random.Generator, n: int, *, aim: str) -> HardCase:
    """F: a sphere squeezed along two axes, by factors 10^-U(1.5, 4) and less, so that triangles have aspect ratios of 1e3 to 1e8.
    The rounding error is relative to each coordinate, so origins within half the squeezed radius are still inside."""
    squeeze = np.ones(3)
    axes = rng.permutation(3)
    squeeze[axes[0]] = 10.0 ** -rng.uniform(1.5, 4.0)
    squeeze[axes[1]] = squeeze[axes[0]] * 10.0 ** -rng.uniform(0.0, 4.0)
    vertices, faces = lat_long(32, 32)
    geometry = surface(vertices * squeeze, faces)
    case = inside(geometry, in_ball(rng, n, 0.5) * squeeze, rng, aim)
    if aim == "uniform":  # half are uniform in the squeezed space, to meet the flat sides, too
        half = (unit_vectors(rng, n) * np.where(rng.random((n, 1)) < 0.5, squeeze, 1.0)).astype(np.float32)
        return replace(case, directions=half)
    return case


@cache
def _sheets() -> Geometry:
    return joined(sphere(64, 32, 1.0), sphere(64, 32, 1.0 + SHEET_GAP))


def two_sheets(rng: np.random.Generator, n: int, *, aim: str) -> HardCase:
    """G: two concentric spheres, as glass in glass; the outer radius is larger by 4e-5, and the inner sphere's faces come first."""
    return inside(_sheets(), in_ball(rng, n, 0.9), rng, aim)


@cache
def _coincident() -> Geometry:
    rng = np.random.default_rng(0)
    once = sphere(32, 16)
    faces = np.repeat(once.faces, 3, axis=0)
    return surface(once.vertices, faces[rng.permutation(len(faces))])


def coincident(rng: np.random.Generator, n: int, *, aim: str) -> HardCase:
    """G: a sphere whose faces exist three times each, in random order. Of hits at equal t, the one with the lowest prim_id is right.
    The rays start inside; `aim` names their targets (common.AIMS). G is the group of the case (cases.py)."""
    return inside(_coincident(), in_ball(rng, n, 0.9), rng, aim)


@cache
def _fan() -> Geometry:
    angle = 2.0 * np.pi * np.arange(APEX_FACES) / APEX_FACES
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(APEX_FACES)], axis=1)
    i = np.arange(APEX_FACES)
    j = (i + 1) % APEX_FACES
    top = np.stack([np.zeros_like(i), 2 + i, 2 + j], axis=1)
    bottom = np.stack([np.ones_like(i), 2 + j, 2 + i], axis=1)
    return surface(np.concatenate([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], ring]), np.concatenate([top, bottom]))


def shared_vertex(rng: np.random.Generator, n: int, *, aim: str) -> HardCase:
    """G: a double cone; 10,000 triangles share each apex. Aim "vertices" means the two apexes."""
    geometry = _fan()
    origins = in_ball(rng, n, 0.5).astype(np.float32)
    directions = aimed(geometry, rng, origins, aim)
    if aim == "vertices":
        directions = geometry.vertices[rng.integers(2, size=n)].astype(np.float64) - origins
    return replace(hard_case(geometry, origins, directions, HIT, closed=True), compared=20)


def scaled(rng: np.random.Generator, n: int, *, scale: float, aim: str) -> HardCase:
    """H: a sphere and its rays, scaled by 1e-6, 1 or 1e6."""
    return inside(sphere(64, 32, scale), in_ball(rng, n, 0.9 * scale), rng, aim)


@cache
def _stadium() -> tuple[Geometry, Geometry]:
    mesh = teapot(24)
    pot = surface(mesh.vertices, mesh.faces)
    return pot, joined(pot, sphere(64, 32, 1e5))


def stadium(rng: np.random.Generator, n: int) -> HardCase:
    """H: a teapot in a sphere 1e5 times as large; rays from near and far, half aimed at the teapot's corners, half in any direction."""
    pot, both = _stadium()
    origins = (in_ball(rng, n) * np.where(rng.random((n, 1)) < 0.5, 3.0, 5e4)).astype(np.float32)
    at_pot = aimed(pot, rng, origins, "vertices")
    directions = np.where(rng.random((n, 1)) < 0.5, at_pot, unit_vectors(rng, n))
    return hard_case(both, origins, directions, HIT)


def lengths(rng: np.random.Generator, n: int) -> HardCase:
    """I: directions of length 1e-20 to 1e20."""
    case = inside(sphere(32, 16), in_ball(rng, n, 0.9), rng, "uniform")
    directions = case.directions.astype(np.float64) * 10.0 ** rng.uniform(-20.0, 20.0, (n, 1))
    return replace(case, directions=directions.astype(np.float32))


def underflowing(rng: np.random.Generator, n: int) -> HardCase:
    """I: up to two components of the direction are tiny: 1e-36 or less, some denormal or 0 of either sign."""
    case = inside(sphere(32, 16), in_ball(rng, n, 0.9), rng, "uniform")
    small = rng.random((n, 3)) < 0.5
    small[np.arange(n), rng.integers(3, size=n)] = False
    factor = np.where(small, 10.0 ** -rng.uniform(36.0, 50.0, (n, 3)), 1.0)
    return replace(case, directions=(case.directions.astype(np.float64) * factor).astype(np.float32))


def denormal(rng: np.random.Generator, n: int) -> HardCase:
    """I: all components of the direction are denormal, its length is 1e-41 to 1e-38; the sphere is so small that t is at most 4e37."""
    case = inside(sphere(32, 16, 1e-4), in_ball(rng, n, 0.9e-4), rng, "uniform")
    directions = case.directions.astype(np.float64) * 10.0 ** rng.uniform(-41.0, -38.0, (n, 1))
    directions = directions.astype(np.float32)
    directions[np.abs(directions).max(axis=1) < 5e-42] = np.float32(5e-42)
    return replace(case, directions=directions)


@cache
def _grid() -> Geometry:
    cells = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return joined(*(surface(*cube(cell, cell + 1.0)) for cell in cells))


def axis_parallel(rng: np.random.Generator, n: int) -> HardCase:
    """E: rays along the axes in both directions, with zeros of both signs, through a block of 4 x 4 x 4 touching unit cubes.
    Rays run in faces, along edges and through corners. They start inside or before the block, so a face is always ahead. Where a ray
    meets an edge of the block's outer faces, a weight is exactly 0, also in float32, so it hits the closed triangle."""
    row, axis = np.arange(n), rng.integers(3, size=n)
    origins = np.where(rng.random((n, 3)) < 0.7, rng.integers(0, 9, (n, 3)) / 2.0, rng.uniform(0.0, 4.0, (n, 3)).astype(np.float32))
    sign = rng.choice([-1.0, 1.0], n)
    before = rng.random(n) < 0.5
    origins[row, axis] = np.where(before, 2.0 - sign * rng.integers(2, 9, n), rng.integers(0, 9, n) / 2.0)
    directions = np.where(rng.random((n, 3)) < 0.5, 0.0, -0.0)
    directions[row, axis] = sign * 2.0 ** rng.integers(-3, 4, n)
    return hard_case(_grid(), origins, directions, HIT, closed=True)
