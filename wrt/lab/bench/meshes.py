"""Meshes that measurements make: hills, a mesh in a large stadium, and many small worlds."""

import numpy as np

from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, merged

TIMES = 1000.0  # size of the stadium over that of the mesh
BALLS = 10  # in a small world


def terrain(cells: int) -> Mesh:
    """Return hills of a fixed shape over the square [-1, 1]^2 in x and z, with `2 * cells**2` triangles."""
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, cells + 1), np.linspace(-1.0, 1.0, cells + 1), indexing="ij")
    y = sum(0.3 / k * np.sin(k * (2.1 * x + 0.7 * z) + k * k) * np.cos(k * (1.9 * z - 0.6 * x) + 2.0 * k) for k in (1, 2, 4, 8))
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corner = (i * (cells + 1) + j).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    faces = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, name="terrain")


def stands(tiers: int = 50, seats: int = 400) -> Mesh:
    """Return a stadium of `2 + 4 * tiers * seats` triangles: a pitch at y = 0, and steps from radius 0.6 to 1 that rise to y = 0.25."""
    radius, height = np.linspace(0.6, 1.0, tiers + 1), np.linspace(0.0, 0.25, tiers + 1)
    r, y = np.repeat(radius, 2)[:-1], np.repeat(height, 2)[1:]
    angle = 2.0 * np.pi * np.arange(seats) / seats
    ring = np.stack([np.outer(r, np.cos(angle)), np.repeat(y[:, None], seats, axis=1), np.outer(r, np.sin(angle))], axis=-1)
    i, j = np.meshgrid(np.arange(len(r) - 1), np.arange(seats), indexing="ij")
    a, b = (i * seats + j).ravel(), (i * seats + (j + 1) % seats).ravel()
    faces = np.stack([a, b, b + seats, a, b + seats, a + seats], axis=1).reshape(-1, 3)
    pitch = np.array([[-0.6, 0.0, -0.6], [-0.6, 0.0, 0.6], [0.6, 0.0, 0.6], [0.6, 0.0, -0.6]])
    last = len(r) * seats
    return Mesh(np.concatenate([ring.reshape(-1, 3), pitch]),
                np.concatenate([faces, last + np.array([[0, 1, 2], [0, 2, 3]])]).astype(np.int32), name="stadium")


def in_stadium(mesh: Mesh, times: float = TIMES) -> Mesh:
    """Return the mesh on the pitch of a stadium that is `times` as large; the mesh's faces come first. No single cell size of a uniform
    grid suits both (Haines 1988, "Spline Surface Rendering, and What's Wrong with Octrees", Ray Tracing News 1(2))."""
    lo, hi = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    around = stands()
    scale = times * 0.5 * float(np.linalg.norm(hi - lo))
    place = np.array([0.5 * (lo[0] + hi[0]), lo[1], 0.5 * (lo[2] + hi[2])])
    return merged([mesh, Mesh(around.vertices * scale + place, around.faces)], f"{mesh.name} in a stadium")


def small_worlds(count: int, seed: int) -> list[Mesh]:
    """Return worlds of BALLS balls of 320 triangles above a floor, as robots and games have. Every world has other balls."""
    rng, ball = np.random.default_rng(seed), icosphere(2)
    floor = np.array([[-2, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]], np.float32)
    faces = np.concatenate([ball.faces + i * len(ball.vertices) for i in range(BALLS)])
    faces = np.concatenate([faces, np.array([[0, 1, 2], [0, 2, 3]], np.int32) + BALLS * len(ball.vertices)])
    out = []
    for _ in range(count):
        centers, radii = rng.uniform((-1.5, 0.2, -1.5), (1.5, 1.5, 1.5), (BALLS, 3)), rng.uniform(0.1, 0.4, (BALLS, 1, 1))
        out.append(Mesh(np.concatenate([(centers[:, None] + radii * ball.vertices).reshape(-1, 3), floor]), faces))
    return out
