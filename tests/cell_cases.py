"""Hard cases for structures that cut space into cells: flat, distant, huge and degenerate geometries, grazing rays, random lines."""

from dataclasses import replace
from itertools import product

import numpy as np

from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build

NO_SPHERES = np.zeros((0, 4), np.float32)


def triangles(corners, spheres=NO_SPHERES):
    corners = np.asarray(corners, np.float32).reshape(-1, 3)
    return Geometry(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), np.asarray(spheres, np.float32))


CASES = {
    "soup": lambda rng: triangles(rng.uniform(-1.0, 1.0, (500, 1, 3)) + 0.2 * rng.normal(size=(500, 3, 3))),
    "flat": lambda rng: triangles(np.insert(rng.uniform(-1.0, 1.0, (500, 3, 2)), 1, 0.25, axis=2)),
    "line": lambda rng: triangles(rng.uniform(-1.0, 1.0, (200, 3, 1)) * [1.0, 0.0, 0.0]),
    "point": lambda rng: triangles(np.ones((50, 3, 3))),
    "far": lambda rng: triangles(1000.0 + rng.uniform(-1.0, 1.0, (300, 3, 3))),
    "huge": lambda rng: triangles(rng.uniform(-3e38, 3e38, (100, 3, 3))),
    "subnormal": lambda rng: triangles(rng.uniform(-1e-40, 1e-40, (100, 3, 3))),
    "spheres": lambda rng: triangles(np.zeros((0, 3, 3)), rng.uniform([-1, -1, -1, 0.1], [1, 1, 1, 0.3], (50, 4))),
    "none": lambda rng: triangles(np.zeros((0, 3, 3))),
}


def points_of(geometry, rng):
    """Return one random surface point of each primitive, (N, 3) float64."""
    weight = rng.dirichlet([0.3, 0.3, 0.3], len(geometry.faces))
    point = (weight[:, :, None] * geometry.vertices[geometry.faces].astype(np.float64)).sum(axis=1)
    around = rng.normal(size=(len(geometry.spheres), 3))
    around *= geometry.spheres[:, 3:] / np.linalg.norm(around, axis=1, keepdims=True)
    return np.concatenate([point, geometry.spheres[:, :3] + around])


def soup(rng, n=600, size=0.15):
    """Return n random triangles and 40 spheres."""
    corners = rng.uniform(-1.0, 1.0, (n, 1, 3)) + size * rng.normal(size=(n, 3, 3))
    return triangles(corners, np.concatenate([rng.uniform(-1.0, 1.0, (40, 3)), rng.uniform(0.02, 0.3, (40, 1))], axis=1))


def grazing(rng, n):
    """Return thin triangles in three planes, at most 1e-6 apart, and n rays that are nearly parallel to the planes."""
    corners = rng.uniform(-1.0, 1.0, (200, 3, 3))
    corners[:, :, 1] = rng.choice([0.0, 1e-7, 1e-6], (200, 1))
    corners[:, 2] = corners[:, 1] + 0.01 * rng.normal(size=(200, 3)) * [1.0, 0.0, 1.0]
    target = rng.uniform(-1.0, 1.0, (n, 3)) * [1.0, 0.0, 1.0]
    direction = rng.normal(size=(n, 3))
    direction[:, 1] = rng.choice([-1.0, 1.0], n) * 10.0 ** rng.uniform(-9, -4, n)
    origin = target - direction * rng.uniform(0.0, 2.0, (n, 1))
    return triangles(corners), origin.astype(np.float32), direction.astype(np.float32)


def assert_same(found, expected):
    for name in ("prim_id", "t", "u", "v"):
        a, b = getattr(found, name).view(np.int32), getattr(expected, name).view(np.int32)
        assert np.array_equal(a, b), f"{(a != b).sum()} of {len(a)} rays differ in {name}"


def assert_rays_at_corners_agree(accel, geometry, corner, size, rng):
    """Check rays along the axes and diagonals of cells of this size, through points `corner`, against brute force."""
    brute = build(geometry, "brute_force")
    steps = np.array([d for d in product([-1.0, -0.0, 0.0, 1.0], repeat=3) if np.any(d)])
    direction = (steps[rng.integers(len(steps), size=len(corner))] * size).astype(np.float32)
    origin = (corner - 8 * direction).astype(np.float32)
    origin[: len(origin) // 2] = corner[: len(origin) // 2]
    assert_same(accel.closest_hit(origin, direction), brute.closest_hit(origin, direction))
    assert np.array_equal(accel.any_hit(origin, direction, 0.1, 3.0), brute.any_hit(origin, direction, 0.1, 3.0))


def assert_damage_is_refused(accel, name, change):
    """Check that a structure is restored from its arrays, and refuses them after `change` of the array `name`."""
    arrays = {key: np.array(value) for key, value in accel.built.arrays.items()}
    change(arrays[name])
    type(accel).restore(accel.built, accel.geometry)
    with refused(what="damaged"):
        type(accel).restore(replace(accel.built, arrays=arrays), accel.geometry)
