"""Queries of a structure: rays as arrays in, hits as arrays out."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self, TypedDict, Unpack, overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import MESH_OF_A_SPHERE, Geometry, InstancedGeometry
from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES, Hits, answer_arrays, arrays_of
from wrt.accel.queries.arguments import Shape, check_world, in_shape, rays_of
from wrt.accel.queries.batches import Query, tiled_width, trace_query
from wrt.accel.queries.gradients import record
from wrt.accel.queries.observed import counted
from wrt.accel.snapshot import AccelStats, Snapshot, Structure, check_units
from wrt.core.arrays import to_tensor_like
from wrt.core.checks import shown
from wrt.core.device import start, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, NumpyLike, TensorT, WarpStruct
from wrt.core.warp_private import recording_tape, refuse_capture
from wrt.kernels.structs import Surfaces


class Seen(TypedDict, total=False):
    """Arguments by keyword that say what each ray sees: see `Accelerator.closest_hit`."""

    world: ArrayLike | None
    exclude: ArrayLike | None
    mask: ArrayLike | None


class RayOptions(Seen, total=False):
    """Options of `any_hit` by keyword."""

    invalid: str


class HitOptions(RayOptions, total=False):
    """Options of `closest_hit` by keyword."""

    counters: bool
    trace: bool


class Accelerator:
    """An acceleration structure over one mesh (`OneMesh`) or over instances (`Instances`), with its queries.

    Several threads may query one structure while another thread refits it (docs/moving.md, "Several threads").

    Attributes
    ----------
    structure : Structure
        Class of the structure and its intersection tests.
    device : wp.Device
        Device of its arrays.
    threads : int
        Number of CPU threads that build and refit it.
    """

    _snapshot: Snapshot  # a refit assigns a new object

    def __init__(self, structure: Structure, geometry: Geometry | InstancedGeometry, attributes: FlatScene | None, device: str,
                 threads: int | None) -> None:
        """Set the fields that all structures share. Subclasses then build and replace the snapshot. Arguments: see `Snapshot`."""
        check_units(structure.units.triangle, structure.units.box)
        self.device = start(device)
        self.threads = thread_count(threads)
        self.structure = structure._replace(units=structure.units._replace(spheres=len(geometry.spheres) > 0))
        surfaces = Surfaces()
        surfaces.n_triangles = geometry.n_triangles
        surfaces.spheres = upload(geometry.spheres, wp.vec4, self.device)
        self._snapshot = Snapshot(self.structure, self.device, surfaces, attributes, geometry)
        self._refitting = threading.Lock()
        self._cache: dict[str, Any] = {}  # arrays that later refits reuse

    def __copy__(self) -> Self:
        """Return a copy that shares all arrays. A refit of either does not change the other."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    @property
    def snapshot(self) -> Snapshot:
        """Present state of the structure. A later refit does not change it, unless it is a refit in place. Refused in a capture."""
        refuse_capture()
        return self._snapshot

    @property
    def geometry(self) -> Geometry | InstancedGeometry:
        """Triangles and spheres in the structure, as of the last refit."""
        return self._snapshot.geometry

    @property
    def origin(self) -> np.ndarray:
        """Point of the world that is 0 in the arrays of `geometry` and for `ray_query`, (3,) float64; not 0 only far from 0.

        Queries subtract it from origins and points in float64, so that float64 rays are as accurate as near 0."""
        origin = self._snapshot.geometry.origin
        return np.zeros(3) if origin is None else origin.copy()

    @property
    def data(self) -> WarpStruct:
        """Warp struct of the structure's arrays, an argument of kernels. A refit makes a new one; a refit in place modifies it."""
        return self._snapshot.data

    @property
    def stats(self) -> AccelStats:
        """Size, cost and build time of the structure."""
        return self._snapshot.stats

    @overload
    def closest_hit(self, origins: NumpyLike, directions: NumpyLike | None = ..., t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                    threads: int | None = ..., *, out: Hits | None = ..., **options: Unpack[HitOptions]) -> Hits: ...
    @overload
    def closest_hit(self, origins: TensorT, directions: TensorT | None = ..., t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                    threads: int | None = ..., *, out: Hits[TensorT] | None = ..., **options: Unpack[HitOptions]) -> Hits[TensorT]: ...
    def closest_hit(self, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
                    threads: int | None = None, *, out: Hits[Any] | None = None, counters: bool = False, trace: bool = False,
                    **options: Unpack[RayOptions]) -> Hits[Any]:
        """Find the closest hit of each ray in the closed segment [t_min, t_max]; at equal t, the hit with the lowest prim_id.

        With t_min = 0 a ray hits a surface through its origin; a t_min above 0 excludes that surface. While a `wp.Tape` records,
        t, u, v and `hits.point` have gradients at fixed prim_id. These flow to Warp arrays that require gradients: origins,
        directions, and the vertices of the last refit (docs/gradients.md).

        Parameters
        ----------
        origins, directions : (..., 3) array_like, or Warp arrays (...) of vec3
            Real numbers, converted to float32; contiguous float32 arrays (N, 3) are read in place. They broadcast: one origin (3,) with
            directions (H, W, 3) is H W rays. Coordinates of origins are at most 1e37; directions have any length but 0. The values of
            Warp arrays are not checked. Without directions, `origins` is (..., 6) and holds both, as in Open3D.
        t_min, t_max : float or array_like of the rays' shape (...)
            Ends of the segment in units of the direction's length, t_min >= 0. The values of Warp arrays on a GPU are not checked.
        threads : int, optional
            Threads on the CPU; one per core by default.
        out : Hits, optional
            Hits of the rays' shape whose arrays receive the results. No two arrays of results and rays may overlap.
        world : int or array_like of int of the rays' shape, optional
            Index of the world that each ray sees. Over W worlds, rays of shape (W, ...) need none: ray [w, ...] sees world w. Warp
            arrays are not checked: in a world that does not exist, a ray misses.
        exclude : int or array_like of int of the rays' shape, optional
            Body whose instances the ray passes through, a value of `Instances.bodies`; -1 for none. Warp arrays must be int32.
        mask : int or array_like of int of the rays' shape, optional
            32 bits. The ray sees an instance only if both masks have a common bit: `mask & Instances.masks[hits.instance] != 0`.
        invalid : {"raise", "miss"}
            "miss": a ray with NaN, another value that is not valid, or direction 0 misses. This reads Warp arrays on the host.
        counters, trace : bool
            Count the nodes and primitives that each ray visits (`hits.counters`); `trace` also records every fetch.

        Returns
        -------
        Hits
            Arrays of the rays' shape (...), of NumPy or of the library of `origins`: Warp, PyTorch, JAX.

        Raises
        ------
        InputError
            Names the argument and what was expected. The arrays of `out` may have been overwritten.
        """
        snapshot = self._snapshot  # read once, because a refit may replace it during the query
        query, shape, give = _query(snapshot, HIT_TYPES, (origins, directions, t_min, t_max), threads,
                                    None if out is None else arrays_of(out), **options)
        counts = None
        if counters or trace:
            counts = counted(snapshot, query, fetches_too=trace)
        else:
            trace_query(snapshot, query)
        t, u, v, prim_id = query.out
        hits: Hits[Any] = Hits(t, u, v, prim_id, counts, (snapshot, query.rays, query.worlds))
        if recording_tape() is not None:
            record(hits, t=hits.t, u=hits.u, v=hits.v)
        hits = hits if shape is None else hits.in_shape(shape)
        return hits if give is None else hits.each(give)

    @overload
    def any_hit(self, origins: NumpyLike, directions: NumpyLike | None = ..., t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                threads: int | None = ..., *, out: npt.NDArray[np.bool_] | None = ...,
                **options: Unpack[RayOptions]) -> npt.NDArray[np.bool_]: ...
    @overload
    def any_hit(self, origins: TensorT, directions: TensorT | None = ..., t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                threads: int | None = ..., *, out: TensorT | None = ..., **options: Unpack[RayOptions]) -> TensorT: ...
    def any_hit(self, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
                threads: int | None = None, *, out: object = None, **options: Unpack[RayOptions]) -> object:
        """Test whether each ray hits anything in its segment: True exactly where `closest_hit` finds a hit.

        Parameters
        ----------
        origins, directions, t_min, t_max, threads, world, exclude, mask, invalid
            See `closest_hit`.
        out : (...) bool, optional
            Array of the rays' shape that receives the results.

        Returns
        -------
        (...) bool
            Array of the rays' shape, of NumPy or of the library of `origins`.
        """
        snapshot = self._snapshot
        query, shape, give = _query(snapshot, ANY_HIT_TYPES, (origins, directions, t_min, t_max), threads,
                                    None if out is None else (out,), **options)
        trace_query(snapshot, query)
        found = query.out[0] if shape is None else in_shape(query.out[0], shape)
        return found if give is None else give(found)


