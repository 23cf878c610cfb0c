"""Winding numbers of a mesh around points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.geometry import InstancedGeometry, inverse_of
from wrt.accel.points.contains import open_edges_of
from wrt.accel.points.enclosing import enclosing
from wrt.accel.points.winding_tree import winding_tree
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.hit_points import device_scene
from wrt.accel.queries.shapes import in_shape, shaped_points
from wrt.accel.queries.world_ids import check_world
from wrt.accel.snapshot import Snapshot
from wrt.core.arrays import given_like
from wrt.core.device import launch_on, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, NumpyLike, TensorT, WarpArray
from wrt.kernels.query import FARTHEST
from wrt.kernels.winding import wind, wind_by_tree

POINTS_PER_LAUNCH = 256
MAX_UNEVEN = 1e-5  # largest deviation of a matrix A from a multiple of a rotation, in A^T A


@overload
def winding_number(accel: Accelerator, points: NumpyLike | WarpArray, threads: int | None = ..., *,
                   exact: bool = ..., world: ArrayLike | None = ...) -> npt.NDArray[np.float64]: ...
@overload
def winding_number(accel: Accelerator, points: TensorT, threads: int | None = ..., *, exact: bool = ...,
                   world: ArrayLike | None = ...) -> TensorT: ...
def winding_number(accel: Accelerator, points: ArrayLike, threads: int | None = None, *, exact: bool = False,
                   world: ArrayLike | None = None) -> object:
    """Compute the generalized winding number of a mesh at each point: the sum of its triangles' solid angles over 4 pi.

    For a closed mesh whose triangles face outwards it is 1 inside and 0 outside. It adds up where parts overlap, and is negative
    where triangles face inwards. Around an open mesh or loose triangles it changes smoothly: above 0.5 a point is mostly inside. On a
    triangle it lies between the values of both sides.

    Subtrees that are far from a point count by their multipole expansions. Over eight meshes of 6,320 to 871,414 triangles and a
    soup of 10,000, the largest error was 0.0008. It grows with the number of surfaces that lie one behind the other. A point takes 4
    to 25 us on one thread. Over instances, it is the sum of the winding numbers of the instances, as is the error: each instance sees
    the point in its own space, rounded to float32.

    Parameters
    ----------
    accel : Accelerator
        Structure over one mesh, instances or worlds, without spheres.
    points : (..., 3) array_like
        Points, converted to float32.
    threads : int, optional
        Threads on the CPU; one per core by default.
    exact : bool
        Sum all solid angles instead: the error is 1e-12, and a point takes 15 ns per triangle.
    world : int or (...) array_like of int, optional
        Index of the world of each point; required over several worlds. In a world that does not exist, the result is 0.

    Returns
    -------
    (...) float64
        Array of NumPy, or of the library of `points`: PyTorch, JAX.

    Raises
    ------
    InputError
        For other structures, for open meshes as instances that are stretched unevenly, and for points that are not finite.

    References
    ----------
    Jacobson, Kavan and Sorkine-Hornung 2013, "Robust Inside-Outside Segmentation using Generalized Winding Numbers". Barill, Dickson,
    Schmidt, Levin and Jacobson 2018, "Fast Winding Numbers for Soups and Clouds".
    """
    accel, threads = enclosing(accel), thread_count(threads)
    snapshot = accel.snapshot
    rows, shape, world = shaped_points(points, world, snapshot.geometry.origin)
    worlds = check_world(snapshot, world, len(rows))
    if isinstance(snapshot.geometry, InstancedGeometry):
        out = np.zeros(len(rows))
        ids = np.zeros(len(rows), np.int32) if worlds is None else worlds.arrays.id.numpy()
        parts: list[Snapshot] = [bottom.snapshot for bottom in accel.bottoms]  # type: ignore[attr-defined]  # of Instances
        _require_even(snapshot.geometry, parts)
        for some, local, part in _local_points(snapshot.geometry, rows, ids):
            out[some] += _of_mesh(parts[part], local, threads, exact)
    else:
        out = _of_mesh(snapshot, rows, threads, exact)
    out = in_shape(out, shape)
    return out if isinstance(points, wp.array) else given_like(points, out)


def _of_mesh(snapshot: Snapshot, points: np.ndarray, threads: int, exact: bool) -> np.ndarray:
    device, surfaces = snapshot.device, device_scene(snapshot).surfaces
    turns = wp.empty(len(points), dtype=wp.vec3d, device=device)
    kernel, inputs = (wind, [surfaces]) if exact else (wind_by_tree, [surfaces, *winding_tree(snapshot, threads)])
    launch_on(device, kernel, len(points), *inputs, upload(points, wp.vec3, device), turns, None, threads=threads, step=POINTS_PER_LAUNCH)
    re, im, whole = turns.numpy().reshape(-1, 3).T
    return np.asarray(whole + np.arctan2(im, re) / (2.0 * np.pi))


def _require_even(geometry: InstancedGeometry, parts: list[Snapshot]) -> None:
    """Raise InputError if a matrix changes the angles of an open mesh, because this changes the mesh's winding numbers."""
    linear = geometry.to_world[:, :, :3]
    squares = linear.swapaxes(1, 2) @ linear
    scale = np.trace(squares, axis1=1, axis2=2)[:, None, None] / 3.0
    uneven = np.abs(squares - scale * np.eye(3)).max(axis=(1, 2)) > MAX_UNEVEN * scale[:, 0, 0]
    for instance in np.flatnonzero(uneven):
        if open_edges_of(parts[geometry.part[instance]]):
            raise InputError(f"instance {instance} is an open mesh that its matrix stretches unevenly or shears", argument="accel",
                             hint="such a matrix changes the winding numbers: put it into the vertices of a mesh of its own")


def _local_points(geometry: InstancedGeometry, points: np.ndarray, world: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, int]]:
    """Yield for each instance: the indices of the points in its world, these points in its space, and its part."""
    to_local, first = inverse_of(geometry.to_world), geometry.first_instance
    order = np.argsort(world, kind="stable")
    ends = np.searchsorted(world[order], np.arange(geometry.n_worlds + 1))
    for w in np.flatnonzero(np.diff(ends)):
        some = order[ends[w]:ends[w + 1]]
        wide = points[some].astype(np.float64)
        for i in range(first[w], first[w + 1]):
            local = wide @ to_local[i, :, :3].T + to_local[i, :, 3]
            yield some, np.ascontiguousarray(np.clip(local, -FARTHEST, FARTHEST), np.float32), int(geometry.part[i])
