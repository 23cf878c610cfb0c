"""The bounding sphere's unit: does a ray meet a sphere that stands around something?

Not the sphere unit (sphere.py), which finds exact hits: this one only has to let every hit through, as cheaply as it can.
A sphere is a vec4 (center, radius); a radius below 0 is an empty one.
"""

import warp as wp

from wrt.kernels.structs import Ray

# In units of 2^-24 of the distance and radius together: 7 for the line's distance from the center, 8 and 4 for where it is
# nearest and for the ends of the chord, 18 for a hit, which is clamped to its primitive's padded box by distances that are
# rounded themselves (3 errors each, and FAR_PAD). Their sum, 37, is less than 64.
SPHERE_PAD = wp.constant(2.0**-18)
# Beyond it squares overflow, and below it they underflow: what is larger is always entered, what is smaller is taken as this.
LARGEST = wp.constant(2.0**60)
SMALLEST = wp.constant(2.0**-60)


@wp.struct
class SphereRay:
    """What the test needs of a ray: direction has unit length, inv_length is 1 over what it was divided by."""

    origin: wp.vec3
    direction: wp.vec3
    inv_length: float
    t_min: float


@wp.func
def sphere_ray(ray: Ray) -> SphereRay:
    """Set-up, once a ray."""
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
    """Distance at which the segment [t_min, t_max] enters the sphere, or inf where it misses it.

    An origin inside is a hit (entry t_min), an empty sphere never. Conservative: the radius is grown by SPHERE_PAD of the sum of
    distance and radius, which covers what is said there; the domain is that of ray_aabb. A ray with NaN may be let in.
    """
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
