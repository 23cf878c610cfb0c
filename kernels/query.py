"""Kernels of ray queries: they read arrays of rays and write arrays of hits."""

from typing import Any

import warp as wp

from wrt.kernels.structs import Filter, Hit, Ray, Surfaces, kernel, query_kernel

LARGEST = wp.constant(3.4028234663852886e38)  # Largest finite float32.
FARTHEST = 1e37  # Largest absolute coordinate of an origin in a NumPy array: the difference of two coordinates stays finite.
# Function direction_scale multiplies directions shorter than SHORTEST by LENGTHEN, and directions longer than LONGEST by SHORTEN.
SHORTEST, LONGEST = 2.0**-64, 2.0**64
LENGTHEN, SHORTEN = 2.0**96, 2.0**-64


@wp.struct
class RayArrays:
    """Rays of a query in world space; t is in units of the direction's length. t_min and t_max may have stride 0: one value for all."""

    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_min: wp.array(dtype=wp.float32)
    t_max: wp.array(dtype=wp.float32)


@wp.struct
class WorldRays:
    """Rays of a query, as in RayArrays, and the index of each ray's world; `world` may have stride 0, too."""

    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_min: wp.array(dtype=wp.float32)
    t_max: wp.array(dtype=wp.float32)
    world: wp.array(dtype=wp.int32)


@wp.struct
class FilteredRays:
    """Rays of a query, as in WorldRays, and their structs.Filter; these arrays may have stride 0, too."""

    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_min: wp.array(dtype=wp.float32)
    t_max: wp.array(dtype=wp.float32)
    world: wp.array(dtype=wp.int32)
    exclude: wp.array(dtype=wp.int32)
    mask: wp.array(dtype=wp.int32)


@wp.struct
class RenderRays:
    """Rays of a picture, in world space. The traversal uses their directions as they are, without direction_scale."""

    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_min: wp.array(dtype=wp.float32)
    t_max: wp.array(dtype=wp.float32)
    exclude: wp.array(dtype=wp.int32)  # Values of Ray.exclude_plus_one.


@wp.struct
class HitArrays:
    """Hits, one per ray: see structs.Hit. A miss has t = inf and prim_id = -1."""

    t: wp.array(dtype=wp.float32)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)
    prim_id: wp.array(dtype=wp.int32)


@wp.func
def direction_scale(direction: wp.vec3) -> float:
    """Return a power of two by which to multiply a very short or long direction; 1 for other directions.
    It keeps the longest component between 2^-64 and 2^64, so that its reciprocal is neither denormal nor infinite. The product is exact,
    except in components that become denormal. These are off by up to 2^-150, and then the longest component is at least 1."""
    longest = wp.abs(direction[0])
    longest = wp.where(wp.abs(direction[1]) > longest, wp.abs(direction[1]), longest)
    longest = wp.where(wp.abs(direction[2]) > longest, wp.abs(direction[2]), longest)
    short = wp.where(longest < wp.static(SHORTEST), wp.static(LENGTHEN), 1.0)
    return wp.where(longest > wp.static(LONGEST), wp.static(SHORTEN), short)


@wp.func
def scaled_ray(origin: wp.vec3, direction: wp.vec3, t_min: float, t_max: float) -> Ray:
    """Make a ray whose direction is multiplied by `direction_scale`. The ray's t times this scale is t in units of the caller's direction.
    The segment ends where the caller's t would exceed the largest float32, so no traversal returns a hit beyond that end."""
    scale = direction_scale(direction)
    inverse = wp.where(scale > 1.0, wp.static(1.0 / LENGTHEN), wp.where(scale < 1.0, wp.static(1.0 / SHORTEN), 1.0))
    ray = Ray()
    ray.origin = origin
    ray.direction = scale * direction
    ray.t_min = t_min * inverse
    ray.t_max = wp.where(t_max > LARGEST, LARGEST, t_max) * inverse
    return ray


@wp.func
def load_ray(rays: RayArrays, i: int) -> Ray:
    ray = scaled_ray(rays.origin[i], rays.direction[i], rays.t_min[i], rays.t_max[i])
    ray.slot = i
    return ray


def make_closest_hit_kernel(accel_struct: Any, traverse: Any) -> Any:
    """Make the kernel that stores the closest hits of rays first .. first + dim - 1, for the launch size dim."""

    @query_kernel
    def closest_hit(accel: accel_struct, surfaces: Surfaces, rays: RayArrays, hits: HitArrays, first: int):
        i = first + wp.tid()
        scale = direction_scale(rays.direction[i])
        hit = traverse(accel, surfaces, load_ray(rays, i))
        store_hit(hits, i, hit, scale)

    return closest_hit


def make_any_hit_kernel(accel_struct: Any, traverse: Any) -> Any:
    """Make the kernel that stores whether each of the rays first .. first + dim - 1 hits anything, for the launch size dim."""

    @query_kernel
    def any_hit(accel: accel_struct, surfaces: Surfaces, rays: RayArrays, occluded: wp.array(dtype=wp.bool), first: int):
        i = first + wp.tid()
        hit = traverse(accel, surfaces, load_ray(rays, i))
        occluded[i] = hit.prim_id >= 0

    return any_hit


