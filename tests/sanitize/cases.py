"""Cases for walks.cpp: small trees, some with bad triangles or rays, and the hits of the kernels that trace one ray at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.kernel_tools import DEVICE, floats, launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.queries.hit_points import device_scene
from wrt.accel.queries.lists import ALL, list_hits
from wrt.accel.scenes.build import build
from wrt.accel.snapshot import any_hit_kernel, closest_hit_kernel
from wrt.kernels.hit_lists import HitLists
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import Hit
from wrt.scene.mesh import Mesh

FACES = (*range(1, 10), 15, 16, 17, 63, 64, 65, 300)
RAYS = (0, 1, 7, 8, 9, 15, 16, 17, 63, 64, 65, 200)
SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, 1e-40, 1e-30, -3e38, np.inf, -np.inf, np.nan], np.float32)


def triangles(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return corners (n, 3, 3): every fifth triangle has no area, every seventh is a copy of its predecessor."""
    corners = rng.normal(size=(n, 1, 3)) + rng.choice([1e-3, 0.3, 2.0], (n, 1, 1)) * rng.normal(size=(n, 3, 3))
    corners[4::5, 2] = corners[4::5, rng.integers(0, 2)]
    corners[6::7] = corners[5::7][: len(corners[6::7])]
    return corners.astype(np.float32)


def rays(rng: np.random.Generator, n: int, corners: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return origins, directions, t_min and t_max of n rays towards triangles, half of them coherent; every eighth ray has special
    values: infinities, NaN, subnormal and huge numbers."""
    together = rng.random((n, 1)) < 0.5
    origin = np.where(together, 3.0 + 0.01 * rng.normal(size=(n, 3)), 3.0 * rng.normal(size=(n, 3)))
    aim = corners.reshape(-1, 3)[rng.integers(0, corners.size // 3, n)] * rng.random((n, 1))
    direction = np.where(rng.random((n, 1)) < 0.1, np.eye(3)[rng.integers(0, 3, n)], aim - origin)
    direction *= 10.0 ** rng.integers(-30, 30, (n, 1))
    origin, direction = origin.astype(np.float32), direction.astype(np.float32)
    bad = np.arange(n) % 8 == 7
    origin[bad], direction[bad] = (rng.choice(SPECIAL, (int(bad.sum()), 3)) for _ in range(2))
    t_min = rng.choice(SPECIAL[[0, 0, 1, 4]], 1 if n % 2 else n)
    return origin, direction, t_min, rng.choice(np.array([np.inf, np.inf, 3.4e38, 1.0, 0.0], np.float32), n)


def in_faces(rng: np.random.Generator, n: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Return corners (24, 3, 3) and n rays that start in faces of the triangles' boxes, almost along z: their shear underflows."""
    size = 10.0 ** rng.uniform(-20.0, 0.0)
    corners, origin = rng.integers(-3, 4, (24, 3, 3)) * size, rng.integers(-2, 3, (n, 3)) * size
    direction = np.concatenate([10.0 ** rng.uniform(-45.0, -15.0, (n, 2)), np.ones((n, 1))], axis=1)
    return corners.astype(np.float32), (origin.astype(np.float32), direction.astype(np.float32), np.zeros(1, np.float32),
                                        np.full(n, np.inf, np.float32))


def counts(accel: Any, rays: RayArrays, n: int, crossings: bool) -> np.ndarray:
    """Return the number of hits or crossings of each of n rays, by the kernel that lists hits for one ray at a time."""
    lists, surfaces = HitLists(), device_scene(accel.snapshot).surfaces
    lists.limit, lists.crossings, lists.vertices, lists.faces = ALL, crossings, surfaces.vertices, surfaces.faces
    lists.first = wp.array(np.arange(n + 1), dtype=wp.int32, device=DEVICE)
    lists.count, lists.rows = zeros(n, wp.int32), zeros(n, Hit)
    if n > 0:
        launch(list_hits(accel.structure, False), n, accel.data, rays, lists, 0)
    return np.maximum(lists.count.numpy(), 0)


def answers(accel: Any, rays: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """Return the answers of the kernels that trace one ray at a time: t, u, v and prim_id of the closest hits; any_hit as int32; and the
    numbers of crossings and of hits."""
    origin, direction, t_min, t_max = rays
    n = len(origin)
    arrays, hits = RayArrays(), HitArrays()
    arrays.origin, arrays.direction = vec3s(origin), vec3s(direction)
    arrays.t_min, arrays.t_max = floats(np.broadcast_to(t_min, n)), floats(t_max)
    hits.t, hits.u, hits.v, hits.prim_id = zeros(n), zeros(n), zeros(n), zeros(n, wp.int32)
    any_hits = zeros(n, wp.bool)
    if n > 0:
        launch(closest_hit_kernel(accel.structure), n, accel.data, accel.snapshot.surfaces, arrays, hits, 0)
        launch(any_hit_kernel(accel.structure), n, accel.data, accel.snapshot.surfaces, arrays, any_hits, 0)
    found = [getattr(hits, name).numpy() for name in ("t", "u", "v", "prim_id")]
    return [*found, any_hits.numpy().astype(np.int32), *(counts(accel, arrays, n, crossings) for crossings in (True, False))]


def cases() -> Iterator[list[np.ndarray]]:
    """Yield the arrays of each case, in the order in which walks.cpp reads them."""
    rng = np.random.default_rng(1)

    def case(corners: np.ndarray, max_leaf: int, rays_of_case: list[tuple[np.ndarray, ...]]) -> Iterator[list[np.ndarray]]:
        mesh = Mesh(corners.reshape(-1, 3), np.arange(corners.size // 3, dtype=np.int32).reshape(-1, 3))
        accel = build(mesh, "bvh8", max_leaf=max_leaf)
        for given in rays_of_case:
            yield [accel.data.nodes.numpy(), accel.data.primitives.numpy(), *given, np.zeros(len(given[0]), np.int32),
                   *answers(accel, given)]

    for count in FACES:
        corners = triangles(rng, count)
        for max_leaf in (1, 8, 20):
            yield from case(corners, max_leaf, [rays(rng, n, corners) for n in (RAYS if count in (8, 300) else (17,))])
    for _ in range(20):
        corners, given = in_faces(rng, 200)
        yield from case(corners, 8, [given])


def write_cases(path: Path) -> None:
    """Write each array behind its length, an int32."""
    with path.open("wb") as file:
        for arrays in cases():
            for array in arrays:
                flat = np.ascontiguousarray(array).reshape(-1)
                file.write(np.int32(len(flat)).tobytes() + flat.tobytes())
