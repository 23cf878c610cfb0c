"""Ray queries in a user's kernel: records and functions.
The functions scale very short and long directions (query.direction_scale) and traverse the structure for one ray. In a kernel without fused
multiply-add (structs.kernel), their hits equal those of Accelerator.closest_hit to the last bit."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.query import direction_scale, in_world, scaled_ray
from wrt.kernels.structs import Filter, Hit, Ray, Surfaces


@wp.struct
class QueryRay:
    """A ray in world space, and its closed segment [t_min, t_max]. A ray that is not finite, or whose direction is 0, hits nothing."""

    origin: wp.vec3
    direction: wp.vec3  # Any length but 0.
    t_min: float  # At least 0, in units of |direction|.
    t_max: float  # In units of |direction|; may be inf.
    world: int  # Index of the world that the ray sees, in a structure over worlds; in a world that does not exist, it hits nothing.
    exclude: int  # exclude, mask: see structs.Filter. Only functions of `wrt.ray_query(accel, filtered=True)` read them.
    mask: int


@wp.struct
class QueryHit:
    """A hit at (1 - u - v) v0 + u v1 + v v2, or a miss."""

    t: float  # In units of |direction|; inf on a miss.
    u: float
    v: float
    prim_id: int  # Index of the primitive; -1 on a miss.
    scaled_t: float  # t / direction_scale, the t of the scaled ray; next_hit reads it.


@wp.func
def query_ray(origin: wp.vec3, direction: wp.vec3) -> QueryRay:
    """Make a ray from `origin` to infinity: t_min = 0, t_max = inf. It sees all instances of world 0."""
    ray = QueryRay()
    ray.origin = origin
    ray.direction = direction
    ray.t_max = float(wp.inf)
    ray.exclude = -1
    ray.mask = -1
    return ray


# y = 1 + 2^-12: in float32, y * y rounds to 1 + 2^-11, so y * y - (1 + 2^-11) is 0. A fused multiply-add returns 2^-24. The other terms are
# true if the compiler may reassociate, divide by reciprocals, assume that no NaN or infinity exists, or ignore signs of zeros; on a GPU, if
# it replaces 2^-140 by 0. Constant folding never fuses; volatile prevents the folding. The result is the same in each call.
@wp.func_native("""
#if !defined(WRT_INLINE) && !defined(__CUDA_ARCH__)
    return true;  // a kernel made by wp.kernel lacks the headers of wide/
#endif
#if defined(__CUDA_ARCH__)
    volatile float x = 1.000244140625f;
    const float y = x;
    return y * y - 1.00048828125f != 0.0f || y * 0x1p-100f * 0x1p-40f == 0.0f;
#else
    static int known;  // 1: exact, 2: inexact
    if (known == 0) {
        volatile float one = 1.000244140625f, zero = -0.0f, inf = INFINITY, nan = NAN;
        const float y = one, z = zero, i = inf, n = nan;
        known = y * y - 1.00048828125f != 0.0f || (y + 0x1p24f) - 0x1p24f != 2.0f || y / 3.0f != 0x1.556aaap-2f || n == n
                || i != INFINITY || 1.0f / (z + 0.0f) < 0.0f ? 2 : 1;
    }
    return known == 2;
#endif
""")
def inexact() -> bool:
    """Test whether this kernel is compiled with fused multiply-add or fast maths, which let rays slip between neighbouring triangles.
    Also True on a CPU if the kernel was made by wp.kernel."""


@wp.func_native("""
    static const char* const why[] = {"the rays of a kernel hit nothing, because a kernel with ray queries must be made with wrt.kernel,"
                                      " and without fast_math and flags such as -ffast-math in wp.config.cpu_compiler_flags",
                                      "the rays of a kernel hit nothing, because accel.world is of another structure or triangle test"
                                      " than the kernel's functions: make them with wrt.ray_query(accel)"};
    static bool warned[2];
    if (!warned[reason]) printf("wrt: %s\\n", why[reason]);
    warned[reason] = true;
