"""The box unit: the test of a ray against an axis-aligned box.

The reciprocal direction is computed once a ray (`BoxRay`); a box then takes three subtractions and three multiplications for each of its
two corners. Distances are (plane - origin) * inv_dir: the cheaper plane * inv_dir - origin * inv_dir cancels, and loses rays. RAY_AABB is
the table of tests.

**What runs.** This file tests one box and one ray, in all structures but bvh4, bvh8 and bvh8c. Those test the children of a node together:
`kernels/wide/nodes.py`, on a CPU `kernels/wide/box.h`. They enter every box that this file enters, at the same distance
(tests/kernels/wide/test_lanes.py); packets have their bits
(tests/kernels/wide/test_packets.py). The whole table: kernels/README.md.
"""

import warp as wp

from wrt.kernels.structs import Ray

# The far distance carries at most 3 rounding errors, and so does the near distance of another axis. The interval is widened by twice that
# (Ize 2013, "Robust BVH Ray Traversal", section 3). Each side grows by 4 more, because the triangle unit rounds sheared vertices in
# proportion to the distance. `padded_lo` and `padded_hi` cover the rest.
FAR_PAD = wp.constant(1.0 + 2.0 * (7.0 * 2.0**-24) / (1.0 - 7.0 * 2.0**-24))

# Powers of two: the host computes the same box to the last bit (wrt.accel.geometry.Geometry.bounds).
PAD_EXTENT = 2.0**-21
PAD_COORDINATE = 2.0**-22
PAD_SMALLEST = 2.0**-148


@wp.struct
class BoxRay:
    """The ray as the box unit reads it."""

    origin: wp.vec3
    inv_dir: wp.vec3  # +-inf for a component of the direction that is +-0.
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
    """Distance by which a primitive's box grows so that it contains every hit that the primitive's unit accepts.

    The triangle unit sees vertices off by up to 3 u of the hit's distance (FAR_PAD covers that) and 5 u of the triangle's extent. The
    extent may be far longer than the ray: a ray that starts just above a floor 1000 wide. Without the pad, a ray through the edge of two
    triangles can go to the triangle whose box it misses, and is lost. The pad is 8 u of the extent; `padded_lo` and `padded_hi` add 4 u of
    the coordinates for the rounding of lo and hi. PAD_SMALLEST covers underflow in the shear; it changes only the pads of triangles below
    2^-103.
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
    """Distances at which the infinite line enters and leaves the box; entry > exit if it misses.
    The direction's sign selects near and far planes. A line in a face gives 0 * inf = NaN for that plane, and comparisons that are false
    for NaN ignore it. An empty box (lo = inf, hi = -inf) is never entered. Monotone to the last bit: a larger box never has a later entry
    or an earlier exit."""
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
def ray_aabb(ray: BoxRay, lo: wp.vec3, hi: wp.vec3, t_max: float) -> float:
    """Distance at which the segment [t_min, t_max] enters the box, or inf if it misses.

    An origin inside gives t_min; an empty box gives inf. Conservative: no ray that meets the box in exact arithmetic is missed. The
    domain: the direction's longest component is between 2^-64 and 2^64 (`kernels.query` scales others), distances to the box are below
    2^126, and coordinates differ by less than 2^127. A component of the direction below 2^-128 counts as 0: its planes are at infinity. A
    ray with NaN may enter: `no_hit` keeps such rays out.
    """
    interval = slab_interval(ray, lo, hi)
    enter = wp.where(interval[0] > ray.t_min, interval[0], ray.t_min)
    leave = interval[1] * FAR_PAD
    leave = wp.where(leave < t_max, leave, t_max)
    return wp.where(enter <= leave, enter, float(wp.inf))


@wp.func
def ray_aabb_plain(ray: BoxRay, lo: wp.vec3, hi: wp.vec3, t_max: float) -> float:
    """Test slab after slab, each pair of distances sorted by comparison (Kay and Kajiya 1986, "Ray Tracing Complex Scenes").
    Returns what `ray_aabb` does, without its margin: rays at edges may be lost, and a ray in a face (0 * inf = NaN) may hit or miss."""
    if lo[0] > hi[0]:
        return float(wp.inf)  # sorted, the distances of an empty box would be those of all space
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
    """Test slabs selected by sign, with comparisons that ignore NaN (Williams et al. 2005).
    Returns what `ray_aabb` does, without its margin: about one ray in 10^7 that grazes an edge is lost."""
    interval = slab_interval(ray, lo, hi)
    enter = wp.where(interval[0] > ray.t_min, interval[0], ray.t_min)
    leave = wp.where(interval[1] < t_max, interval[1], t_max)
    return wp.where(enter <= leave, enter, float(wp.inf))


RAY_AABB = {
    "conservative": ray_aabb,
    "minmax": ray_aabb_minmax,
    "plain": ray_aabb_plain,
}
