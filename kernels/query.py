"""Kernels for rays by themselves: arrays of rays in, hits out."""

import warp as wp

from wrt.kernels.structs import Ray, Surfaces, kernel


@wp.struct
class RayArrays:
    """One ray a row."""

    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_min: wp.array(dtype=wp.float32)
    t_max: wp.array(dtype=wp.float32)


@wp.struct
class HitArrays:
    """One hit a row; a miss has t = inf and prim_id = -1."""

    t: wp.array(dtype=wp.float32)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)
    prim_id: wp.array(dtype=wp.int32)


@wp.func
def load_ray(rays: RayArrays, i: int) -> Ray:
    ray = Ray()
    ray.origin = rays.origin[i]
    ray.direction = rays.direction[i]
    ray.t_min = rays.t_min[i]
    ray.t_max = rays.t_max[i]
    ray.exclude = -1
    return ray


def make_closest_hit_kernel(accel_struct, traverse):
    """rays first .. first + dim - 1 against the structure."""

    @kernel
    def closest_hit(accel: accel_struct, surfaces: Surfaces, rays: RayArrays, hits: HitArrays, first: int):
        i = first + wp.tid()
        hit = traverse(accel, surfaces, load_ray(rays, i))
        hits.t[i] = hit.t
        hits.u[i] = hit.u
        hits.v[i] = hit.v
        hits.prim_id[i] = hit.prim_id

    return closest_hit


def make_any_hit_kernel(accel_struct, traverse):
    """As closest_hit, but only whether there is one."""

    @kernel
    def any_hit(accel: accel_struct, surfaces: Surfaces, rays: RayArrays, dark: wp.array(dtype=wp.bool), first: int):
        i = first + wp.tid()
        hit = traverse(accel, surfaces, load_ray(rays, i))
        dark[i] = hit.prim_id >= 0

    return any_hit
