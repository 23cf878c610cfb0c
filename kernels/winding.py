"""Winding numbers of surfaces around points: the sum of the solid angles of all triangles, over 4 pi; far ones by expansions."""

import warp as wp

from wrt.kernels.structs import Surfaces, kernel
from wrt.kernels.traverse import bvh2
from wrt.kernels.traverse.stack import make_uninitialized

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


@wp.func
def add_triangle(total: Turns, surfaces: Surfaces, face: int, point: wp.vec3) -> Turns:
    """Add half the solid angle of a triangle (van Oosterom and Strackee 1983, "The Solid Angle of a Plane Triangle").
    A triangle with a corner at the point adds 0."""
    abc = surfaces.faces[face]
    a = corner(surfaces, abc[0], point)
    b = corner(surfaces, abc[1], point)
    c = corner(surfaces, abc[2], point)
    size_a = wp.length(a)
    size_b = wp.length(b)
    size_c = wp.length(c)
    size = size_a * size_b * size_c
    if not (size > wp.float64(0.0) and size < wp.float64(wp.inf)):
        return total
    one = wp.float64(1.0)
    part = one / size
    re = one + (wp.dot(a, b) * size_c + wp.dot(b, c) * size_a + wp.dot(c, a) * size_b) * part
    return add_angle(total, re, wp.dot(a, wp.cross(b, c)) * part)


@kernel
def wind(surfaces: Surfaces, points: wp.array(dtype=wp.vec3), turns: wp.array(dtype=wp.vec3d), first: int):
    """Store (re, im, whole) of `Turns`, the sum of half the solid angles, for points first .. first + dim - 1 (dim: launch size)."""
    i = first + wp.tid()
    total = Turns()
    total.re = wp.float64(1.0)
    for face in range(surfaces.n_triangles):
        total = add_triangle(total, surfaces, face, points[i])
    turns[i] = wp.vec3d(total.re, total.im, total.whole)


# --- by a tree ---------------------------------------------------------------------------------------------------------

# A subtree is far from a point if its center is at least this many of its radii away.
FAR = wp.constant(3.25)
SLIGHTLY_MORE = wp.constant(wp.float64(1.0 + 2.0**-20))  # for a radius that is rounded to float32
SPHERE = wp.constant(wp.float64(4.0 * wp.pi))  # the whole solid angle
STACK_SIZE = bvh2.STACK_SIZE + 2  # a level of the builder's tree leaves one entry, and the last level two
empty_stack = make_uninitialized(STACK_SIZE, wp.int32)
vec10 = wp.types.vector(10, wp.float32)
vec10d = wp.types.vector(10, wp.float64)


@wp.struct
class WindingNode:
    """A subtree: two nodes `first` and `first` + 1, or (count > 0) a leaf's triangles first .. first + count - 1.

    Its winding number from afar is an expansion about `center`, in units of `radius`, within which all of it lies."""

    center: wp.vec3
    radius: float
    dipole: wp.vec3
    trace: float  # Of the first moment.
    first_moment: wp.mat33
    traces: wp.vec3  # Of the second moment.
    cubic: vec10  # Second moment, as coefficients of xxx, yyy, zzz, xxy, xxz, yyx, yyz, zzx, zzy, xyz.
    first: int
    count: int


