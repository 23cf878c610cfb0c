"""The unit for bounding spheres: the test of a ray against a sphere around a subtree.
It lets every hit through and finds none; exact hits on spheres are `sphere.py`'s. A sphere is a vec4 (center, radius); a negative radius
marks an empty one."""

import warp as wp

from wrt.kernels.structs import Ray

# Errors relative to distance + radius, in units of 2^-24: the line's distance from the center 7, the point nearest to it 8, the ends of
# the chord 4. A hit is clamped to its primitive's padded box by distances that are rounded too (3 errors each, and FAR_PAD): 18. The sum,
# 37, is below 64.
SPHERE_PAD = wp.constant(2.0**-18)
# Squares overflow above LARGEST: such a sphere is always entered. They underflow below SMALLEST, which every radius grows by.
LARGEST = wp.constant(2.0**60)
SMALLEST = wp.constant(2.0**-60)


@wp.struct
class SphereRay:
    """The ray as the bounding-sphere test reads it, in the space of the spheres."""

    origin: wp.vec3
    direction: wp.vec3  # Of unit length.
    inv_length: float  # 1 / length of the ray's own direction: t = distance * inv_length.
    t_min: float


@wp.func
def sphere_ray(ray: Ray) -> SphereRay:
    """Set up a ray for the test, in float64."""
    out = SphereRay()
    d = wp.vec3d(ray.direction)
    length = wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    out.origin = ray.origin
    out.direction = wp.vec3(d / length)
    out.inv_length = float(wp.float64(1.0) / length)
    out.t_min = ray.t_min
    return out


@wp.func
def ray_bounding_sphere(ray: SphereRay, sphere: wp.vec4, t_max: float) -> float:
    """Distance at which the segment [t_min, t_max] enters the sphere, or inf if it misses.
    An origin inside gives t_min; an empty sphere gives inf. Conservative: the radius grows by SPHERE_PAD (distance + radius), which bounds
    all rounding. The domain is that of `ray_aabb`. A ray with NaN may enter."""
    x = ray.origin[0] - sphere[0]
    y = ray.origin[1] - sphere[1]
    z = ray.origin[2] - sphere[2]
    size = wp.abs(x) + wp.abs(y) + wp.abs(z) + sphere[3]
    if not sphere[3] >= 0.0:
        return float(wp.inf)
    if not size < LARGEST:
        return wp.where(ray.t_min <= t_max, ray.t_min, float(wp.inf))
    middle = -(x * ray.direction[0] + y * ray.direction[1] + z * ray.direction[2])
    x = x + middle * ray.direction[0]
    y = y + middle * ray.direction[1]
    z = z + middle * ray.direction[2]
    radius = sphere[3] + (SPHERE_PAD * size + SMALLEST)
    square = radius * radius - (x * x + y * y + z * z)
    if not square >= 0.0:
        return float(wp.inf)
    half = wp.sqrt(square)
    enter = (middle - half) * ray.inv_length
    leave = (middle + half) * ray.inv_length
    enter = wp.where(enter > ray.t_min, enter, ray.t_min)
    leave = wp.where(leave < t_max, leave, t_max)
    return wp.where(enter <= leave, enter, float(wp.inf))
