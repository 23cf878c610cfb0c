"""The test of a ray against the bounding sphere of a subtree. `sphere.py` computes hits on spheres that are primitives.
The test accepts every ray that hits something inside. A sphere is a vec4 (center, radius); a negative radius marks an empty sphere."""

import warp as wp

from wrt.kernels.structs import Ray
from wrt.kernels.units.box import entry_of

# Bound on errors relative to distance + radius. In units of 2^-24, the line's distance from the center has the error 7, the line's point
# nearest to the center 8, the ends of the chord 4. Clamping t to the primitive's padded box adds 18 (3 per slab distance, and FAR_PAD). The
# sum, 37, is below 64.
SPHERE_PAD = wp.constant(2.0**-18)
# Squares of lengths above LARGEST may overflow: the ray always enters such a sphere. Squares of lengths below SMALLEST may underflow: so
# the test adds SMALLEST to every radius.
LARGEST = wp.constant(2.0**60)
SMALLEST = wp.constant(2.0**-60)


@wp.struct
class SphereRay:
    """A ray set up for the bounding-sphere test, in the space of the spheres."""

    origin: wp.vec3
    direction: wp.vec3  # Of unit length.
    inv_length: float  # 1 / length of Ray.direction, to convert a distance to t.
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
    """Return t where the segment [t_min, t_max] enters the sphere: t_min for an origin inside, inf for a miss or an empty sphere.
    Conservative: the radius grows by SPHERE_PAD times (distance of origin and center + radius), which bounds all rounding errors. The
    domain is the same as for `box.ray_aabb`. A ray with NaN may enter."""
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
    return entry_of((middle - half) * ray.inv_length, (middle + half) * ray.inv_length, ray.t_min, t_max)