def _query(snapshot: Snapshot, types: Mapping[str, np.dtype], rays: tuple[Any, Any, Any, Any], threads: int | None,
           out: Sequence[Any] | None, invalid: str = "raise",
           **seen: Unpack[Seen]) -> tuple[Query, Shape | None, Callable[[Any], Any] | None]:
    """Return the query of a call, the shape of its results, and the function that converts them to the caller's library.

    Shape and function are None in the usual call: NumPy arrays (N, 3), or Warp arrays (N,). types: of the results, of which only hits have
    gradients; `rays`: the caller's origins, directions, t_min and t_max; seen: world, exclude and mask; other arguments: see
    `Accelerator.closest_hit`.
    """
    if threads is not None:
        threads = thread_count(threads)
    valid, shape = rays_of(*rays, types is HIT_TYPES, snapshot.geometry.origin, invalid)
    if not valid.as_warp:
        refuse_capture()
    form, give = ((len(valid.origins),), None) if shape is None else (shape, to_tensor_like(*rays[:2]))
    arrays = answer_arrays(types, out, form, snapshot.device if valid.as_warp else None, give is not None)
    worlds = check_world(snapshot, form, **seen)
    of_worlds = worlds is not None and form[:-1] == (len(worlds.arrays.root),)  # a tile has rays of one world
    width = 0 if shape is None or of_worlds else tiled_width(form)
    return Query(valid, arrays, threads, worlds, width), shape, give


def present(accel: Accelerator) -> Snapshot:
    """Return the snapshot of a structure, also in a capture. Raises InputError if `accel` is none."""
    if not isinstance(accel, Accelerator):
        raise InputError(f"must be a structure, got {shown(accel)}", argument="accel", hint="build one first: accel = wrt.build(mesh)")
    return accel._snapshot


def snapshot_of(accel: Accelerator, instances: bool = False) -> Snapshot:
    """Return the snapshot of a structure over one mesh without spheres, or, if `instances`, over instances or worlds.
    Raises InputError for any other structure."""
    what = "" if instances else " over one mesh"
    units = accel.structure.units if isinstance(accel, Accelerator) else None
    if units is None or units.spheres or (units.instances and not instances):
        hint = "build one first: accel = wrt.build(mesh)" if units is None else MESH_OF_A_SPHERE if units.spheres else None
        raise InputError(f"must be a structure{what} without spheres, got {shown(accel)}", argument="accel", hint=hint)
    if instances:  # the results of such queries go through the host
        refuse_capture(accel.device)
    return accel.snapshot
