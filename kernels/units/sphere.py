"""The sphere unit: the intersection of a ray with an exact sphere.
The discriminant comes from the distance between center and line. The root that would cancel comes from the product of both. Source:
Haines, Guenther and Akenine-Moeller 2019, "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems, chapter 7. All in
float64: the distance to a ground sphere is the difference of two numbers near its radius."""

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray
from wrt.kernels.units.box import FAR_PAD, BoxRay
from wrt.kernels.units.triangle import clamped, padded_interval


@wp.func
def ray_sphere(box: BoxRay, ray: Ray, center: wp.vec3, radius: float) -> Hit:
    """First of the two crossings with t >= ray.t_min; prim_id is 0 on a hit, else NO_HIT. u = v = 0.
    The center is in the ray's space. t is clamped to the interval of the sphere's padded box."""
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
    t_0 = wp.where(near <= far, near, far)  # not wp.min, wp.max: for 0 and -0, CUDA and the CPU return different zeros
    t_1 = wp.where(near >= far, near, far)
    # Rounding moves the corners of a small sphere's box by a good part of its radius: only the padded box surely contains it.
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