@wp.func
def area_vector(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Return the normal of a triangle, with the length of its area."""
    return wp.float64(0.5) * wp.cross(b - a, c - a)


@kernel
def expand_nodes(surfaces: Surfaces, faces: wp.array(dtype=wp.int32), begin: wp.array(dtype=wp.int32), end: wp.array(dtype=wp.int32),
                 nodes: wp.array(dtype=WindingNode), start: int):
    """Compute the expansion of node i, which has the triangles begin[i] .. end[i] - 1, from its triangles, in float64.

    With u the vector from the center and n the normal, the moments are integrals of n, u n^T and u u^T n over the surface (Barill et
    al. 2018, "Fast Winding Numbers for Soups and Clouds", section 3)."""
    i = start + wp.tid()
    zero = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    third = wp.float64(1.0) / wp.float64(3.0)
    origin = zero
    if begin[i] < end[i]:
        origin = corner(surfaces, surfaces.faces[faces[begin[i]]][0], wp.vec3())
    area = wp.float64(0.0)
    middle = wp.vec3d(zero)
    center = wp.vec3d(zero)
    for k in range(begin[i], end[i]):
        abc = surfaces.faces[faces[k]]
        a = corner(surfaces, abc[0], wp.vec3()) - origin
        b = corner(surfaces, abc[1], wp.vec3()) - origin
        c = corner(surfaces, abc[2], wp.vec3()) - origin
        size = wp.length(area_vector(a, b, c))
        area += size
        center += size * third * (a + b + c)
        middle += third * (a + b + c) / wp.float64(end[i] - begin[i])
    if area > wp.float64(0.0):
        middle = center / area
    # Rounded here, so that the moments are about the center that points see.
    rounded = wp.vec3(middle + origin)
    radius2 = wp.float64(0.0)
    dipole = wp.vec3d(zero)
    first_moment = wp.mat33d()
    traces = wp.vec3d(zero)
    cubic = vec10d()
    for k in range(begin[i], end[i]):
        abc = surfaces.faces[faces[k]]
        a = corner(surfaces, abc[0], rounded)
        b = corner(surfaces, abc[1], rounded)
        c = corner(surfaces, abc[2], rounded)
        radius2 = wp.max(radius2, wp.max(wp.dot(a, a), wp.max(wp.dot(b, b), wp.dot(c, c))))
        n = area_vector(a, b, c)
        u = third * (a + b + c)
        q = (wp.outer(a, a) + wp.outer(b, b) + wp.outer(c, c) + wp.float64(9.0) * wp.outer(u, u)) / wp.float64(12.0)
        two = wp.float64(2.0)
        dipole += n
        first_moment += wp.outer(u, n)
        traces += wp.trace(q) * n + two * (q * n)
        cubic += vec10d(q[0, 0] * n[0], q[1, 1] * n[1], q[2, 2] * n[2],
                        q[0, 0] * n[1] + two * q[0, 1] * n[0], q[0, 0] * n[2] + two * q[0, 2] * n[0],
                        q[1, 1] * n[0] + two * q[0, 1] * n[1], q[1, 1] * n[2] + two * q[1, 2] * n[1],
                        q[2, 2] * n[0] + two * q[0, 2] * n[2], q[2, 2] * n[1] + two * q[1, 2] * n[2],
                        two * (q[0, 1] * n[2] + q[0, 2] * n[1] + q[1, 2] * n[0]))
    radius = wp.sqrt(radius2)
    unit = wp.float64(0.0)
    if radius > wp.float64(0.0):
        unit = wp.float64(1.0) / radius
    scale = unit * unit / SPHERE
    node = nodes[i]
    node.center = rounded
    node.radius = float(radius * SLIGHTLY_MORE)
    node.dipole = wp.vec3(scale * dipole)
    node.trace = float(scale * unit * wp.trace(first_moment))
    node.first_moment = wp.mat33(wp.float64(3.0) * scale * unit * first_moment)
    node.traces = wp.vec3(wp.float64(1.5) * scale * unit * unit * traces)
    node.cubic = vec10(wp.float64(7.5) * scale * unit * unit * cubic)
    nodes[i] = node


@wp.func
def cubic_form(c: vec10, x: wp.vec3) -> float:
    """Return the value of a cubic form with coefficients as in WindingNode."""
    xx = x[0] * x[0]
    yy = x[1] * x[1]
    zz = x[2] * x[2]
    return (x[0] * (c[0] * xx + c[5] * yy + c[7] * zz) + x[1] * (c[1] * yy + c[3] * xx + c[8] * zz)
            + x[2] * (c[2] * zz + c[4] * xx + c[6] * yy) + c[9] * x[0] * x[1] * x[2])


@wp.func
def expansion(node: WindingNode, to_center: wp.vec3d, distance: wp.float64) -> float:
    """Return the winding number of a far subtree: the terms of dipole, first and second moment (Barill et al. 2018, section 3)."""
    x = wp.vec3(to_center / distance)
    q = node.radius / float(distance)
    linear = node.trace - wp.dot(x, node.first_moment * x)
    quadratic = cubic_form(node.cubic, x) - wp.dot(node.traces, x)
    return q * q * (wp.dot(node.dipole, x) + q * (linear + q * quadratic))


@kernel
def wind_by_tree(surfaces: Surfaces, nodes: wp.array(dtype=WindingNode), faces: wp.array(dtype=wp.int32), points: wp.array(dtype=wp.vec3),
                 turns: wp.array(dtype=wp.vec3d), first: int):
    """Store the same as `wind`: near triangles as there, far subtrees by their expansions, which count as parts of whole turns."""
    i = first + wp.tid()
    point = points[i]
    total = Turns()
    total.re = wp.float64(1.0)
    far = wp.float64(0.0)
    stack = empty_stack()
    stack[0] = 0
    size = int(1)
    while size > 0:
        size = size - 1
        index = stack[size]
        to_center = wp.vec3d(nodes[index].center) - wp.vec3d(point)
        distance = wp.length(to_center)
        if distance > wp.float64(FAR * nodes[index].radius):
            far += wp.float64(expansion(nodes[index], to_center, distance))
        elif nodes[index].count > 0:
            begin = nodes[index].first
            for k in range(begin, begin + nodes[index].count):
                total = add_triangle(total, surfaces, faces[k], point)
        else:
            stack[size] = nodes[index].first
            stack[size + 1] = nodes[index].first + 1
            size = size + 2
    turns[i] = wp.vec3d(total.re, total.im, total.whole + far)