@wp.struct
class Worlds:
    """The world of each ray, in a structure that holds several scenes ("worlds")."""

    id: wp.array(dtype=wp.int32)  # Index of each ray's world; with a stride of 0, one world for all rays.
    root: wp.array(dtype=wp.int32)  # Index of each world's root node.
    exclude: wp.array(dtype=wp.int32)  # exclude, mask: of each ray's structs.Filter. Read only if the traversal is filtered.
    mask: wp.array(dtype=wp.int32)


@wp.func
def in_world(ray: Ray, root: wp.array(dtype=wp.int32), world: int) -> Ray:
    """Set first_prim to the root node of the world. If that world does not exist, the ray hits nothing."""
    if world >= 0 and world < root.shape[0]:
        ray.first_prim = root[world]
    else:
        ray.direction = wp.vec3(wp.nan, wp.nan, wp.nan)
    return ray


@wp.func
def load_ray_of_world(rays: RayArrays, worlds: Worlds, i: int) -> Ray:
    """Load ray i, in its world."""
    return in_world(load_ray(rays, i), worlds.root, worlds.id[i])


def make_worlds_kernel(accel_struct: Any, traverse: Any, any_hit: bool, filtered: bool) -> Any:
    """Make the kernel that traces each ray in its own world. filtered: see Units.
    Its argument `out` is HitArrays or, with any_hit, an array of bool."""
    out_type = wp.array(dtype=wp.bool) if any_hit else HitArrays

    @query_kernel
    def trace_worlds(accel: accel_struct, surfaces: Surfaces, rays: RayArrays, worlds: Worlds, out: out_type, first: int):
        i = first + wp.tid()
        if wp.static(filtered):
            unseen = Filter()
            unseen.exclude = worlds.exclude[i]
            unseen.mask = worlds.mask[i]
            hit = traverse(accel, unseen, load_ray_of_world(rays, worlds, i))
        else:
            hit = traverse(accel, surfaces, load_ray_of_world(rays, worlds, i))
        if wp.static(any_hit):
            out[i] = hit.prim_id >= 0
        else:
            store_hit(out, i, hit, direction_scale(rays.direction[i]))

    return trace_worlds


@wp.func
def load_render_ray(rays: RenderRays, i: int) -> Ray:
    ray = Ray()
    ray.origin = rays.origin[i]
    ray.direction = rays.direction[i]
    ray.t_min = rays.t_min[i]
    ray.t_max = rays.t_max[i]
    ray.exclude_plus_one = rays.exclude[i]
    return ray


@wp.func
def store_render_ray(rays: RenderRays, i: int, ray: Ray):
    """Store all fields of a ray except t_min, which is 0 for all rays of a picture."""
    rays.origin[i] = ray.origin
    rays.direction[i] = ray.direction
    rays.t_max[i] = ray.t_max
    rays.exclude[i] = ray.exclude_plus_one


@wp.func
def load_hit(hits: HitArrays, i: int) -> Hit:
    hit = Hit()
    hit.t = hits.t[i]
    hit.u = hits.u[i]
    hit.v = hits.v[i]
    hit.prim_id = hits.prim_id[i]
    return hit


@wp.func
def store_hit(hits: HitArrays, i: Any, hit: Any, scale: float):
    """Store a hit with t multiplied by `scale`; i is int or int64, `hit` a Hit or a QueryHit."""
    hits.t[i] = hit.t * scale
    hits.u[i] = hit.u
    hits.v[i] = hit.v
    hits.prim_id[i] = hit.prim_id


def make_render_rays_kernel(accel_struct: Any, traverse: Any, any_hit: bool) -> Any:
    """Make the kernel that traces rays first .. end - 1 of a picture, one ray per thread. Its `out` is HitArrays or, with any_hit, bool."""
    out_type = wp.array(dtype=wp.bool) if any_hit else HitArrays

    @kernel
    def trace_render_rays(accel: accel_struct, surfaces: Surfaces, rays: RenderRays, out: out_type, first: int, end: int):
        i = first + wp.tid()
        hit = traverse(accel, surfaces, load_render_ray(rays, i))
        if wp.static(any_hit):
            out[i] = hit.prim_id >= 0
        else:
            store_hit(out, i, hit, 1.0)

    return trace_render_rays


@kernel
def subtract_origin_of_doubles(points: wp.array(dtype=wp.vec3d), origin: wp.vec3d, out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = wp.vec3(points[i] - origin)


@kernel
def subtract_origin_of_floats(points: wp.array(dtype=wp.vec3), origin: wp.vec3d, out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = wp.vec3(wp.vec3d(points[i]) - origin)


subtract_origin = {wp.vec3: subtract_origin_of_floats, wp.vec3d: subtract_origin_of_doubles}


@kernel
def add_origin(points: wp.array(dtype=wp.vec3), origin: wp.vec3d, out: wp.array(dtype=wp.vec3d)):
    i = wp.tid()
    out[i] = wp.vec3d(points[i]) + origin
