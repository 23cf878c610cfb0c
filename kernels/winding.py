"""Winding numbers of a surface around points: the sum of the signed solid angles of all triangles, divided by 4 pi."""

import warp as wp

from wrt.kernels.structs import Surfaces, kernel

# A product below SMALLEST or above LARGEST is scaled to size 1, so that it neither under- nor overflows.
SMALLEST, LARGEST = wp.constant(wp.float64(2.0**-900)), wp.constant(wp.float64(2.0**900))


@wp.struct
class Turns:
    """A sum of angles in [-pi, pi], stored as the product of the complex numbers with these arguments, plus a number of whole turns.
    Unlike a sum of results of atan2, it has the same bits on all machines."""

    re: wp.float64  # The product is re + i im.
    im: wp.float64
    whole: wp.float64  # Number of whole turns to add to the product's argument.


@wp.func
def corner(surfaces: Surfaces, vertex: int, point: wp.vec3) -> wp.vec3d:
    """Return the vector from `point` to vertex number `vertex`, in float64."""
    return wp.vec3d(surfaces.vertices[vertex]) - wp.vec3d(point)


@wp.func
def add_angle(turns: Turns, re: wp.float64, im: wp.float64) -> Turns:
    """Add the argument (angle) of the complex number re + i im to the sum `turns`."""
    zero = wp.float64(0.0)
    if re == zero and im == zero:  # the point is on an edge
        return turns
    out = Turns()
    out.re = turns.re * re - turns.im * im
    out.im = turns.re * im + turns.im * re
    out.whole = turns.whole
    if turns.im >= zero and im >= zero and out.im < zero:
        out.whole = turns.whole + wp.float64(1.0)
    if turns.im < zero and im < zero and out.im >= zero:
        out.whole = turns.whole - wp.float64(1.0)
    size = wp.max(wp.abs(out.re), wp.abs(out.im))
    if size < SMALLEST or size > LARGEST:
        out.re = out.re / size
        out.im = out.im / size
    return out


@kernel
def wind(surfaces: Surfaces, points: wp.array(dtype=wp.vec3), turns: wp.array(dtype=wp.vec3d), first: int):
    """Store (re, im, whole) of `Turns`, the sum of half the solid angles, for points first .. first + dim - 1 (dim: launch size).
    Van Oosterom and Strackee 1983, "The Solid Angle of a Plane Triangle". A triangle with a corner at the point adds 0."""
    i = first + wp.tid()
    point = points[i]
    one = wp.float64(1.0)
    total = Turns()
    total.re = one
    for face in range(surfaces.n_triangles):
        abc = surfaces.faces[face]
        a = corner(surfaces, abc[0], point)
        b = corner(surfaces, abc[1], point)
        c = corner(surfaces, abc[2], point)
        size_a = wp.length(a)
        size_b = wp.length(b)
        size_c = wp.length(c)
        size = size_a * size_b * size_c
        if size > wp.float64(0.0) and size < wp.float64(wp.inf):
            part = one / size
            re = one + (wp.dot(a, b) * size_c + wp.dot(b, c) * size_a + wp.dot(c, a) * size_b) * part
            total = add_angle(total, re, wp.dot(a, wp.cross(b, c)) * part)
    turns[i] = wp.vec3d(total.re, total.im, total.whole)
