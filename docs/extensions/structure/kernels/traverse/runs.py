"""The traversal unit of a list of boxes."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray
from wrt.kernels.traverse.common import Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer


@wp.struct
class Run:
    """A box around consecutive primitives."""

    lo: wp.vec3
    hi: wp.vec3
    first: int
    count: int


@cache
def make_struct(record):
    @wp.struct
    class Runs:
        nodes: wp.array(dtype=Run)
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Runs


def make_traversal(units: Units, any_hit: bool, accepts=None):
    probe_of = make_probe(units)
    visit_leaf = make_leaf(units, any_hit, accepts)
    ray_aabb = units.box_test
    observe = make_observer(units, Run.numpy_dtype()["itemsize"])
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        for i in range(accel.nodes.shape[0]):
            run = accel.nodes[i]
            observe.node(accel.recorder, ray, i, 1, 1)
            if ray_aabb(probe.box, run.lo, run.hi, best.t) < wp.inf:
                best = visit_leaf(accel, surfaces, probe, run.first, run.count, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
        return observe.finish(accel.recorder, ray, best)

    return traverse
