"""The box unit: the test of a ray against an axis-aligned box. RAY_AABB is the table of box tests.

`BoxRay` holds the reciprocal direction, computed once per ray. A box then takes three subtractions and three multiplications for each of
its two corners. Distances are (plane - origin) * inv_dir. The cheaper plane * inv_dir - origin * inv_dir suffers from cancellation, and
loses rays.

**What runs.** All structures except bvh4, bvh8 and bvh8c call this file, for one box and one ray. These three test all children of a node
together, in `kernels/wide/nodes.py` and, on a CPU, `kernels/wide/box.h`. There, a ray enters every box that it enters here, at the same
distance (tests/kernels/wide/test_lanes.py, tests/kernels/wide/test_packets.py). The table of all cases is in kernels/README.md.
"""

from typing import Any

import warp as wp

from wrt.kernels.structs import Ray

# Factor of far distances. Far and near distances carry at most 3 rounding errors each, so the interval grows by 2 * 3 errors (Ize 2013,
# "Robust BVH Ray Traversal", section 3). Each end grows by 4 more errors, because the triangle unit rounds sheared vertices in proportion
# to the distance. `padded_lo` and `padded_hi` cover errors in proportion to the box.
FAR_PAD = wp.constant(1.0 + 2.0 * (7.0 * 2.0**-24) / (1.0 - 7.0 * 2.0**-24))

# Factors of box_pad. They are powers of two, so that the host computes the same bits (wrt.accel.geometry.Geometry.bounds).
PAD_EXTENT = 2.0**-21
PAD_COORDINATE = 2.0**-22
PAD_SMALLEST = 2.0**-148


@wp.func
def half_area(extent: Any) -> Any:
    """Return half the surface area of a box with this extent (vec3 or vec3d). The host calls half_area.func with (3, ...) arrays."""
    return extent[0] * extent[1] + extent[1] * extent[2] + extent[2] * extent[0]


@wp.struct
class BoxRay:
    """A ray set up for the box unit."""

    origin: wp.vec3
    inv_dir: wp.vec3  # 1 / direction; +-inf where the direction's component is +-0.
    t_min: float


@wp.func
def box_ray(ray: Ray) -> BoxRay:
    """Set up a ray for the box unit."""
    out = BoxRay()
    out.origin = ray.origin
    out.inv_dir = wp.vec3(1.0 / ray.direction[0], 1.0 / ray.direction[1], 1.0 / ray.direction[2])
    out.t_min = ray.t_min
    return out


@wp.func
def box_pad(lo: wp.vec3, hi: wp.vec3) -> float:
    """Return the distance by which to grow a primitive's box lo .. hi, so that it contains every hit that the triangle unit accepts.

    In the triangle unit, vertices are off by up to 3 u of the hit's distance, which FAR_PAD covers, and by 5 u of the triangle's extent
    (u = 2^-24). The extent may be far longer than the ray, for example on a floor of width 1000 just below the ray's origin. Without the
    pad, a ray through the common edge of two triangles may hit only the triangle whose box it misses, and would be lost. The pad is 8 u of
    the extent. `padded_lo` and `padded_hi` add 4 u of the coordinates, for the rounding of lo and hi. PAD_SMALLEST covers underflow in the
    shear; it matters only for triangles smaller than 2^-103.
    """
    e = hi - lo
    return wp.static(PAD_EXTENT) * wp.max(wp.max(e[0], e[1]), e[2]) + wp.static(PAD_SMALLEST)


@wp.func
def padded_lo(lo: wp.vec3, pad: float) -> wp.vec3:
    return lo - (wp.vec3(pad, pad, pad) + wp.static(PAD_COORDINATE) * wp.abs(lo))


@wp.func
def padded_hi(hi: wp.vec3, pad: float) -> wp.vec3:
    return hi + (wp.vec3(pad, pad, pad) + wp.static(PAD_COORDINATE) * wp.abs(hi))


