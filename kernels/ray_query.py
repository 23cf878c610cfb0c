"""Queries from inside a kernel of one's own: the functions, and what they take and give.

They are the traversal units for one ray, with the scaling that extreme directions need: the answers have the bits of
Accelerator.closest_hit, if the kernel is compiled without fused multiply-add (structs.kernel).
"""

from typing import Any

import warp as wp

from wrt.kernels.query import direction_scale, scaled_ray
from wrt.kernels.structs import Hit, Ray, Surfaces


@wp.struct
class QueryRay:
    """origin, direction: in world space, the direction of any length; the closed segment from t_min (>= 0) to t_max, in units of
    |direction|. What is not finite hits nothing, nor does a direction of 0."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float


@wp.struct
class QueryHit:
    """t: in units of |direction|, inf on a miss; prim_id: -1 on a miss; the point is (1 - u - v) v0 + u v1 + v v2. scaled_t: t in
    the traversal's units, which next_hit goes on from."""

    t: float
    u: float
    v: float
    prim_id: int
    scaled_t: float


@wp.func
def query_ray(origin: wp.vec3, direction: wp.vec3) -> QueryRay:
    """From the origin to infinity."""
    ray = QueryRay()
    ray.origin = origin
    ray.direction = direction
    ray.t_max = float(wp.inf)
    return ray


# 1 + 2^-12 squared is 1 + 2^-11 in float32, and 2^-24 more where the subtraction is fused with it. Volatile: or the compiler, which
# never fuses, would reckon.
@wp.func_native("""
#if !defined(WRT_INLINE) && !defined(__CUDA_ARCH__)
    return true;  // made by wp.kernel, without the headers of wide/
#endif
    volatile float x = 1.000244140625f;
    const float y = x;
    return y * y - 1.00048828125f != 0.0f;
""")
def fused() -> bool:
    """Whether this kernel is compiled with fused multiply-add, with which rays would be lost at edges."""


@wp.func_native("""
    static const char* const why[] = {"a kernel that asks for hits must be made with wrt.kernel: fused multiply-add loses rays",
                                      "accel.world is of another structure or triangle test than the kernel's wrt.ray_query"};
    static bool told[2];
    if (!told[reason]) printf("wrt: %s\\n", why[reason]);
    told[reason] = true;
""")
def say_once(reason: int) -> None: ...


@wp.func
def traversed(ray: QueryRay, is_other: bool) -> Ray:
    """As the traversal units take it; a ray that hits nothing where the kernel is not compiled as it must be, and where the world
    is another one."""
    out = scaled_ray(ray.origin, ray.direction, ray.t_min, ray.t_max)
    if is_other or fused():
        say_once(wp.where(is_other, 1, 0))
        out.direction = wp.vec3(wp.nan, wp.nan, wp.nan)
    return out


@wp.func
def as_asked(hit: Hit, direction: wp.vec3) -> QueryHit:
    out = QueryHit()
    out.t = hit.t * direction_scale(direction)
    out.u = hit.u
    out.v = hit.v
    out.prim_id = hit.prim_id
    out.scaled_t = hit.t
    return out


def make_ray_query(accel_struct: Any, closest: Any, any_of: Any, resuming: Any, kind: int) -> tuple[Any, Any, Any, Any]:
    """World, closest_hit, any_hit, next_hit. closest, any_of, resuming: traversal units, the last one with Units.resumes; kind: a
    number of theirs, which a World must have."""

    @wp.struct
    class World:
        """A structure and what it is over: one argument of a kernel. kind: Warp does not compare records."""

        kind: int
        accel: accel_struct
        surfaces: Surfaces

    @wp.func
    def closest_hit(world: World, ray: QueryRay) -> QueryHit:
        """The closest hit in the segment; at equal t the lowest prim_id."""
        return as_asked(closest(world.accel, world.surfaces, traversed(ray, world.kind != kind)), ray.direction)

    @wp.func
    def any_hit(world: World, ray: QueryRay) -> bool:
        """Whether there is a hit in the segment."""
        hit = any_of(world.accel, world.surfaces, traversed(ray, world.kind != kind))
        return hit.prim_id >= 0

    @wp.func
    def next_hit(world: World, ray: QueryRay, hit: QueryHit) -> QueryHit:
        """The first hit after one that this ray gave, in the order of t and, where that is equal, of prim_id: from the closest hit
        on, each hit of the segment once. It walks from the root and tests again all that is hit at the same t: k hits at one t take
        k^2 tests in all (wrt.all_hits, which has storage, takes k log k steps)."""
        going = traversed(ray, world.kind != kind)
        going.t_min = hit.scaled_t
        going.slot = hit.prim_id + 1
        return as_asked(resuming(world.accel, world.surfaces, going), ray.direction)

    return World, closest_hit, any_hit, next_hit
