"""Visibility between pairs of points."""

from __future__ import annotations

from copy import copy
from typing import Any, overload
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.geometry import Geometry, InstancedGeometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import first_hits
from wrt.accel.queries.answers import ANY_HIT_TYPES, answer_arrays
from wrt.accel.queries.arguments import check_world, in_shape, indices_of, pairs_of
from wrt.accel.queries.batches import Query, trace_query
from wrt.accel.queries.hit_points import device_scene
from wrt.accel.queries.rays import Rays, filled, from_origin, to_origin, vectors
from wrt.core.arrays import check_no_gradients, real_numbers, to_numpy, to_tensor_like
from wrt.core.checks import shown
from wrt.core.device import launch_on, to_device, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import Array, ArrayLike, Device, Kernel, NumpyLike, TensorT, WarpArray
from wrt.kernels.query import FARTHEST, RayArrays
from wrt.kernels.shade.segments import Pairs, segments, to_visible
from wrt.kernels.structs import Surfaces

PAIRS_PER_LAUNCH = 65536
_cached_extents: WeakKeyDictionary[Geometry, tuple[float, float]] = WeakKeyDictionary()


@overload
def visible(accel: Accelerator, a: NumpyLike, b: NumpyLike, on_a: ArrayLike | None = ..., on_b: ArrayLike | None = ...,
            threads: int | None = ..., *, out: npt.NDArray[np.bool_] | None = ...,
            world: ArrayLike | None = ...) -> npt.NDArray[np.bool_]: ...
@overload
def visible(accel: Accelerator, a: TensorT, b: TensorT, on_a: ArrayLike | None = ..., on_b: ArrayLike | None = ...,
            threads: int | None = ..., *, out: TensorT | None = ..., world: ArrayLike | None = ...) -> TensorT: ...
