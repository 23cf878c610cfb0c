"""Ray queries in a user's kernel: records and functions.
The functions call the traversal units for one ray, with the scaling of extreme directions. Hits have the bits of Accelerator.closest_hit,
if the kernel is compiled without fused multiply-add (structs.kernel)."""

from typing import Any

import warp as wp

from wrt.kernels.query import direction_scale, scaled_ray
from wrt.kernels.structs import Hit, Ray, Surfaces


@wp.struct
class QueryRay:
    """A ray in world space, and its closed segment [t_min, t_max]. A ray that is not finite, or whose direction is 0, hits nothing."""

    origin: wp.vec3
    direction: wp.vec3  # Any length.
    t_min: float  # In units of |direction|, as t_max; >= 0.
    t_max: float


@wp.struct
class QueryHit:
    """A hit at (1 - u - v) v0 + u v1 + v v2, or a miss."""

    t: float  # In units of |direction|; inf on a miss.
    u: float
    v: float
    prim_id: int  # Index of the primitive; -1 on a miss.
    scaled_t: float  # t in the traversal's units, for next_hit.


@wp.func
def query_ray(origin: wp.vec3, direction: wp.vec3) -> QueryRay:
    """Make a ray from the origin to infinity."""
    ray = QueryRay()
    ray.origin = origin
    ray.direction = direction
    ray.t_max = float(wp.inf)
    return ray


# In float32, (1 + 2^-12)^2 is 1 + 2^-11; a fused subtraction leaves 2^-24. volatile keeps the compiler, which never fuses, from folding
# it.
@wp.func_native("""
#if !defined(WRT_INLINE) && !defined(__CUDA_ARCH__)
    return true;  // made by wp.kernel, without the headers of wide/
#endif
    volatile float x = 1.000244140625f;
    const float y = x;
    return y * y - 1.00048828125f != 0.0f;
""")
def fused() -> bool:
    """Test whether this kernel is compiled with fused multiply-add, which would lose rays at edges."""


@wp.func_native("""
    static const char* const why[] = {"a kernel that asks for hits must be made with wrt.kernel: fused multiply-add loses rays",
                                      "accel.world is of another structure or triangle test than the kernel's wrt.ray_query"};
    static bool warned[2];
    if (!warned[reason]) printf("wrt: %s\\n", why[reason]);
    warned[reason] = true;
""")
def warn_once(reason: int) -> None: ...


@wp.func
def traversal_ray(ray: QueryRay, is_other: bool) -> Ray:
    """Make the traversal's ray; if the kernel is not compiled as required, or the world is another one, a ray that hits nothing."""
    out = scaled_ray(ray.origin, ray.direction, ray.t_min, ray.t_max)
    if is_other or fused():
        warn_once(wp.where(is_other, 1, 0))
        out.direction = wp.vec3(wp.nan, wp.nan, wp.nan)
    return out


@wp.func
def make_query_hit(hit: Hit, direction: wp.vec3) -> QueryHit:
    out = QueryHit()
    out.t = hit.t * direction_scale(direction)
    out.u = hit.u
    out.v = hit.v
    out.prim_id = hit.prim_id
    out.scaled_t = hit.t
    return out


def make_ray_query(accel_struct: Any, closest: Any, any_of: Any, resuming: Any, kind: int) -> tuple[Any, Any, Any, Any]:
    """Make World, closest_hit, any_hit, next_hit from traversal units; `resuming` is made with Units.resumes. A World must have the same
    `kind`, a number of these units."""

    @wp.struct
    class World:
        """A structure and its surfaces, as one argument of a kernel."""

        kind: int  # Compared by wrt, because Warp does not compare the types of records.
        accel: accel_struct
        surfaces: Surfaces

    @wp.func
    def closest_hit(world: World, ray: QueryRay) -> QueryHit:
        """Closest hit in the segment; the lowest prim_id at equal t."""
        return make_query_hit(closest(world.accel, world.surfaces, traversal_ray(ray, world.kind != kind)), ray.direction)

    @wp.func
    def any_hit(world: World, ray: QueryRay) -> bool:
        """Return True if anything is hit in the segment."""
        hit = any_of(world.accel, world.surfaces, traversal_ray(ray, world.kind != kind))
        return hit.prim_id >= 0

    @wp.func
    def next_hit(world: World, ray: QueryRay, hit: QueryHit) -> QueryHit:
        """Next hit of this ray after `hit`, in the order of t and, at equal t, of prim_id. From the closest hit on, calls return each hit
        of the segment once. Each call walks from the root and repeats the tests at the same t: k hits at one t take k^2 tests. With
        storage for them, `wrt.all_hits` takes k log k steps."""
        going = traversal_ray(ray, world.kind != kind)
        going.t_min = hit.scaled_t
        going.slot = hit.prim_id + 1
        return make_query_hit(resuming(world.accel, world.surfaces, going), ray.direction)

    return World, closest_hit, any_hit, next_hit
