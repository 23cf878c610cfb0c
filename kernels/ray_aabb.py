"""The box unit: does a ray meet an axis-aligned box?

The ray's reciprocal direction is taken once a ray (`BoxRay`); a box is then three subtractions and three multiplications
for each of its two corners. Planes are tested as (plane - origin) * inv_dir: the form plane * inv_dir - origin * inv_dir
saves an operation and loses rays by cancellation.
"""

import warp as wp

from wrt.kernels.structs import Ray

# The far distance carries at most 3 rounding errors, and so does the near one of another axis: the interval is widened by
# twice that (Ize 2013, "Robust BVH Ray Traversal", section 3). The two more on each side cover the rounding of the
# vertices' sheared coordinates in the triangle unit, so that a hit which that unit accepts is never outside its box.
FAR_PAD = wp.constant(1.0 + 2.0 * (5.0 * 2.0**-24) / (1.0 - 5.0 * 2.0**-24))


@wp.struct
class BoxRay:
    """What the box unit needs of a ray. inv_dir is +-inf where a component of the direction is +-0."""

    origin: wp.vec3
    inv_dir: wp.vec3
    t_min: float


@wp.func
def box_ray(ray: Ray) -> BoxRay:
    """Set-up, once a ray."""
    out = BoxRay()
    out.origin = ray.origin
    out.inv_dir = wp.vec3(1.0 / ray.direction[0], 1.0 / ray.direction[1], 1.0 / ray.direction[2])
    out.t_min = ray.t_min
    return out


@wp.func
def slab_interval(ray: BoxRay, lo: wp.vec3, hi: wp.vec3) -> wp.vec2:
    """Distances at which the infinite line enters and leaves the box; entry > exit where it passes by.

    The planes are chosen by the sign of the direction. A line that lies in a face gives 0 * inf = NaN there: such a plane
    says nothing, and comparisons that are false for NaN pass over it. An empty box (lo = inf, hi = -inf) is never entered.
    Monotone: for a larger box the first is not larger and the second not smaller, to the last bit.
    """
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
    """Distance at which the segment [t_min, t_max] enters the box, or inf where it misses.

    An origin inside is a hit (entry t_min). Conservative: no ray that meets the box in exact arithmetic is missed.
    """
    interval = slab_interval(ray, lo, hi)
    enter = wp.where(interval[0] > ray.t_min, interval[0], ray.t_min)
    leave = interval[1] * FAR_PAD
    leave = wp.where(leave < t_max, leave, t_max)
    return wp.where(enter <= leave, enter, float(wp.inf))
