"""The sphere unit: where does a ray meet an exact sphere?

The form of Haines, Guenther and Akenine-Moeller 2019, "Precision Improvements for Ray/Sphere Intersection" (Ray Tracing
Gems, chapter 7): the discriminant from the distance between the center and the line, and the root that would cancel from the
product of the two.
"""

import warp as wp

from wrt.kernels.ray_aabb import BoxRay
from wrt.kernels.ray_triangle import within_bounds
from wrt.kernels.structs import NO_HIT, Hit, Ray


@wp.func
def ray_sphere(box: BoxRay, ray: Ray, center: wp.vec3, radius: float) -> Hit:
    """The first of the two crossings that is >= ray.t_min; prim_id is 0 on a hit, else NO_HIT. u = v = 0."""
    hit = Hit()
    hit.prim_id = NO_HIT
    hit.t = float(wp.inf)
    f = ray.origin - center
    d = ray.direction
    a = wp.dot(d, d)
    half_b = -wp.dot(f, d)
    nearest = f + (half_b / a) * d
    discriminant = radius * radius - wp.dot(nearest, nearest)
    if not discriminant >= 0.0:
        return hit
    distance = wp.length(f)
    c = (distance - radius) * (distance + radius)
    root = wp.sqrt(a) * wp.sqrt(discriminant)  # of the product, the root would overflow far sooner
    q = half_b + wp.where(half_b < 0.0, -root, root)
    if q == 0.0:
        return hit  # the origin is on the sphere and the line touches it there
    t_0 = wp.min(c / q, q / a)
    t_1 = wp.max(c / q, q / a)
    extent = wp.vec3(radius, radius, radius)
    t_0 = within_bounds(box, t_0, center - extent, center + extent)
    t_1 = within_bounds(box, t_1, center - extent, center + extent)
    t = wp.where(t_0 >= ray.t_min, t_0, t_1)
    if t >= ray.t_min and wp.isfinite(t):
        hit.t = t
        hit.prim_id = 0
    return hit
