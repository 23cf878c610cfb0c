"""Pairs of points that see each other."""

from __future__ import annotations

from copy import copy
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import first_hits
from wrt.accel.queries.answers import ANY_HIT_TYPES, room_for
from wrt.accel.queries.hit_points import surroundings
from wrt.accel.queries.rays import vectors
from wrt.core.arrays import check_no_gradients, real_numbers, returned, taken, to_numpy
from wrt.core.checks import shown
from wrt.core.device import launch_on, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.kernels.query import FARTHEST, RayArrays
from wrt.kernels.shade.segments import Pairs, segments, to_visible
from wrt.kernels.structs import Surfaces

PAIRS_PER_LAUNCH = 65536
_kept_extents: WeakKeyDictionary[Geometry, tuple[float, float]] = WeakKeyDictionary()


def visible(accel: Accelerator, a: Any, b: Any, on_a: Any = None, on_b: Any = None, threads: int | None = None, *,
            out: Any = None) -> Any:
    """Whether the open segment between each point of `a` and that of `b` meets nothing, (N,) bool.

    a, b: (N, 3) real numbers, taken as float32, or Warp arrays of vec3; the answer is the same with a and b exchanged, to the bit.
    Surfaces that are nearer to an end than its margin are ignored, so that a point on a surface sees off it: 3.8e-6 times the
    end's own largest coordinate or the size of the largest primitive, whichever is larger, but no more than at the other end if
    that has larger coordinates. Points that are nearer to each other than both margins always see each other, a point itself too.
    Along a surface the margin is not enough. on_a, on_b: (N,) prim_ids of what the points lie on (hits.prim_id of hits.point), -1
    for none. The point is moved off that triangle's plane, or off that sphere, by its rounding, as a shadow ray of a picture is;
    and over one mesh that triangle is not in the way. They are refused for structures with instances, and structures over several
    worlds are refused. threads, out and the answer's library: as in any_hit. Raises InputError that names the argument; of Warp
    arrays on a GPU no values are looked at, and what is not finite sees nothing.
    """
    if not isinstance(accel, Accelerator):
        raise InputError(f"must be a structure (wrt.build), got {shown(accel)}", argument="accel")
    accel = copy(accel)  # which a refit meanwhile leaves as it is
    threads, device = thread_count(threads), accel.device
    check_no_gradients(a=a, b=b)
    p, q = (_points(value, name, device) for value, name in ((a, "a"), (b, "b")))
    n, as_warp, give = len(p), isinstance(taken(a, "a"), wp.array), returned(a, b)
    if len(q) != n:
        raise InputError(f"must have as many rows as a ({n}), got {len(q)}", argument="b")
    array = room_for(ANY_HIT_TYPES, None if out is None else [out], n, device if as_warp else None, give is not None)[0]
    snapshot, known, surfaces = accel.snapshot, on_a is not None or on_b is not None, Surfaces()
    if isinstance(snapshot.geometry, InstancedGeometry) and len(snapshot.geometry.first_instance) > 2:
        raise InputError("must not be over several worlds: visible does not take such a structure yet", argument="accel")
    if known:
        if accel.structure.units.instances:
            raise InputError("is for structures without instances", argument="on_a" if on_a is not None else "on_b")
        surfaces = surroundings(snapshot).surfaces
    ids = [_prim_ids(value, name, n, len(snapshot.geometry)) if known else np.zeros(0, np.int32)
           for value, name in ((on_a, "on_a"), (on_b, "on_b"))]

    def run(kernel: Any, *inputs: Any) -> None:
        launch_on(device, kernel, n, *inputs, None, threads=threads, step=PAIRS_PER_LAUNCH)

    rays: Any = RayArrays()
    rays.origin, rays.direction = (wp.empty(n, dtype=wp.vec3, device=device) for _ in range(2))
    rays.t_min, rays.t_max = (wp.empty(n, dtype=wp.float32, device=device) for _ in range(2))
    size = np.inf if snapshot.changes else largest_size(snapshot.geometry)
    pairs: Any = Pairs()
    pairs.a, pairs.b, pairs.on_a, pairs.on_b = p, q, *(upload(each, wp.int32, device) for each in ids)
    run(segments, surfaces, pairs, size, rays)
    given = rays.origin, rays.direction, rays.t_min, rays.t_max
    seen = accel.any_hit(*given, threads=threads)
    run(to_visible, p, q, seen)
    answer = np.array(to_numpy(seen)) if known else seen
    if known and not accel.structure.units.spheres:
        _without(accel, given, ids, answer, threads)
    if as_warp:
        array.assign(answer)
    else:
        array[:] = to_numpy(answer)
    return array if give is None else give(array)


def largest_size(geometry: Geometry | InstancedGeometry) -> float:
    """The largest extent of a finite primitive along an axis. Of instances, the largest coordinate in a mesh's own space, where
    rays are rounded once more, in the world's lengths."""
    if isinstance(geometry, InstancedGeometry):
        reach = np.array([_extents(part)[1] for part in geometry.parts])
        scale = np.abs(geometry.to_world[:, :, :3]).sum(axis=2).max(axis=1)
        return float((scale * reach[geometry.part]).max(initial=0.0))
    return _extents(geometry)[0]


def _extents(geometry: Geometry) -> tuple[float, float]:
    """The largest extent of a primitive's box, and the largest coordinate; of what is finite."""
    if geometry not in _kept_extents:
        low, high = geometry.bounds()
        finite = np.isfinite(high - low).all(axis=1)
        low, high = low[finite], high[finite]
        _kept_extents[geometry] = (float((high - low).max(initial=0.0)), float(np.maximum(-low, high).max(initial=0.0)))
    return _kept_extents[geometry]


def _without(accel: Accelerator, rays: tuple[Any, ...], ids: list[np.ndarray], seen: np.ndarray, threads: int) -> None:
    """Let those see each other, too, between whom there is nothing but the two triangles on which they lie."""
    origin, way, t_min, t_max = (each.numpy() for each in rays)
    rows = np.nonzero(~seen & (t_max > 0.0))[0]
    prim_id = first_hits(accel, 3, origin[rows], way[rows], t_min[rows], t_max[rows], threads).prim_id
    seen[rows] = ((prim_id < 0) | (prim_id == ids[0][rows, None]) | (prim_id == ids[1][rows, None])).all(axis=1)


def _points(value: Any, name: str, device: Any) -> Any:
    """As a Warp array on the device. Raises InputError that names the argument."""
    value = taken(value, name)
    if isinstance(value, wp.array):
        if value.dtype != wp.vec3 or value.ndim != 1:
            raise InputError(f"must be (N,) vec3, got {value.shape} {value.dtype.__name__}", argument=name)
        if value.device.is_cpu:
            vectors(value.numpy(), name, FARTHEST)
        return (value if value.is_contiguous else value.contiguous()).to(device)
    return upload(vectors(value, name, FARTHEST), wp.vec3, device)


def _prim_ids(value: Any, name: str, n: int, count: int) -> np.ndarray:
    """(N,) int32, -1 for each where there are none. Raises InputError that names the argument."""
    if value is None:
        return np.full(n, -1, np.int32)
    array = real_numbers(value, name, f"({n},) prim_ids")
    if array.shape != (n,) or array.dtype.kind not in "iu":
        raise InputError(f"must be ({n},) whole numbers, got {shown(array)}", argument=name)
    if n and not (array.min() >= -1 and array.max() < count):
        row = int(np.argmax((array < -1) | (array >= count)))
        raise InputError(f"must be -1 to {count - 1}; row {row} is {array[row]}", argument=name)
    return array.astype(np.int32)
