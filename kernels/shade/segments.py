"""Segments between pairs of points, for rays by themselves: what is between their ends, and what lies at them."""

import warp as wp

from wrt.kernels.query import RayArrays
from wrt.kernels.shade.surface import corners_at, spawn_point, triangle_normal
from wrt.kernels.structs import Surfaces, gamma, kernel, largest

END = 64.0  # roundings of the largest coordinate: so near to an end nothing is looked for


@wp.func
def lifted(surfaces: Surfaces, face: int, point: wp.vec3, towards: wp.vec3) -> wp.vec3:
    """A point of that face, to rounding, moved off the face's plane as far as rounding may have put it on the other side; -1: as it
    is. A face beside it in the same plane is then not met."""
    if face < 0:
        return point
    c = corners_at(surfaces, face)
    size = wp.max(largest(c.v1 - c.v0), largest(c.v2 - c.v0))
    error = gamma(8.0) * (wp.max(wp.max(wp.abs(c.v0), wp.abs(c.v1)), wp.abs(c.v2)) + wp.vec3(size, size, size))
    return spawn_point(point, error, triangle_normal(c), towards - point)


@wp.func
def is_before(p: wp.vec3, q: wp.vec3) -> bool:
    """By x, then y, then z."""
    if p[0] != q[0]:
        return p[0] < q[0]
    if p[1] != q[1]:
        return p[1] < q[1]
    return p[2] < q[2]


@kernel
def segments(surfaces: Surfaces, a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), on_a: wp.array(dtype=wp.int32),
             on_b: wp.array(dtype=wp.int32), rays: RayArrays, first: int):
    """Rays between a and b, without their ends: the same ray whichever of the two is called a. on_a, on_b: as of `lifted`, or
    nothing (length 0). A segment that is all ends, or not finite, has a ray that hits nothing."""
    i = first + wp.tid()
    p = a[i]
    q = b[i]
    if on_a.shape[0] > 0:
        p = lifted(surfaces, on_a[i], a[i], b[i])
    if on_b.shape[0] > 0:
        q = lifted(surfaces, on_b[i], b[i], a[i])
    origin = wp.where(is_before(q, p), q, p)
    way = wp.where(is_before(q, p), p, q) - origin
    end = gamma(END) * wp.max(largest(p), largest(q)) / largest(way)
    rays.origin[i] = origin
    rays.direction[i] = way
    rays.t_min[i] = end
    rays.t_max[i] = 1.0 - end
    if not end < 0.5:
        rays.origin[i] = wp.vec3()
        rays.direction[i] = wp.vec3(1.0, 0.0, 0.0)
        rays.t_min[i] = 0.0
        rays.t_max[i] = -1.0


@kernel
def see(a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), occluded: wp.array(dtype=wp.bool), first: int):
    """Turn `occluded` into what is visible, which is nothing from or to a point that is not finite."""
    i = first + wp.tid()
    finite = largest(a[i]) < wp.inf and largest(b[i]) < wp.inf and wp.isfinite(a[i]) and wp.isfinite(b[i])
    occluded[i] = finite and not occluded[i]
