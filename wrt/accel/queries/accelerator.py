"""Queries of a structure: rays as arrays in, hits as arrays out."""

from __future__ import annotations

import threading
from typing import Any, Self, overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.built import AccelStats
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES, Hits, answer_arrays
from wrt.accel.queries.batches import Query, trace_query
from wrt.accel.queries.counting import counted
from wrt.accel.queries.gradients import record
from wrt.accel.queries.rays import rays_of
from wrt.accel.queries.world_ids import check_world
from wrt.accel.snapshot import Snapshot
from wrt.accel.structure import Structure, check_units
from wrt.core.arrays import returned
from wrt.core.checks import shown
from wrt.core.device import start, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, NumpyLike, TensorT, WarpArray, WarpStruct
from wrt.core.warp_private import recording_tape
from wrt.kernels.structs import Surfaces


class Accelerator:
    """A structure over one mesh (`OneMesh`) or over instances (`Instances`), and its queries.

    Several threads may ask one structure, while one of them refits it (docs/moving.md, "Several threads").

    Attributes
    ----------
    structure : Structure
        Class of the structure and its intersection tests.
    device : wp.Device
        Device of its arrays.
    threads : int
        Threads that build and refit it.
    """

    _snapshot: Snapshot  # replaced as a whole

    def __init__(self, structure: Structure, geometry: Geometry | InstancedGeometry, attributes: FlatScene | None, device: str,
                 threads: int | None) -> None:
        """Keep what every structure has; subclasses build over it and replace the snapshot. Arguments as in `Snapshot`."""
        check_units(structure.units.triangle, structure.units.box)
        self.device = start(device)
        self.threads = thread_count(threads)
        self.structure = structure._replace(units=structure.units._replace(spheres=len(geometry.spheres) > 0))
        surfaces = Surfaces()
        surfaces.n_triangles = geometry.n_triangles
        surfaces.spheres = upload(geometry.spheres.copy(), wp.vec4, self.device)  # copied: the caller may write to its array later
        self._snapshot = Snapshot(self.structure, self.device, surfaces, attributes, geometry)
        self._refitting = threading.Lock()
        self._kept: dict[str, Any] = {}  # arrays that later refits use again

    def __copy__(self) -> Self:
        """Return the same structure; a refit of one of the two does not change the other."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    @property
    def snapshot(self) -> Snapshot:
        """Consistent view of the structure as it is now, which later refits leave as it is."""
        return self._snapshot

    @property
    def geometry(self) -> Geometry | InstancedGeometry:
        """Shapes that the structure is over, as they are now."""
        return self._snapshot.geometry

    @property
    def data(self) -> WarpStruct:
        """Warp struct that kernels get. A refit makes another one; a refit in place writes to the arrays of this one."""
        return self._snapshot.data

    @property
    def stats(self) -> AccelStats:
        """Size, cost and build time of the structure."""
        return self._snapshot.stats

    @overload
    def closest_hit(self, origins: WarpArray, directions: WarpArray, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                    threads: int | None = ..., *, counters: bool = ..., trace: bool = ..., out: Hits[WarpArray] | None = ...,
                    world: ArrayLike | None = ...) -> Hits[WarpArray]: ...
    @overload
    def closest_hit(self, origins: NumpyLike, directions: NumpyLike, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                    threads: int | None = ..., *, counters: bool = ..., trace: bool = ..., out: Hits | None = ...,
                    world: ArrayLike | None = ...) -> Hits: ...
    @overload
    def closest_hit(self, origins: TensorT, directions: TensorT, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                    threads: int | None = ..., *, counters: bool = ..., trace: bool = ..., out: Hits[TensorT] | None = ...,
                    world: ArrayLike | None = ...) -> Hits[TensorT]: ...
    def closest_hit(self, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
                    threads: int | None = None, *, counters: bool = False, trace: bool = False, out: Hits[Any] | None = None,
                    world: ArrayLike | None = None) -> Hits[Any]:
        """Find the closest hit of each ray in the closed segment [t_min, t_max]; at equal t, that of the lowest prim_id.

        A surface through the origin is hit at t_min = 0; a t_min above 0 leaves it out. While a `wp.Tape` records, t, u, v and
        `hits.point` have gradients at fixed prim_id in Warp arrays that require them: origins, directions, and the vertices of the
        last refit (docs/gradients.md).

        Parameters
        ----------
        origins, directions : (N, 3) array_like, or Warp arrays (N,) of vec3
            Real numbers, taken as float32, and read in place if they are float32 without gaps. Coordinates of origins up to 1e37;
            directions of any length but 0. The values of Warp arrays are not checked.
        t_min, t_max : float or (N,) array_like
            Segment in units of the direction's length, t_min >= 0. A Warp array on a GPU is not checked.
        threads : int, optional
            Threads on the CPU; one per core by default.
        counters, trace : bool
            Count the costs of each ray (`hits.counters`); `trace` also records every fetch, in a second run.
        out : Hits, optional
            Hits of N rays whose arrays take the results. They must not overlap with the arrays of the rays.
        world : int or (N,) array_like of int, optional
            World that each ray sees; required over several worlds. In an unchecked Warp array, a world that does not exist is empty.

        Returns
        -------
        Hits
            Arrays of NumPy, or of the library of `origins`: Warp, PyTorch, JAX.

        Raises
        ------
        InputError
            Names the argument and what was expected. The arrays of `out` may have been overwritten.
        """
        threads, rays, give = thread_count(threads), rays_of(origins, directions, t_min, t_max, True), returned(origins, directions)
        if not (out is None or isinstance(out, Hits)):
            raise InputError(f"must be Hits, got {shown(out)}", argument="out")
        given = None if out is None else [out.t, out.u, out.v, out.prim_id]
        t, u, v, prim_id = arrays = answer_arrays(HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None,
                                             give is not None)
        snapshot = self._snapshot  # once: a refit may replace it meanwhile
        worlds = check_world(snapshot, world, len(t))
        query, costs = Query(rays, arrays, threads, worlds), None
        if counters or trace:
            costs = counted(snapshot, query, fetches_too=trace)
        else:
            trace_query(snapshot, query)
        hits = Hits(t, u, v, prim_id, costs, (snapshot, rays, worlds))
        if recording_tape() is not None:
            record(hits, t=t, u=u, v=v)
        return hits if give is None else hits.each(give)

    @overload
    def any_hit(self, origins: WarpArray, directions: WarpArray, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                threads: int | None = ..., *, out: WarpArray | None = ..., world: ArrayLike | None = ...) -> WarpArray: ...
    @overload
    def any_hit(self, origins: NumpyLike, directions: NumpyLike, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                threads: int | None = ..., *, out: npt.NDArray[np.bool_] | None = ...,
                world: ArrayLike | None = ...) -> npt.NDArray[np.bool_]: ...
    @overload
    def any_hit(self, origins: TensorT, directions: TensorT, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
                threads: int | None = ..., *, out: TensorT | None = ..., world: ArrayLike | None = ...) -> TensorT: ...
    def any_hit(self, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
                threads: int | None = None, *, out: object = None, world: ArrayLike | None = None) -> object:
        """Test whether each ray hits anything in its segment: exactly where `closest_hit` finds a hit.

        Parameters
        ----------
        origins, directions, t_min, t_max, threads, world
            See `closest_hit`.
        out : (N,) bool, optional
            Array that takes the answers.

        Returns
        -------
        (N,) bool
            Array of NumPy, or of the library of `origins`.

        Raises
        ------
        InputError
            Names the argument and what was expected.
        """
        threads, rays, give = thread_count(threads), rays_of(origins, directions, t_min, t_max), returned(origins, directions)
        given = None if out is None else [out]
        arrays = answer_arrays(ANY_HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None, give is not None)
        snapshot = self._snapshot
        trace_query(snapshot, Query(rays, arrays, threads, check_world(snapshot, world, len(arrays[0]))))
        return arrays[0] if give is None else give(arrays[0])


def snapshot_of(accel: Accelerator) -> Snapshot:
    """Return the snapshot of a structure over one mesh without spheres. Raises InputError for any other."""
    message = f"accel must be a structure over one mesh (wrt.build), got {shown(accel)}"
    if not isinstance(accel, Accelerator):
        raise InputError(message, argument="accel")
    accel.structure.require_one_mesh(message)
    return accel.snapshot