""")
def warn_once(reason: int) -> None: ...


@wp.func
def traversal_ray(ray: QueryRay, is_other: bool) -> Ray:
    """Make the ray for the traversal. In a kernel with inexact arithmetic, or if is_other (World of another type), it hits nothing."""
    out = scaled_ray(ray.origin, ray.direction, ray.t_min, ray.t_max)
    if is_other or inexact():
        warn_once(wp.where(is_other, 1, 0))
        out.direction = wp.vec3(1.0, 1.0, 1.0)  # not NaN, which fast maths does not compare as false
        out.t_min = 0.0
        out.t_max = -1.0
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


class Traversals(NamedTuple):
    """The traversals of one kind of structure, for queries in a user's kernel."""

    struct: Any  # Type of the structure.
    closest: Any
    any_of: Any
    resuming: Any  # Made with Units.resumes.
    instances: bool  # True for structures with instances, whose World has the roots of its worlds.
    filtered: bool  # True if they are made with Units.filtered.
    kind: int  # Identifies these traversals: a World with another `kind` is rejected at run time.


@cache
def make_world(struct: Any) -> Any:
    """Make World for a type of structures."""

    @wp.struct
    class World:
        """A structure and its surfaces, as one argument of a kernel."""

        kind: int  # The query functions compare it with their own `kind`, because Warp does not compare struct types.
        accel: struct
        surfaces: Surfaces
        roots: wp.array(dtype=wp.int32)  # Index of each world's root; only with instances.
        origin: wp.vec3d  # The point that is 0 for the structure: Accelerator.origin.

    return World


def make_ray_query(traversals: Traversals) -> tuple[Any, Any, Any, Any]:
    """Make World, closest_hit, any_hit and next_hit."""
    struct, closest, any_of, resuming, instances, filtered, kind = traversals
    World = make_world(struct)

    def make_trace(traverse: Any) -> Any:
        @wp.func
        def trace(world: World, ray: QueryRay, going: Ray) -> Hit:
            if wp.static(filtered):
                seen = Filter()
                seen.exclude = ray.exclude
                seen.mask = ray.mask
                return traverse(world.accel, seen, going)
            else:
                return traverse(world.accel, world.surfaces, going)

        return trace

    closest, any_of, resuming = map(make_trace, (closest, any_of, resuming))

    @wp.func
    def prepared(world: World, ray: QueryRay) -> Ray:
        """Make the ray for the traversal."""
        out = traversal_ray(ray, world.kind != kind)
        out.origin = wp.vec3(wp.vec3d(ray.origin) - world.origin)
        if wp.static(instances):
            out = in_world(out, world.roots, ray.world)
        return out

    @wp.func
    def closest_hit(world: World, ray: QueryRay) -> QueryHit:
        """Return the closest hit in the ray's segment; of hits at equal t, the one with the lowest prim_id."""
        return make_query_hit(closest(world, ray, prepared(world, ray)), ray.direction)

    @wp.func
    def any_hit(world: World, ray: QueryRay) -> bool:
        """Return True if the ray hits anything in its segment."""
        hit = any_of(world, ray, prepared(world, ray))
        return hit.prim_id >= 0

    @wp.func
    def next_hit(world: World, ray: QueryRay, hit: QueryHit) -> QueryHit:
        """Return the next hit of this ray after `hit`, in the order of t and, at equal t, of prim_id. Start with the closest hit, and
        repeated calls return each hit of the segment once. Each call starts at the root and repeats the tests at the same t, so k hits at
        one t take k^2 tests. The function `wrt.all_hits` stores the hits, and takes k log k steps."""
        going = prepared(world, ray)
        going.t_min = hit.scaled_t
        going.slot = hit.prim_id + 1
        return make_query_hit(resuming(world, ray, going), ray.direction)

    return World, closest_hit, any_hit, next_hit
