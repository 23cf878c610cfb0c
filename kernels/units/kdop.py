"""The test of a ray against a 14-DOP: a box whose eight corners are cut off by diagonal planes.
A k-DOP is the intersection of k/2 slabs (Kay and Kajiya 1986, "Ray Tracing Complex Scenes"; the name: Klosowski et al. 1998). A 14-DOP has
the three slabs of a box, and four slabs at right angles to the diagonals (1, 1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1). Projections onto
the diagonals are relative to the scene's middle, so that a scene far from 0 has no larger rounding errors."""

import warp as wp

from wrt.kernels.structs import Ray
from wrt.kernels.units.box import FAR_PAD, PAD_SMALLEST, BoxRay, entry_of, slab_interval

# RAY_PAD bounds errors relative to the sum of the origin's absolute coordinates, in units of 2^-24. Corners in the triangle unit add 9 (3
# of the distance in each coordinate). Projections add 3 for the direction and 2 for the origin. The distance to the plane adds 3, and its
# comparison with the distances to the box 6. The sum, 23, is below 32. KDOP_PAD bounds errors relative to the primitive's coordinates:
# again 23, and 33 more for the primitive's extent (5 in each coordinate) and projections. The sum, 56, is below 64.
RAY_PAD = wp.constant(2.0**-19)
KDOP_PAD = 2.0**-18
# Underflow moves each of three coordinates by up to box.PAD_SMALLEST, whatever their size.
RAY_PAD_SMALLEST = wp.constant(4.0 * PAD_SMALLEST)


@wp.struct
class KdopRay:
    """A ray set up for the k-DOP test."""

    box: BoxRay
    origin: wp.vec4  # Projections of the ray's origin onto the four diagonals.
    inv_dir: wp.vec4  # Reciprocals of the direction's projections onto the four diagonals.
    pad: float  # Amount by which the diagonal planes move outwards, in units of the projections.


@wp.func
def project(v: wp.vec3) -> wp.vec4:
    """Return the dot products of v with the four diagonals, which have length sqrt(3)."""
    return wp.vec4(v[0] + v[1] + v[2], v[1] - v[0] + v[2], v[0] - v[1] + v[2], v[0] + v[1] - v[2])


@wp.func
def kdop_ray(ray: Ray, box: BoxRay, middle: wp.vec3) -> KdopRay:
    """Set up a ray for the k-DOP test; middle: the origin of the projections."""
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
    """Return t where the segment [t_min, t_max] enters the box lo .. hi; inf if it misses the box, or if its line misses the 14-DOP.
    Conservative, as `ray_aabb` is. The diagonal slabs may reject the line, but do not change the distance. The reason: a hit's t is clamped
    to the triangle's box, so on a grazing ray it may lie in front of the diagonal slabs."""
    interval = slab_interval(ray.box, lo, hi)
    near = float(interval[0])
    far = interval[1] * FAR_PAD
    enter = entry_of(near, far, ray.box.t_min, t_max)
    for k in range(4):
        low = (cut_lo[k] - ray.origin[k]) - ray.pad
        high = (cut_hi[k] - ray.origin[k]) + ray.pad
        backwards = ray.inv_dir[k] < 0.0
        t_0 = wp.where(backwards, high, low) * ray.inv_dir[k]
        t_1 = wp.where(backwards, low, high) * ray.inv_dir[k]
        near = wp.where(t_0 > near, t_0, near)
        far = wp.where(t_1 < far, t_1, far)
    return wp.where(near <= far, enter, float(wp.inf))
