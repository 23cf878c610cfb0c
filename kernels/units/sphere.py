"""The sphere unit: the intersection of a ray with a sphere that is a primitive.
The discriminant is computed from the distance between center and line. One root would suffer from cancellation: this root is computed from
the product of both roots. Source: Haines, Guenther and Akenine-Moeller 2019, "Precision Improvements for Ray/Sphere Intersection", Ray
Tracing Gems, chapter 7. In float64, because the distance to a large ground sphere is a small difference of two numbers near its radius."""

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray
from wrt.kernels.units.box import FAR_PAD, BoxRay
from wrt.kernels.units.triangle import clamped, padded_interval


@wp.func
def ray_sphere(box: BoxRay, ray: Ray, center: wp.vec3, radius: float) -> Hit:
    """Return the first of the two intersections with t >= ray.t_min; prim_id is 0 on a hit, else NO_HIT. u = v = 0.
    Center and ray are in the same space. The result's t is clamped to the interval in which the ray is in the sphere's padded box."""
    hit = Hit()
    hit.prim_id = NO_HIT
    hit.t = float(wp.inf)
    zero = wp.float64(0.0)
    f = wp.vec3d(ray.origin) - wp.vec3d(center)
    d = wp.vec3d(ray.direction)
    r = wp.float64(radius)
    a = wp.dot(d, d)
    half_b = -wp.dot(f, d)
    nearest = f + (half_b / a) * d
    discriminant = r * r - wp.dot(nearest, nearest)
    if not discriminant >= zero:
        return hit
    root = wp.sqrt(a * discriminant)
    q = half_b + wp.where(half_b < zero, -root, root)
    if q == zero:
        return hit  # the line touches the sphere at the ray's origin
    far = float(q / a)
    near = float((wp.dot(f, f) - r * r) / q)
    t_0 = wp.where(near <= far, near, far)  # wp.min and wp.max of 0 and -0 have another sign on CUDA than on the CPU
    t_1 = wp.where(near >= far, near, far)
    # Far from 0, rounding moves the corners of a small sphere's box by a good part of the radius: only the padded box contains the sphere.
    extent = wp.vec3(radius, radius, radius)
    interval = padded_interval(box, center - extent, center + extent)
    if not interval[0] <= interval[1] * FAR_PAD:
        return hit
    t_0 = clamped(t_0, interval)
    t_1 = clamped(t_1, interval)
    t = wp.where(t_0 >= ray.t_min, t_0, t_1)
    if t >= ray.t_min and wp.isfinite(t):
        hit.t = t
        hit.prim_id = 0
    return hit
