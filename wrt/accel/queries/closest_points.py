"""Closest points of a mesh, and distances to it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.queries.accelerator import Accelerator, snapshot_of
from wrt.accel.queries.contains import contains
from wrt.accel.queries.hit_points import surroundings
from wrt.accel.queries.rays import vectors
from wrt.core.device import launch_on, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.kernels.query import FARTHEST
from wrt.kernels.warp_private import fields_of
from wrt.kernels.wide.closest_point import PointArrays, make_closest_point_kernel
from wrt.kernels.wide.traverse import WideTraversal

POINTS_PER_LAUNCH = 4096


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """distance (N,) float32, inf where the mesh has no faces; point (N, 3) float32; u, v (N,) float32, the point is
    (1 - u - v) v0 + u v1 + v v2; prim_id (N,) int32, -1 where there is none, and the rest 0."""

    distance: np.ndarray
    point: np.ndarray
    u: np.ndarray
    v: np.ndarray
    prim_id: np.ndarray

    def __len__(self) -> int:
        return len(self.distance)

    def __repr__(self) -> str:
        return f"ClosestPoints({len(self)} points)"


def closest_points(accel: Accelerator, points: Any, threads: int | None = None) -> ClosestPoints:
    """The point of a mesh that is closest to each of `points`; of several faces at the same distance that of the lowest prim_id,
    also at an edge or a corner that they share. The answer is of NumPy, and does not depend on the tree.

    accel: a bvh4, bvh8 or bvh8c over one mesh, with the watertight triangle test. points: (N, 3) real numbers, taken as float32.
    All is reckoned in float64 and rounded once: distance is off by no more than 2^-23 of itself, and 1e-15 of the mesh's largest
    coordinate times how much longer a triangle is than high; distances that differ by less may change places. A face without area
    counts as the segment or the point that it is, though no ray hits it; one with a corner that is not finite is left out. Raises
    InputError that names the argument.
    """
    snapshot = snapshot_of(accel)
    structure = snapshot.structure
    kernels: Any = structure.accel.kernels
    if not isinstance(kernels, WideTraversal) or structure.units.triangle != "watertight":
        raise InputError("closest points are asked of a bvh4, bvh8 or bvh8c with the watertight triangle test, not of a"
                         f" {structure.accel.name} with {structure.units.triangle!r}")
    rows, device = vectors(points, "points", FARTHEST), snapshot.device
    n, out = len(rows), PointArrays()
    for name, field in fields_of(PointArrays).items():
        setattr(out, name, wp.empty(n, dtype=field.dtype, device=device))
    kernel, given = make_closest_point_kernel(kernels.layout), upload(rows, wp.vec3, device)
    surfaces = surroundings(snapshot).surfaces
    launch_on(device, kernel, n, snapshot.data, surfaces, given, out, None, threads=thread_count(threads), step=POINTS_PER_LAUNCH)
    return ClosestPoints(*(getattr(out, name).numpy() for name in fields_of(PointArrays)))


def signed_distance(accel: Accelerator, points: Any, threads: int | None = None) -> np.ndarray:
    """The distance of each point to a closed mesh, (N,) float32, below 0 inside. As closest_points and wrt.contains."""
    accel = copy(accel)  # which a refit meanwhile leaves as it is
    points = vectors(points, "points", FARTHEST)  # else what is inside would be a tensor, of a GPU perhaps
    inside = contains(accel, points, threads)
    distance = closest_points(accel, points, threads).distance
    return np.where(inside, -distance, distance)
