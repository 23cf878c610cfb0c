"""Rays that start at hits of other rays, as in a render, to test that they do not hit the surface that they leave."""

from typing import Any

import warp as wp

from wrt.kernels.query import RayArrays, load_ray
from wrt.kernels.shade.surface import spawn_point
from wrt.kernels.structs import Surfaces, kernel, make_ray


@wp.struct
class Respawn:
    """Directions of the second rays, and the hits of first and second rays."""

    direction: wp.array(dtype=wp.vec3)
    exclude: int  # 1: a second ray excludes the triangle that it starts on, as in a render; 0: it does not.
    first_prim_id: wp.array(dtype=wp.int32)  # Hits of the first rays; -1 on a miss.
    next_prim_id: wp.array(dtype=wp.int32)  # Hits of the second rays; -1 on a miss.


def make_respawn_kernel(accel_struct: Any, traverse: Any, surface_at: Any) -> Any:
    """Make the kernel that stores the hit of each ray, and the hit of a second ray that starts at the first hit.
    On a sphere, the second direction is turned outwards, because an inward ray correctly hits the sphere again."""

    @kernel
    def respawn(accel: accel_struct, surfaces: Surfaces, rays: RayArrays, out: Respawn, first: int):
        i = first + wp.tid()
        ray = load_ray(rays, i)
        hit = traverse(accel, surfaces, ray)
        out.first_prim_id[i] = hit.prim_id
        out.next_prim_id[i] = -1
        if hit.prim_id >= 0:
            s = surface_at(surfaces, ray, hit)
            outward = wp.where(s.front != 0, 1.0, -1.0) * s.geometric
            d = out.direction[i]
            if hit.prim_id >= surfaces.n_triangles and wp.dot(d, outward) < 0.0:
                d = -d
            next = make_ray(spawn_point(s.point, s.error, s.geometric, d), d)
            next.exclude_plus_one = wp.where(out.exclude != 0, s.exclude_plus_one, 0)
            out.next_prim_id[i] = traverse(accel, surfaces, next).prim_id

    return respawn
