"""The set-up of batch renderers for robots and games, for `bench peers`: a picture of 64x64 pixels in each of many small worlds."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.accel.scenes.build import build
from wrt.core.device import load_kernel, start
from wrt.kernels.study.peers import warp_worlds_query
from wrt.lab.bench.rays import unit
from wrt.lab.hard_cases.contestants import constructors
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

SIDE = 64  # pixels
BALLS = 10  # in a world


class Tiles(NamedTuple):
    """Rays of all worlds, world by world. origins, directions: (N, 3) float32; world: (N,) int32."""

    origins: np.ndarray
    directions: np.ndarray
    world: np.ndarray


class PeerQuery(NamedTuple):
    """A library with its structures. work: the function to time; found: from its result to lengths (N,); a miss has inf."""

    name: str
    work: Callable[[], Any]
    found: Callable[[Any], np.ndarray]


def small_worlds(count: int, seed: int) -> list[Mesh]:
    """Return worlds of BALLS balls of 320 triangles above a floor. Every world has other balls."""
    rng, ball = np.random.default_rng(seed), icosphere(2)
    floor = np.array([[-2, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]], np.float32)
    faces = np.concatenate([ball.faces + i * len(ball.vertices) for i in range(BALLS)])
    faces = np.concatenate([faces, np.array([[0, 1, 2], [0, 2, 3]], np.int32) + BALLS * len(ball.vertices)])
    out = []
    for _ in range(count):
        centers, radii = rng.uniform((-1.5, 0.2, -1.5), (1.5, 1.5, 1.5), (BALLS, 3)), rng.uniform(0.1, 0.4, (BALLS, 1, 1))
        out.append(Mesh(np.concatenate([(centers[:, None] + radii * ball.vertices).reshape(-1, 3), floor]), faces))
    return out


def tiles(worlds: int) -> Tiles:
    """Return the rays of a camera that looks down on the middle of each world."""
    x, y = np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE * 2.0 - 1.0] * 2)
    one = unit(np.stack([0.5 * x, -0.5 * y - 0.5, np.full_like(x, -1.0)], axis=-1).reshape(-1, 3)).astype(np.float32)
    world = np.repeat(np.arange(worlds, dtype=np.int32), SIDE * SIDE)
    return Tiles(np.tile(np.array([0.0, 2.5, 4.0], np.float32), (len(world), 1)), np.tile(one, (worlds, 1)), world)


def of_wrt(worlds: Sequence[Mesh], rays: Tiles, device: str, threads: int) -> PeerQuery:
    accel = build(list(worlds), device=device)
    o, d, world = uploaded(rays, device)

    return PeerQuery("wrt bvh8, worlds", lambda: accel.closest_hit(o, d, threads=threads, world=world), lambda hits: hits.t.numpy())


def of_warp(worlds: Sequence[Mesh], rays: Tiles, device: str, constructor: str) -> PeerQuery:
    place = start(device)
    meshes = [wp.Mesh(points=wp.array(mesh.vertices, dtype=wp.vec3, device=place), bvh_constructor=constructor,
                      indices=wp.array(mesh.faces.ravel(), dtype=wp.int32, device=place)) for mesh in worlds]
    ids = wp.array([mesh.id for mesh in meshes], dtype=wp.uint64, device=place)
    o, d, world = uploaded(rays, device)
    load_kernel(warp_worlds_query, place)

    def work(keep: list[wp.Mesh] = meshes) -> list[wp.array]:
        out = [wp.empty(len(o), dtype=dtype, device=place) for dtype in (wp.float32, wp.int32)]
        wp.launch(warp_worlds_query, dim=len(o), inputs=[ids, world, o, d, *out], device=place)
        return out

    return PeerQuery(f"Warp mesh_query_ray, {constructor}, a mesh a world", work, lambda out: out[0].numpy())


def uploaded(rays: Tiles, device: str) -> list[wp.array]:
    return [wp.array(array, dtype=dtype, device=start(device)) for array, dtype in zip(rays, (wp.vec3, wp.vec3, wp.int32), strict=True)]


def libraries(worlds: Sequence[Mesh], rays: Tiles, device: str, threads: int) -> list[Callable[[], PeerQuery]]:
    """Return a function for each library that builds its structures; Warp uses one thread on the CPU."""
    warp = [partial(of_warp, worlds, rays, device, constructor) for constructor in constructors(device)]
    return [partial(of_wrt, worlds, rays, device, threads), *(warp if threads == 1 else [])]
