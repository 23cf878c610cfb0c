"""Rays along the segments between pairs of points, for visibility queries."""

import warp as wp

from wrt.kernels.query import RayArrays
from wrt.kernels.shade.surface import corners_at, spawn_point, triangle_normal
from wrt.kernels.structs import Surfaces, gamma, kernel, largest, unit

END = 64.0  # Length cut off at each end of a segment, in units of rounding; see `segments`.


@wp.func
def lifted(surfaces: Surfaces, prim_id: int, point: wp.vec3, towards: wp.vec3) -> wp.vec3:
    """Move a point on a triangle or sphere off the surface, on the side of `towards`, by the point's rounding error.

    A ray from the moved point does not hit a neighbouring face in the same plane. Points with prim_id -1 or on degenerate faces stay."""
    if prim_id < 0:
        return point
    error = wp.vec3()
    normal = wp.vec3()
    if prim_id < surfaces.n_triangles:
        c = corners_at(surfaces, prim_id)
        size = wp.max(largest(c.v1 - c.v0), largest(c.v2 - c.v0))
        error = gamma(8.0) * (wp.max(wp.max(wp.abs(c.v0), wp.abs(c.v1)), wp.abs(c.v2)) + wp.vec3(size, size, size))
        normal = triangle_normal(c)
    else:
        s = surfaces.spheres[prim_id - surfaces.n_triangles]
        center = wp.vec3(s[0], s[1], s[2])
        error = gamma(8.0) * (wp.abs(center) + wp.vec3(s[3], s[3], s[3]))
        normal = unit((point - center) / largest(point - center))
    if largest(normal) == 0.0:
        return point
    return spawn_point(point, error, normal, towards - point)


@wp.func
def is_before(p: wp.vec3, q: wp.vec3) -> bool:
    """Return whether p comes before q in lexicographic order."""
    if p[0] != q[0]:
        return p[0] < q[0]
    if p[1] != q[1]:
        return p[1] < q[1]
    return p[2] < q[2]


@wp.struct
class Pairs:
    """Pairs of points in world space, and the primitives that they lie on."""

    a: wp.array(dtype=wp.vec3)
    b: wp.array(dtype=wp.vec3)
    on_a: wp.array(dtype=wp.int32)  # prim_id of the primitive that a lies on, -1: none. Length 0: unknown for all points.
    on_b: wp.array(dtype=wp.int32)  # As on_a, for b.


@kernel
def segments(surfaces: Surfaces, pairs: Pairs, size: float, rays: RayArrays, first: int):
    """Make rays along the segments from a to b, shortened at both ends. Swapping a and b does not change a ray.

    `size` is the size of the largest primitive. A segment that is not finite, or not longer than its two cuts, becomes a ray that
    hits nothing.

    At an end p the ray is shortened by the rounding error of a surface through p. Let u = 2^-24, |p| the largest absolute coordinate
    of p, and S the size of the primitive at p. Then p is off the surface by a few u |p|. The ray begins at the end with the smaller
    |p|. There the rounding of the direction does not matter, and the error of a triangle test is 7 u S: u S from rounding the corners
    relative to the origin, 6 u S from shearing them. At the other end q, the error of the direction is u |q - p| <= 2 u |q|, and so
    is the error of the test's distance. All these errors are divided by the cosine between ray and normal. So the ray is shortened by
    END u max(|p|, S) at its origin, but at most by END u |q|, and by END u |q| at the other end. That suffices for cosines above
    0.15."""
    i = first + wp.tid()
    p = pairs.a[i]
    q = pairs.b[i]
    if pairs.on_a.shape[0] > 0:
        p = lifted(surfaces, pairs.on_a[i], pairs.a[i], pairs.b[i])
    if pairs.on_b.shape[0] > 0:
        q = lifted(surfaces, pairs.on_b[i], pairs.b[i], pairs.a[i])
    swapped = largest(q) < largest(p) or (largest(q) == largest(p) and is_before(q, p))
    origin = wp.where(swapped, q, p)
    target = wp.where(swapped, p, q)
    segment = target - origin
    length = largest(segment)
    rays.origin[i] = origin
    rays.direction[i] = segment
    rays.t_min[i] = gamma(END) * wp.min(wp.max(largest(origin), size), largest(target)) / length
    rays.t_max[i] = 1.0 - gamma(END) * largest(target) / length
    if not rays.t_min[i] < rays.t_max[i]:
        rays.origin[i] = wp.vec3()
        rays.direction[i] = wp.vec3(1.0, 0.0, 0.0)
        rays.t_min[i] = 0.0
        rays.t_max[i] = -1.0


@kernel
def to_visible(a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), occluded: wp.array(dtype=wp.bool), first: int):
    """Replace `occluded` in place by True for each visible pair. A pair with a point that is not finite is not visible."""
    i = first + wp.tid()
    finite = largest(a[i]) < wp.inf and largest(b[i]) < wp.inf and wp.isfinite(a[i]) and wp.isfinite(b[i])
    occluded[i] = finite and not occluded[i]
