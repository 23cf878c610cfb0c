"""A detailed mesh in a scene a thousand times as large: no single cell size of a uniform grid suits both.

The teapot in a stadium: Haines 1988, "Spline Surface Rendering, and What's Wrong with Octrees", Ray Tracing News 1(2)."""

import numpy as np

from wrt.scene.mesh import Mesh
from wrt.scene.shapes import merged

TIMES = 1000.0  # size of the stadium over that of the mesh


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
    """Return the mesh on the pitch of a stadium that is `times` as large; the mesh's faces come first."""
    lo, hi = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    around = stands()
    scale = times * 0.5 * float(np.linalg.norm(hi - lo))
    place = np.array([0.5 * (lo[0] + hi[0]), lo[1], 0.5 * (lo[2] + hi[2])])
    return merged([mesh, Mesh(around.vertices * scale + place, around.faces)], f"{mesh.name} in a stadium")
