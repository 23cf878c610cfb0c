"""The sphere unit: where does a ray meet an exact sphere?

The form of Haines, Guenther and Akenine-Moeller 2019, "Precision Improvements for Ray/Sphere Intersection" (Ray Tracing
Gems, chapter 7): the discriminant from the distance between the center and the line, and the root that would cancel from the
product of the two. It is taken in float64 all the same: above a sphere that serves as the ground, the distance to it is the
difference of two numbers near its radius.
"""

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray
from wrt.kernels.units.box import FAR_PAD, BoxRay
from wrt.kernels.units.triangle import clamped, padded_interval


@wp.func
def ray_sphere(box: BoxRay, ray: Ray, center: wp.vec3, radius: float) -> Hit:
    """The first of the two crossings that is >= ray.t_min; prim_id is 0 on a hit, else NO_HIT. u = v = 0."""
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
        return hit  # the origin is on the sphere and the line touches it there
    far = float(q / a)
    near = float((wp.dot(f, f) - r * r) / q)
    t_0 = wp.where(near <= far, near, far)  # wp.min and wp.max of 0 and -0 are another one on CUDA than on the CPU
    t_1 = wp.where(near >= far, near, far)
    # The corners of a small sphere's box are rounded by a good part of its radius: only the padded box surely contains it.
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
