"""Closest points of a mesh, and distances to it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from wrt.accel.geometry import InstancedGeometry
from wrt.accel.points.contains import contains
from wrt.accel.points.winding import winding_number
from wrt.accel.queries.accelerator import Accelerator, snapshot_of
from wrt.accel.queries.arguments import check_world, in_shape, points_of, roots_at
from wrt.accel.queries.hit_points import HitIds, Source, device_scene, part_faces
from wrt.accel.queries.raw_launches import RowKernel
from wrt.accel.queries.rays import filled, to_origin
from wrt.accel.snapshot import Snapshot, once
from wrt.core.checks import require_known
from wrt.core.device import launch_on, made_once, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, Kernel, KernelModule, WarpStruct
from wrt.kernels.warp_private import fields_of
from wrt.kernels.wide.closest_points import PointRows, PointSurfaces, make_closest_points_kernel
from wrt.kernels.wide.layout import NodeLayout
from wrt.kernels.wide.traverse import WideTraversal

POINTS_PER_LAUNCH = 4096
SIGNS = ("crossings", "winding")


@dataclass(frozen=True, eq=False)
class ClosestPoints(HitIds[np.ndarray]):
    """Closest points on a mesh. For a mesh without faces, `distance` is inf, `prim_id` -1, and the rest 0.

    Attributes
    ----------
    distance : (...) float32
        Distance from the query point.
    point : (..., 3) float32
        Closest point; float64 if the structure is far from 0 (`Accelerator.origin`).
    u, v : (...) float32
        Barycentric coordinates: the closest point is (1 - u - v) v0 + u v1 + v v2.
    prim_id : (...) int32
        Index of the face that the closest point is on. `face`, `object`, `instance` and `material` are ids as those of `Hits`.
    source : tuple or None
        Snapshot from which ids are computed. Pickled points have none.
    """

    distance: np.ndarray
    point: np.ndarray
    u: np.ndarray
    v: np.ndarray
    prim_id: np.ndarray
    source: Source | None = None

    def __len__(self) -> int:
        return len(self.distance)

    def __repr__(self) -> str:
        return f"ClosestPoints({self.distance.size} points)"


def closest_points(accel: Accelerator, points: ArrayLike, threads: int | None = None, *,
                   world: ArrayLike | None = None) -> ClosestPoints:
    """Find the point on the surfaces that is closest to each query point. Among faces at equal distance, the lowest prim_id wins.

    The result does not depend on the tree. It is computed in float64 and rounded once. The error of a distance has two parts: 2^-23
    of the distance, and 1e-15 times the mesh's largest coordinate times the ratio of a triangle's length to its height. Faces whose
    distances differ by less than the error may be confused. A face without area counts as a segment or point, though no ray hits
    it. A face with a corner that is not finite is ignored. Over instances, corners in world space are rounded to float32, as in a joined
    mesh.

    Parameters
    ----------
    accel : Accelerator
        A bvh4, bvh8 or bvh8c without spheres, or instances of such, with the watertight triangle test.
    points : (..., 3) array_like
        Query points, converted to float32.
    threads, world
        See `Accelerator.closest_hit`, with points in place of rays.

    Returns
    -------
    ClosestPoints
        NumPy arrays of the points' shape.

    Raises
    ------
    InputError
        For other structures, and for points that are not finite.
    """
    snapshot = snapshot_of(accel, instances=True)
    structure = snapshot.structure
    kernels: KernelModule = structure.accel.kernels
    if not isinstance(kernels, WideTraversal) or structure.units.triangle != "watertight":
        raise InputError("closest points need a bvh4, bvh8 or bvh8c with the watertight triangle test, got a"
                         f" {structure.accel.name} with {structure.units.triangle!r}")
    origin = snapshot.geometry.origin
    rows, shape = points_of(points, origin)
    worlds = check_world(snapshot, shape, world)
    roots = roots_at(snapshot, worlds, len(rows))
    kernel, surfaces = rows_kernel(kernels.layout, roots is not None), point_surfaces(snapshot)
    given = rows, np.zeros(len(rows), np.int32) if roots is None else roots
    if snapshot.device.is_cpu:
        out = kernel.rows(len(rows), given, snapshot.data, surfaces, threads=thread_count(threads))
    else:
        out = _on_gpu(kernel.kernel, snapshot, surfaces, given)
    found = ClosestPoints(*[*(in_shape(array, shape) for array in out), (snapshot, None, worlds)])
    return found if origin is None else replace(found, point=found.point + origin)


@made_once
def rows_kernel(layout: NodeLayout, instances: bool) -> RowKernel:
    return RowKernel(make_closest_points_kernel(layout, instances), 2, POINTS_PER_LAUNCH)


def _on_gpu(kernel: Kernel, snapshot: Snapshot, surfaces: WarpStruct, given: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    """Run the kernel on a GPU as RowKernel.rows."""
    device, n, kinds = snapshot.device, len(given[0]), [field.dtype for field in fields_of(PointRows).values()]
    out = [wp.empty(n, dtype=kind, device=device) for kind in kinds[len(given):]]
    rows = filled(PointRows, [*(upload(values, kind, device) for values, kind in zip(given, kinds, strict=False)), *out])
    launch_on(device, kernel, n, snapshot.data, surfaces, rows, 0)
    return [array.numpy() for array in out]


@once
def point_surfaces(snapshot: Snapshot) -> WarpStruct:
    """Return kernels.wide.closest_points.PointSurfaces of a structure."""
    geometry, device, out = snapshot.geometry, snapshot.device, PointSurfaces()
    if not isinstance(geometry, InstancedGeometry):
        surfaces = device_scene(snapshot).surfaces
        out.vertices, out.faces = surfaces.vertices, surfaces.faces
        return out
    out.vertices, out.faces, out.first_face = part_faces(snapshot)
    reach = np.array([np.abs(part.vertices[np.isfinite(part.vertices)]).max(initial=0.0) for part in geometry.parts])
    to_world, part = geometry.to_world[snapshot.order], geometry.part[snapshot.order]
    for row, axis in enumerate("xyz"):
        setattr(out, f"world_{axis}", upload(to_world[:, row], wp.vec4d, device))
    least = np.linalg.svd(to_world[:, :, :3], compute_uv=False)[:, -1]
    corners = np.abs(to_world[:, :, :3]).sum(axis=2).max(axis=1) * reach[part] + np.abs(to_world[:, :, 3]).max(axis=1)
    out.least, out.margin = upload(least, wp.float64, device), upload(2.0**-22 * corners, wp.float64, device)
    return out


def signed_distance(accel: Accelerator, points: ArrayLike, threads: int | None = None, *, sign: str = "crossings",
                    world: ArrayLike | None = None) -> np.ndarray:
    """Compute the distance of each point to the surfaces, negative inside.

    Parameters
    ----------
    accel, points, threads, world
        See `closest_points`.
    sign : str
        What decides on inside: "crossings" is `contains`, for closed meshes; "winding" is a `winding_number` above 0.5, for open
        meshes and loose triangles, too.

    Returns
    -------
    (...) float32
        NumPy array of the points' shape.

    Raises
    ------
    InputError
        For other structures, for points that are not finite, and for crossings of a mesh that is not closed.
    """
    require_known(sign, SIGNS, "rule of signs", "sign")
    accel = copy(accel)  # a refit by another thread does not change the copy
    origin = snapshot_of(accel, instances=True).geometry.origin
    rows, shape = points_of(points, origin)  # NumPy arrays: queries return tensors for tensors
    rows = in_shape(to_origin(rows, origin), shape)
    if sign == "crossings":
        inside = contains(accel, rows, threads, world=world)
    else:
        inside = winding_number(accel, rows, threads, world=world) > 0.5
    distance = closest_points(accel, rows, threads, world=world).distance
    return np.where(inside, -distance, distance)
