"""Points inside a closed mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import Asked
from wrt.accel.queries.rays import vectors
from wrt.accel.snapshot import Snapshot, once
from wrt.core.arrays import returned
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.kernels.query import FARTHEST


def finite_faces(geometry: Geometry) -> np.ndarray:
    """(F, 3): those of the faces that have no corner that is not finite; no ray hits the others."""
    return geometry.faces[np.isfinite(geometry.vertices).all(axis=1)[geometry.faces].all(axis=1)]


def open_edges(geometry: Geometry) -> int:
    """Number of edges with an odd number of finite faces; corners with the same coordinates are one. 0: the mesh is closed."""
    _, corner = np.unique(geometry.vertices + np.float32(0.0), axis=0, return_inverse=True)  # -0 is 0
    faces = corner.reshape(-1)[finite_faces(geometry)]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, count = np.unique(edges, axis=0, return_counts=True)
    return int((count % 2 == 1).sum())


@once
def open_edges_of(snapshot: Snapshot) -> int:
    """open_edges of a structure's mesh."""
    return open_edges(snapshot.geometry)


@once
def used_bounds(snapshot: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of all finite faces, two (3,); inf and -inf where there are none."""
    geometry = snapshot.geometry
    used = geometry.vertices[finite_faces(geometry)].reshape(-1, 3)
    return used.min(axis=0, initial=np.inf), used.max(axis=0, initial=-np.inf)


def contains(accel: Accelerator, points: Any, threads: int | None = None) -> Any:
    """Whether each of `points` is inside a closed mesh, (N,) bool. On the surface, to rounding, the answer is either.

    points: (N, 3) real numbers, taken as float32. A ray from each crosses the surface an odd number of times or not (so that what
    is in two parts that overlap is outside); with the watertight test that is exact for every direction (all_hits, crossings).
    Raises InputError where the mesh is not closed, and as Accelerator.closest_hit does.
    """
    rows, give = vectors(points, "points", FARTHEST), returned(points)
    asked = Asked(accel, threads, crossings=True)
    if count := open_edges_of(asked.snapshot):
        raise InputError(f"the mesh is not closed: {count} edges have an odd number of faces"
                         "; wrt.winding_number tells what is mostly inside")
    inside = odd_crossings(asked, rows)
    return inside if give is None else give(upload(inside, wp.bool, asked.device))


def odd_crossings(asked: Asked, rows: np.ndarray, seed: int = 0) -> np.ndarray:
    """As `contains`, of (N, 3) float32 and a mesh that may be open: then it depends on the rays' direction, that is on `seed`."""
    inside = np.zeros(len(rows), bool)
    low, high = used_bounds(asked.snapshot)
    within = np.nonzero(((rows >= low) & (rows <= high)).all(axis=1))[0]
    direction = np.random.default_rng(seed).normal(size=3).astype(np.float32)
    counts = asked.of(rows[within], np.broadcast_to(direction, (len(within), 3))).counts()
    inside[within] = counts % 2 == 1
    return inside