def visible(accel: Accelerator, a: ArrayLike, b: ArrayLike, on_a: ArrayLike | None = None, on_b: ArrayLike | None = None,
            threads: int | None = None, *, out: object = None, world: ArrayLike | None = None) -> object:
    """Test whether each point of `a` sees the point of `b` in the same row: no surface meets the open segment between them.

    Exchanging `a` and `b` does not change the result. Surfaces within a margin of an end point are ignored, so that a surface does
    not hide a point that lies on it. Let L be the largest absolute coordinate of a pair. At the point with this coordinate, the
    margin is 3.8e-6 L. At the other point it is 3.8e-6 times the point's largest coordinate or the size of the largest primitive,
    whichever is larger, but at most 3.8e-6 L. Points nearer to each other than the sum of both margins always see each other. For
    segments that run almost along the surface at an end point, the margin is not enough: pass `on_a`, `on_b`.

    Parameters
    ----------
    accel : Accelerator
        Any structure.
    a, b : (..., 3) array_like, or Warp arrays (...) of vec3
        Points, converted to float32; they broadcast. Values of Warp arrays on a GPU are not checked; a point that is not finite sees
        nothing.
    on_a, on_b : (...) array_like of int, optional
        Primitive on which each point lies (`hits.prim_id` for `hits.point`), or -1; they broadcast, too. The point is moved off that
        triangle or sphere by its rounding error, as for shadow rays. In a structure without spheres, that triangle cannot block. Not for
        instances.
    threads, out, world
        See `Accelerator.any_hit`, with pairs in place of rays.

    Returns
    -------
    (...) bool
        Array of NumPy, or of the library of `a`: Warp, PyTorch, JAX.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    if not isinstance(accel, Accelerator):
        raise InputError(f"must be a structure (wrt.build), got {shown(accel)}", argument="accel")
    accel = copy(accel)  # a refit by another thread does not change the copy
    threads, device = thread_count(threads), accel.device
    check_no_gradients(a=a, b=b)
    snapshot, has_ids, surfaces = accel.snapshot, on_a is not None or on_b is not None, Surfaces()
    flat, shape = pairs_of(a, b)
    p, q = (_points(value, name, device, snapshot.geometry.origin) for value, name in zip(flat, "ab", strict=True))
    n, as_warp, give = len(p), isinstance(flat[0], wp.array), to_tensor_like(a, b)
    array: Any = answer_arrays(ANY_HIT_TYPES, out if out is None else [out], shape, device if as_warp else None, give is not None)[0]
    worlds = check_world(snapshot, shape, world)
    ids = [np.zeros(0, np.int32)] * 2
    if has_ids:
        if accel.structure.units.instances:
            raise InputError("is for structures without instances", argument="on_a" if on_a is not None else "on_b")
        surfaces = device_scene(snapshot).surfaces
        ids = [indices_of(real_numbers(-1 if value is None else value, name, f"{shape} prim_ids"), shape, name, -1, len(snapshot.geometry))
               for value, name in ((on_a, "on_a"), (on_b, "on_b"))]  # checked on the host, because kernels read primitives by them

    def run(kernel: Kernel, *inputs: object) -> None:
        launch_on(device, kernel, n, *inputs, None, threads=threads, step=PAIRS_PER_LAUNCH)

    rays = Rays(*(wp.empty(n, dtype=kind, device=device) for kind in (wp.vec3, wp.vec3, wp.float32, wp.float32)))
    size = np.inf if snapshot.changes else largest_size(snapshot.geometry)
    pairs = filled(Pairs, (p, q, *(upload(each, wp.int32, device) for each in ids)))
    run(segments, surfaces, pairs, size, filled(RayArrays, rays))
    seen = wp.empty(n, dtype=wp.bool, device=device)
    trace_query(snapshot, Query(rays, [seen], threads, worlds))
    run(to_visible, p, q, seen)
    result = np.array(to_numpy(seen)) if has_ids else seen
    if has_ids and not accel.structure.units.spheres:
        _ignore_own_triangles(accel, rays, ids, result, threads)
    if as_warp:
        array.assign(result)
    else:
        array[:] = to_numpy(result)
    if out is not None:
        return out
    array = in_shape(array, shape)
    return array if give is None else give(array)


def largest_size(geometry: Geometry | InstancedGeometry) -> float:
    """Return the largest extent of a finite primitive along an axis.

    For instances, return the largest coordinate in a mesh's own space, scaled to world space, because rays are rounded in that space.
    """
    if isinstance(geometry, InstancedGeometry):
        reach = np.array([_extents(part)[1] for part in geometry.parts])
        scale = np.abs(geometry.to_world[:, :, :3]).sum(axis=2).max(axis=1)
        return float((scale * reach[geometry.part]).max(initial=0.0))
    return _extents(geometry)[0]


def _extents(geometry: Geometry) -> tuple[float, float]:
    """Return the largest extent of a finite primitive's box along an axis, and the largest absolute coordinate of these boxes."""
    if geometry not in _cached_extents:
        low, high = geometry.bounds()
        finite = np.isfinite(high - low).all(axis=1)
        low, high = low[finite], high[finite]
        _cached_extents[geometry] = (float((high - low).max(initial=0.0)), float(np.maximum(-low, high).max(initial=0.0)))
    return _cached_extents[geometry]


def _ignore_own_triangles(accel: Accelerator, rays: Rays, ids: list[np.ndarray], seen: np.ndarray, threads: int) -> None:
    """Set `seen` to True for pairs that only the triangles under the two points hide. ids: prim_ids of these triangles."""
    origin, way, t_min, t_max = map(to_numpy, rays)
    origin = to_origin(origin, accel.snapshot.geometry.origin)
    rows = np.nonzero(~seen & (t_max > 0.0))[0]
    prim_id = first_hits(accel, 3, origin[rows], way[rows], t_min[rows], t_max[rows], threads).prim_id
    seen[rows] = ((prim_id < 0) | (prim_id == ids[0][rows, None]) | (prim_id == ids[1][rows, None])).all(axis=1)


def _points(value: Array, name: str, device: Device, origin: np.ndarray | None) -> WarpArray:
    """Return points, (N, 3) or Warp's (N,) of vec3, as a Warp array on the device. Raises InputError that names the argument."""
    value = from_origin(value, origin)
    if isinstance(value, wp.array):
        if value.device.is_cpu:
            vectors(value.numpy(), name, FARTHEST)
        return to_device(value if value.is_contiguous else value.contiguous(), device)
    return upload(vectors(value, name, FARTHEST), wp.vec3, device)
