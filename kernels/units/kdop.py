"""The unit for 14-DOPs: the test of a ray against a box with its eight corners cut off by diagonal planes.
A k-DOP is the intersection of k/2 slabs (Kay and Kajiya 1986, "Ray Tracing Complex Scenes"; named by Klosowski et al. 1998). Here they are
the box's three slabs and four across the diagonals (1, 1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1). Projections are relative to the middle
of the scene: their rounding does not grow with its distance from 0."""

import warp as wp

from wrt.kernels.structs import Ray
from wrt.kernels.units.box import FAR_PAD, PAD_SMALLEST, BoxRay, slab_interval

# Error of a projected plane in units of 2^-24, relative to the sum of the origin's absolute coordinates. Corners as the triangle unit sees
# them along the ray: 9 (3 of the distance in each coordinate). The direction's projection: 3. The origin's: 2. The distance to the plane:
# 3. Its comparison with the distances to the box: 6. The sum is below 32. The primitive's own coordinates bring as much, and its extent (5
# of it in each coordinate) and projections 33 more: below 64.
RAY_PAD = wp.constant(2.0**-19)
# Underflow moves each of three coordinates by up to box.PAD_SMALLEST, whatever their size.
RAY_PAD_SMALLEST = wp.constant(4.0 * PAD_SMALLEST)
KDOP_PAD = 2.0**-18


@wp.struct
class KdopRay:
    """The ray as the k-DOP test reads it."""

    box: BoxRay
    origin: wp.vec4  # Its four projections.
    inv_dir: wp.vec4  # 1 / projections of the direction.
    pad: float  # Distance by which the diagonal planes move outwards.


@wp.func
def project(v: wp.vec3) -> wp.vec4:
    """Coordinates of v along the four diagonals, not normalised."""
    return wp.vec4(v[0] + v[1] + v[2], v[1] - v[0] + v[2], v[0] - v[1] + v[2], v[0] + v[1] - v[2])


@wp.func
def kdop_ray(ray: Ray, box: BoxRay, middle: wp.vec3) -> KdopRay:
    """Set up a ray for the test; middle: the point to which the diagonal planes are relative."""
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
    """Distance at which the segment [t_min, t_max] enters the box lo .. hi; inf if it misses it, or the line misses the diagonals' slabs.
    Conservative as `ray_aabb`. The diagonal planes bound triangles, but a hit's t is clamped to the triangle's box: on a grazing ray, t
    may lie before the diagonal slabs. So these can reject the line, and never give the distance."""
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
