"""The traversal unit without a structure: every primitive is tested. The yardstick for all others."""

from functools import cache

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces
from wrt.kernels.traverse import Units, finished, make_intersect, make_probe, no_hit


@cache
def make_struct(record):
    """The structure over records of this kind: all primitives, in the order of prim_id."""

    @wp.struct
    class BruteForce:
        primitives: wp.array(dtype=record)

    return BruteForce


def make_traversal(units: Units, any_hit: bool, accepts=None):
    """The closest hit, or any (the first that is found), among all primitives."""
    probe_of = make_probe(units)
    intersect = make_intersect(units, accepts)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Surfaces, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        for i in range(accel.primitives.shape[0]):
            best = intersect(probe, surfaces, accel.primitives[i], best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return finished(best)

    return traverse
