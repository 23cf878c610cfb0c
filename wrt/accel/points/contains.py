"""Points inside a closed mesh."""

from __future__ import annotations

from functools import cache
from typing import overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.geometry import InstancedGeometry
from wrt.accel.points.enclosing import enclosing, finite_faces, open_edges
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import ListQuery
from wrt.accel.queries.rays import Rays, constant
from wrt.accel.queries.shapes import in_shape, shaped_points
from wrt.accel.snapshot import Snapshot, once
from wrt.core.arrays import given_like
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, NumpyLike, TensorT, WarpArray


@once
def open_edges_of(snapshot: Snapshot) -> int:
    """Count the open edges of a structure's mesh, or of all meshes below its instances."""
    geometry = snapshot.geometry
    parts = [geometry.parts[i] for i in np.unique(geometry.part)] if isinstance(geometry, InstancedGeometry) else [geometry]
    return sum(map(open_edges, parts))


@once
def used_bounds(snapshot: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding box of all finite faces: low and high, (3,) each; inf and -inf without faces. All of space for instances."""
    geometry = snapshot.geometry
    if isinstance(geometry, InstancedGeometry):
        return np.full(3, -np.inf), np.full(3, np.inf)
    used = geometry.vertices[geometry.faces[finite_faces(geometry)]].reshape(-1, 3)
    return used.min(axis=0, initial=np.inf), used.max(axis=0, initial=-np.inf)


@overload
def contains(accel: Accelerator, points: NumpyLike | WarpArray, threads: int | None = ..., *,
             world: ArrayLike | None = ...) -> npt.NDArray[np.bool_]: ...
@overload
def contains(accel: Accelerator, points: TensorT, threads: int | None = ..., *, world: ArrayLike | None = ...) -> TensorT: ...
def contains(accel: Accelerator, points: ArrayLike, threads: int | None = None, *, world: ArrayLike | None = None) -> object:
    """Test whether points are inside a closed mesh: a ray from an inside point crosses the surface an odd number of times.

    By this rule a point inside two overlapping parts is outside. With the watertight test the result does not depend on the ray's
    direction. For a point within a rounding error of the surface, the result may be True or False.

    Parameters
    ----------
    accel : Accelerator
        Structure over a closed mesh, or over instances of closed meshes, without spheres.
    points : (..., 3) array_like
        Points, converted to float32.
    threads : int, optional
        Threads on the CPU; one per core by default.
    world : int or (...) array_like of int, optional
        Index of the world of each point; required over several worlds.

    Returns
    -------
    (...) bool
        Array of NumPy, or of the library of `points`: PyTorch, JAX.

    Raises
    ------
    InputError
        For a mesh that is not closed, other structures, and points that are not finite.
    """
    query = ListQuery(enclosing(accel), threads, crossings=True)
    rows, shape, world = shaped_points(points, world, query.snapshot.geometry.origin)
    if count := open_edges_of(query.snapshot):
        raise InputError(f"the mesh is not closed: {count} edges have an odd number of faces",
                         hint="for an open mesh, use wrt.winding_number(accel, points) > 0.5, or wrt.signed_distance(..., sign='winding')")
    inside = in_shape(odd_crossings(query, rows, world=world), shape)
    return inside if isinstance(points, wp.array) else given_like(points, inside)


def odd_crossings(query: ListQuery, rows: np.ndarray, seed: int = 0, world: ArrayLike | None = None) -> np.ndarray:
    """Return whether a ray from each point in `rows` crosses the surface an odd number of times.

    rows: (N, 3) float32, valid origins. seed: of the rays' direction.
    """
    inside = np.zeros(len(rows), bool)
    low, high = used_bounds(query.snapshot)
    within = np.nonzero(((rows >= low) & (rows <= high)).all(axis=1))[0]
    if len(within):
        n = len(within)
        rays = Rays(rows[within], np.tile(direction_of(seed), (n, 1)), constant(0.0, n), constant(np.inf, n))
        counts = query.of_valid(rays, world).counts()
        inside[within] = counts % 2 == 1
    return inside


@cache
def direction_of(seed: int) -> np.ndarray:
    """Return a random direction, (3,) float32."""
    return np.random.default_rng(seed).normal(size=3).astype(np.float32)
