"""The unit of a 14-DOP: does a ray meet a box whose eight corners are cut off by planes askew?

A k-DOP (Kay and Kajiya 1986, "Ray Tracing Complex Scenes"; the name is from Klosowski et al. 1998) is where k/2 slabs meet: here
the box's three and four more, across its diagonals (1, 1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1), which `project` takes.
Projections are taken from a point in the middle of everything, so that their rounding does not grow with the distance from 0.
"""

import warp as wp

from wrt.kernels.structs import Ray
from wrt.kernels.units.box import FAR_PAD, PAD_SMALLEST, BoxRay, slab_interval

# In units of 2^-24. What a projected plane may be off by, of the sum of the origin's coordinates: 9 for where the triangle unit
# sees the corners along the ray (3 of the distance in each coordinate), 3 for the direction's projection, 2 for the origin's,
# 3 for the distance to the plane and 6 for its comparison with those to the box: less than 32. And so much of the
# primitive's own coordinates, with 33 more for its extent (5 of it in each coordinate) and its projections: less than 64.
RAY_PAD = wp.constant(2.0**-19)
# What underflows may put each of three coordinates off by box.PAD_SMALLEST, whatever their size.
RAY_PAD_SMALLEST = wp.constant(4.0 * PAD_SMALLEST)
KDOP_PAD = 2.0**-18


@wp.struct
class KdopRay:
    """What the test needs of a ray: origin, inv_dir: of its projections; pad: what the planes are moved out by."""

    box: BoxRay
    origin: wp.vec4
    inv_dir: wp.vec4
    pad: float


@wp.func
def project(v: wp.vec3) -> wp.vec4:
    """The coordinates of v along the four diagonals, unnormalised."""
    return wp.vec4(v[0] + v[1] + v[2], v[1] - v[0] + v[2], v[0] - v[1] + v[2], v[0] + v[1] - v[2])


@wp.func
def kdop_ray(ray: Ray, box: BoxRay, middle: wp.vec3) -> KdopRay:
    """Set-up, once a ray; middle: what the planes are relative to."""
    out = KdopRay()
    origin = ray.origin - middle
    direction = project(ray.direction)
    out.box = box
    out.origin = project(origin)
    out.inv_dir = wp.vec4(1.0 / direction[0], 1.0 / direction[1], 1.0 / direction[2], 1.0 / direction[3])
    out.pad = RAY_PAD * (wp.abs(origin[0]) + wp.abs(origin[1]) + wp.abs(origin[2])) + RAY_PAD_SMALLEST
    return out


@wp.func
def ray_kdop(ray: KdopRay, lo: wp.vec3, hi: wp.vec3, cut_lo: wp.vec4, cut_hi: wp.vec4, t_max: float) -> float:
    """Distance at which the segment [t_min, t_max] enters the box lo .. hi; inf where it misses that, or the line misses the rest.

    Conservative as ray_aabb. The planes askew stand around triangles, not around their boxes, and a hit's t is clamped to its box
    only: where a ray grazes a triangle t may be before they begin. So they may say that the line passes by, but not where.
    """
    interval = slab_interval(ray.box, lo, hi)
    near = float(interval[0])
    far = interval[1] * FAR_PAD
    enter = wp.where(near > ray.box.t_min, near, ray.box.t_min)
    leave = wp.where(far < t_max, far, t_max)
    for k in range(4):
        low = (cut_lo[k] - ray.origin[k]) - ray.pad
        high = (cut_hi[k] - ray.origin[k]) + ray.pad
        backwards = ray.inv_dir[k] < 0.0
        t_0 = wp.where(backwards, high, low) * ray.inv_dir[k]
        t_1 = wp.where(backwards, low, high) * ray.inv_dir[k]
        near = wp.where(t_0 > near, t_0, near)
        far = wp.where(t_1 < far, t_1, far)
    return wp.where(enter <= leave and near <= far, enter, float(wp.inf))
