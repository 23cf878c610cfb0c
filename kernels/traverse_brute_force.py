"""The traversal unit without a structure: every primitive is tested. The yardstick for all others."""

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Primitive, Ray, Surfaces
from wrt.kernels.traverse import finished, make_intersect, make_probe, no_hit


@wp.struct
class BruteForce:
    """All primitives, in the order of prim_id."""

    primitives: wp.array(dtype=Primitive)


def make_traversal(any_hit: bool, with_spheres: bool, accepts=None):
    """The closest hit, or any (the first that is found), among all primitives."""
    intersect = make_intersect(with_spheres, accepts)

    @wp.func
    def traverse(accel: BruteForce, surfaces: Surfaces, ray: Ray) -> Hit:
        probe = make_probe(ray)
        best = no_hit(ray)
        for i in range(accel.primitives.shape[0]):
            best = intersect(probe, surfaces, accel.primitives[i], best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return finished(best)

    return traverse
