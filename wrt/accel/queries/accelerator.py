"""What a structure is asked by the host: rays as arrays, hits as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from wrt.accel.built import State
from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES, Counters, Hits, room_for
from wrt.accel.queries.batches import trace_on_gpu, trace_worlds, tracer
from wrt.accel.queries.counting import counted
from wrt.accel.queries.gradients import record
from wrt.accel.queries.rays import Rays, rays_of
from wrt.accel.queries.world_ids import WorldIds, worlds_asked
from wrt.accel.structure import Structure
from wrt.core.arrays import recording, returned
from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.core.threads import thread_count


class Queries:
    """The part of Accelerator that answers. device: a Warp device."""

    device: Any
    structure: Structure
    _surfaces: Any
    _state: State

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
            raise InputError(f"out must be Hits, got {shown(out)}")
        given = None if out is None else [out.t, out.u, out.v, out.prim_id]
        t, u, v, prim_id = arrays = room_for(HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None,
                                                give is not None)
        state = self._state  # once: a refit may replace it meanwhile
        worlds = worlds_asked(self, state.geometry, world, len(t))
        costs = _answer(self, state.data, rays, arrays, threads, worlds, trace if counters or trace else None)
        hits = Hits(t, u, v, prim_id, costs, (self, state, rays, worlds))
        if recording() is not None:
            record(hits, t=t, u=u, v=v)
        return hits if give is None else hits.each(give)

    def any_hit(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
                threads: int | None = None, *, out: Any = None, world: Any = None) -> Any:
        """Whether each ray hits anything in its segment: (N,) bool, True where closest_hit finds a hit and nowhere else. Arguments
        as in closest_hit; out: an array that takes the answer."""
        threads, rays, give = thread_count(threads), rays_of(origins, directions, t_min, t_max), returned(origins, directions)
        given = None if out is None else [out]
        arrays = room_for(ANY_HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None, give is not None)
        state = self._state
        _answer(self, state.data, rays, arrays, threads, worlds_asked(self, state.geometry, world, len(arrays[0])))
        return arrays[0] if give is None else give(arrays[0])


def _answer(accel: Queries, data: Any, rays: Rays, out: list[Any], threads: int, worlds: WorldIds | None = None,
            counting: bool | None = None) -> Counters | None:
    """Write the answers of `data`, the structure as it was once, to arrays: of HIT_TYPES or ANY_HIT_TYPES. counting: with a trace
    or without; None: not at all."""

    def trace(structure: Structure, data: Any) -> None:
        if worlds is not None:
            trace_worlds(structure, data, accel._surfaces, rays, worlds, out, accel.device, threads)
        elif accel.device.is_cuda:
            trace_on_gpu(structure, data, accel._surfaces, rays, out, accel.device)
        else:
            tracer(structure, len(out) == 1).trace(data, accel._surfaces, rays, out, threads)

    if counting is None:
        trace(accel.structure, data)
        return None
    return counted(trace, accel.structure, data, len(out[0]), accel.device, counting)
