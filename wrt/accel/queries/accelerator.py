"""A structure that is asked: rays as arrays in, hits as arrays out."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.built import AccelStats
from wrt.accel.flat_scene import FlatScene
from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES, Hits, room_for
from wrt.accel.queries.batches import Query, trace_query
from wrt.accel.queries.counting import counted
from wrt.accel.queries.gradients import record
from wrt.accel.queries.rays import rays_of
from wrt.accel.queries.world_ids import worlds_asked
from wrt.accel.snapshot import Snapshot
from wrt.accel.structure import Structure, check_units
from wrt.core.arrays import returned
from wrt.core.checks import shown
from wrt.core.device import start, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.warp_private import recording_tape
from wrt.kernels.structs import Surfaces


class Accelerator:
    """A structure that answers: over one mesh (wrt.accel.base.OneMesh), or over instances (wrt.accel.instances.Instances).

    Several threads may ask one structure at a time, and one of them may refit it: docs/moving.md, "Several threads".

    structure: its kind and test units; device: a Warp device; threads: those that build and refit.
    """

    _snapshot: Snapshot  # replaced as a whole

    def __init__(self, structure: Structure, geometry: Any, attributes: FlatScene | None, device: str, threads: int | None) -> None:
        """geometry, attributes: as in Snapshot. Children build over it, and then take a snapshot with what they built."""
        check_units(structure.units.triangle, structure.units.box)
        self.device = start(device)
        self.threads = thread_count(threads)
        self.structure = structure._replace(units=structure.units._replace(spheres=len(geometry.spheres) > 0))
        surfaces = Surfaces()
        surfaces.n_triangles = geometry.n_triangles
        surfaces.spheres = upload(geometry.spheres.copy(), wp.vec4, self.device)  # copied: the caller may write to its array later
        self._snapshot = Snapshot(self.structure, self.device, surfaces, attributes, geometry)
        self._refitting = threading.Lock()
        self._kept: dict[str, Any] = {}  # what refits go on using

    def __copy__(self) -> Accelerator:
        """The same structure, which a refit of this one leaves as it is."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    @property
    def snapshot(self) -> Snapshot:
        """The structure as it is now: its parts belong together, whatever refits do meanwhile."""
        return self._snapshot

    @property
    def geometry(self) -> Any:
        """The Geometry or InstancedGeometry that the structure is over, as it is now."""
        return self._snapshot.geometry

    @property
    def data(self) -> Any:
        """The Warp struct that kernels get. A refit makes another, but in place it writes to this one's arrays."""
        return self._snapshot.data

    @property
    def stats(self) -> AccelStats:
        """What was built, how large it is, and what it costs."""
        stats: AccelStats = self._snapshot.stats
        return stats

    def closest_hit(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
                    threads: int | None = None, *, counters: bool = False, trace: bool = False, out: Hits | None = None,
                    world: Any = None) -> Hits:
        """The closest hit of each ray in the closed segment [t_min, t_max]; at equal t the lowest prim_id.

        Closed means that a surface through the origin is hit at t_min = 0; a t_min above 0 leaves it out. origins,
        directions: (N, 3) real numbers, taken as float32; origins up to 1e37, so that differences are finite; directions finite,
        not zero and of any length (where t would be beyond float32, there is no hit); t_min (>= 0), t_max: scalars or (N,).
        float32 without gaps is read where it is, all else is copied part by part. Warp arrays are (N,) vec3, and of their values
        only t_min and t_max are looked at, on the CPU. threads: 1 or more, or one a core. counters: count what each ray costs
        (hits.counters); trace: also record what it fetches, which takes a second run. out: hits of as many rays, whose arrays take
        the new ones (NumPy's, or Warp's if the rays are; they must not overlap with the rays' own). world: over several worlds,
        which one each ray sees, a number or (N,) int (a Warp array is not looked at; a ray of a world that is none hits nothing).

        Several threads may ask at a time, with or without counters, while another refits. While a wp.Tape records, t, u, v and
        hits.point have gradients at fixed prim_id (wrt.accel.queries.gradients.adjoint) in Warp arrays that require them: origins,
        directions, and the vertices of the last refit. What came in as tensors of torch or JAX goes out as such. Raises InputError
        that names the argument and what was expected; what `out` holds is lost then.
        """
        threads, rays, give = thread_count(threads), rays_of(origins, directions, t_min, t_max, True), returned(origins, directions)
        if not (out is None or isinstance(out, Hits)):
            raise InputError(f"must be Hits, got {shown(out)}", argument="out")
        given = None if out is None else [out.t, out.u, out.v, out.prim_id]
        t, u, v, prim_id = arrays = room_for(HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None,
                                             give is not None)
        snapshot = self._snapshot  # once: a refit may replace it meanwhile
        worlds = worlds_asked(snapshot, world, len(t))
        query, costs = Query(rays, arrays, threads, worlds), None
        if counters or trace:
            costs = counted(snapshot, query, fetches_too=trace)
        else:
            trace_query(snapshot, query)
        hits = Hits(t, u, v, prim_id, costs, (snapshot, rays, worlds))
        if recording_tape() is not None:
            record(hits, t=t, u=u, v=v)
        return hits if give is None else hits.each(give)

    def any_hit(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
                threads: int | None = None, *, out: Any = None, world: Any = None) -> Any:
        """Whether each ray hits anything in its segment: (N,) bool, True where closest_hit finds a hit and nowhere else. Arguments
        as in closest_hit; out: an array that takes the answer."""
        threads, rays, give = thread_count(threads), rays_of(origins, directions, t_min, t_max), returned(origins, directions)
        given = None if out is None else [out]
        arrays = room_for(ANY_HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None, give is not None)
        snapshot = self._snapshot
        trace_query(snapshot, Query(rays, arrays, threads, worlds_asked(snapshot, world, len(arrays[0]))))
        return arrays[0] if give is None else give(arrays[0])


def snapshot_of(accel: Accelerator) -> Snapshot:
    """The snapshot of a structure that is asked for points or for all hits. Raises InputError unless it is over one mesh."""
    message = f"accel must be a structure over one mesh (wrt.build), got {shown(accel)}"
    if not isinstance(accel, Accelerator):
        raise InputError(message)
    accel.structure.require_one_mesh(message)
    return accel.snapshot