@wp.func
def slab_interval(ray: BoxRay, lo: wp.vec3, hi: wp.vec3) -> wp.vec2:
    """Return (entry, exit): t where the infinite line enters and leaves the box; entry > exit if it misses the box.
    The direction's signs select near and far planes. If the line lies in a face, the distance to that plane is 0 * inf = NaN, and the
    comparisons below ignore NaN. No line enters an empty box (lo = inf, hi = -inf). Monotone to the last bit: a larger box never has a
    later entry or an earlier exit."""
    near_x = wp.where(ray.inv_dir[0] < 0.0, hi[0], lo[0])
    near_y = wp.where(ray.inv_dir[1] < 0.0, hi[1], lo[1])
    near_z = wp.where(ray.inv_dir[2] < 0.0, hi[2], lo[2])
    far_x = wp.where(ray.inv_dir[0] < 0.0, lo[0], hi[0])
    far_y = wp.where(ray.inv_dir[1] < 0.0, lo[1], hi[1])
    far_z = wp.where(ray.inv_dir[2] < 0.0, lo[2], hi[2])

    enter_x = (near_x - ray.origin[0]) * ray.inv_dir[0]
    enter_y = (near_y - ray.origin[1]) * ray.inv_dir[1]
    enter_z = (near_z - ray.origin[2]) * ray.inv_dir[2]
    enter = float(-wp.inf)
    enter = wp.where(enter_x > enter, enter_x, enter)
    enter = wp.where(enter_y > enter, enter_y, enter)
    enter = wp.where(enter_z > enter, enter_z, enter)

    leave_x = (far_x - ray.origin[0]) * ray.inv_dir[0]
    leave_y = (far_y - ray.origin[1]) * ray.inv_dir[1]
    leave_z = (far_z - ray.origin[2]) * ray.inv_dir[2]
    leave = float(wp.inf)
    leave = wp.where(leave_x < leave, leave_x, leave)
    leave = wp.where(leave_y < leave, leave_y, leave)
    leave = wp.where(leave_z < leave, leave_z, leave)
    return wp.vec2(enter, leave)


@wp.func
def entry_of(enter: float, leave: float, t_min: float, t_max: float) -> float:
    """Return where the segment [t_min, t_max] enters the interval [enter, leave]; inf if they do not meet."""
    begin = wp.where(enter > t_min, enter, t_min)
    end = wp.where(leave < t_max, leave, t_max)
    return wp.where(begin <= end, begin, float(wp.inf))


@wp.func
def ray_aabb(ray: BoxRay, lo: wp.vec3, hi: wp.vec3, t_max: float) -> float:
    """Return t where the segment [t_min, t_max] enters the box: t_min for an origin inside, inf for a miss or an empty box.

    Conservative: every ray that meets the box in exact arithmetic enters it. Domain: the direction's longest component is between 2^-64
    and 2^64 (`kernels.query` scales other directions). Distances to the box are below 2^126, and coordinates differ by less than 2^127. A
    component of the direction below 2^-128 counts as 0, with its planes at infinity. A ray with NaN may enter; `traverse.common.no_hit`
    gives such a ray an empty segment.
    """
    interval = slab_interval(ray, lo, hi)
    return entry_of(interval[0], interval[1] * FAR_PAD, ray.t_min, t_max)


@wp.func
def ray_aabb_plain(ray: BoxRay, lo: wp.vec3, hi: wp.vec3, t_max: float) -> float:
    """Test one slab after another, and sort each pair of distances (Kay and Kajiya 1986, "Ray Tracing Complex Scenes").
    The result is as in `ray_aabb`, but without margin: rays at edges may be lost, and a ray in a face (0 * inf = NaN) may hit or miss."""
    if lo[0] > hi[0]:
        return float(wp.inf)  # an empty box: after sorting, its distances would be -inf and inf
    enter = float(ray.t_min)
    leave = float(t_max)
    for axis in range(3):
        t_0 = (lo[axis] - ray.origin[axis]) * ray.inv_dir[axis]
        t_1 = (hi[axis] - ray.origin[axis]) * ray.inv_dir[axis]
        if t_0 > t_1:
            swap = t_0
            t_0 = t_1
            t_1 = swap
        if not t_0 <= enter:
            enter = t_0
        if not t_1 >= leave:
            leave = t_1
        if not enter <= leave:
            return float(wp.inf)
    return enter


@wp.func
def ray_aabb_minmax(ray: BoxRay, lo: wp.vec3, hi: wp.vec3, t_max: float) -> float:
    """Select near and far planes by the direction's signs, and ignore NaN (Williams et al. 2005).
    The result is as in `ray_aabb`, but without margin: of the rays that graze an edge, about one in 10^7 is lost."""
    interval = slab_interval(ray, lo, hi)
    return entry_of(interval[0], interval[1], ray.t_min, t_max)


RAY_AABB = {
    "conservative": ray_aabb,
    "minmax": ray_aabb_minmax,
    "plain": ray_aabb_plain,
}
