"""Rays that go on from where others hit, as the integrator's do: does one meet the surface that it leaves?"""

from typing import Any

import warp as wp

from wrt.kernels.query import RayArrays, load_ray
from wrt.kernels.shade.surface import spawn_point
from wrt.kernels.structs import Surfaces, kernel, make_ray


@wp.struct
class Respawn:
    """Where rays go on from their hits; exclude: 1 to leave out the triangle that they start on, as the integrator does."""

    direction: wp.array(dtype=wp.vec3)
    exclude: int
    first_prim_id: wp.array(dtype=wp.int32)
    next_prim_id: wp.array(dtype=wp.int32)


def make_respawn_kernel(accel_struct: Any, traverse: Any, surface_at: Any) -> Any:
    """The hit of each ray, and the hit of a second one that leaves from there as the integrator's do; -1 on a miss.

    On a sphere the second direction is turned to the outside: towards the inside it would hit the far wall, rightly.
    """

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
