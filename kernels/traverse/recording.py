"""Functions that write the steps of kernels.traverse.steps. Without Units.steps, they compile to nothing."""

from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray
from wrt.kernels.traverse.common import Probe, Units, make_intersect
from wrt.kernels.traverse.counters import Recorder, write_step
from wrt.kernels.traverse.steps import BEFORE, BEHIND, CLOSEST, MISSED, pop_step, push_step, test_step
from wrt.kernels.units.triangle import edge_areas, to_ray_space


def make_recording(units: Units) -> Any:
    """Make record_push and record_pop, for entries of a stack."""

    @wp.func
    def record_push(recorder: Recorder, ray: Ray, index: int, count: int, t: float, below: int):
        if wp.static(units.steps):
            write_step(recorder, ray.slot, push_step(index, count, t, below))

    @wp.func
    def record_pop(recorder: Recorder, ray: Ray, index: int, count: int, t: float, result: int):
        if wp.static(units.steps):
            write_step(recorder, ray.slot, pop_step(index, count, t, result))

    return record_push, record_pop


def make_recorded_test(units: Units, accepts: Any = None) -> Any:
    """Make recorded_test(recorder, probe, surfaces, primitive, index, best) -> Hit, which returns what `intersect` returns."""
    intersect = make_intersect(units, accepts)
    record = units.triangle_test.record
    has_edges = units.triangle_test.uses_shear

    @wp.func
    def edges_of(probe: Probe, surfaces: Any, primitive: record) -> wp.vec3d:
        if wp.static(has_edges):
            if primitive.prim_id < surfaces.n_triangles:
                origin = probe.ray.origin
                return edge_areas(wp.vec3d(to_ray_space(primitive.v0 - origin, probe.triangle)),
                                  wp.vec3d(to_ray_space(primitive.v1 - origin, probe.triangle)),
                                  wp.vec3d(to_ray_space(primitive.v2 - origin, probe.triangle)))
        none = wp.float64(wp.nan)
        return wp.vec3d(none, none, none)

    @wp.func
    def recorded_test(recorder: Recorder, probe: Probe, surfaces: Any, primitive: record, index: int, best: Hit) -> Hit:
        nothing = Hit()
        nothing.t = float(wp.inf)
        nothing.prim_id = NO_HIT
        line = probe
        line.ray.t_min = float(-wp.inf)
        hit = intersect(line, surfaces, primitive, nothing)
        after = intersect(probe, surfaces, primitive, best)
        result = int(MISSED)
        if hit.prim_id != NO_HIT:
            result = wp.where(hit.t < probe.ray.t_min, BEFORE, wp.where(after.prim_id == hit.prim_id, CLOSEST, BEHIND))
        step = test_step(index, primitive.prim_id, hit, edges_of(probe, surfaces, primitive), result)
        write_step(recorder, probe.ray.slot, step)
        return after

    return recorded_test
