"""All hits of rays, found by testing every primitive: the reference for structures and walks."""

from typing import Any

import warp as wp

from wrt.kernels.query import RayArrays, direction_scale, load_ray
from wrt.kernels.structs import NO_HIT, Surfaces, kernel
from wrt.kernels.traverse.common import Units, make_intersect, make_probe, no_hit


@wp.struct
class HitList:
    """Up to `capacity` hits of each ray, in the order of prim_id. `count` has the number of all hits, also of those not stored."""

    capacity: int
    count: wp.array(dtype=wp.int32)
    prim_id: wp.array(dtype=wp.int32)
    t: wp.array(dtype=wp.float32)


def make_all_hits_kernel(units: Units) -> Any:
    """Return the kernel that lists every primitive that a ray hits in its segment, by the test units and without a structure."""
    probe_of = make_probe(units)
    intersect = make_intersect(units)
    record = units.triangle_test.record

    @kernel
    def all_hits(primitives: wp.array(dtype=record), surfaces: Surfaces, rays: RayArrays, out: HitList, first: int):
        i = first + wp.tid()
        ray = load_ray(rays, i)
        probe = probe_of(ray)
        n = int(0)
        for j in range(primitives.shape[0]):
            hit = intersect(probe, surfaces, primitives[j], no_hit(ray))
            if hit.prim_id != NO_HIT:
                if n < out.capacity:
                    out.prim_id[i * out.capacity + n] = hit.prim_id
                    out.t[i * out.capacity + n] = hit.t * direction_scale(rays.direction[i])
                n = n + 1
        out.count[i] = n

    return all_hits
