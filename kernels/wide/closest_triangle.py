"""The point on a triangle that is closest to a query point, in float64 (Ericson 2005, "Real-Time Collision Detection", section 5.1).

The distance is clamped to at least the distance to the triangle's padded box. Rounding is monotone, so no box of a node above a triangle is
farther than the triangle. Therefore the nearest triangle does not depend on the tree."""

import warp as wp

from wrt.kernels.structs import Primitive, noinline
from wrt.kernels.units.box import box_pad, padded_hi, padded_lo
from wrt.kernels.units.triangle import lower, upper


@wp.struct
class Nearest:
    """A point on a triangle, and its squared distance from the query point; prim_id = -1: no triangle found."""

    d2: wp.float64
    point: wp.vec3d
    u: wp.float64
    v: wp.float64
    prim_id: int


@wp.func
def squared_distance(p: wp.vec3, lo: wp.vec3, hi: wp.vec3) -> wp.float64:
    """Return the squared distance from a point to a box; 0 for a point inside."""
    out = wp.float64(0.0)
    for axis in range(3):
        x = wp.float64(p[axis])
        d = wp.max(wp.max(wp.float64(lo[axis]) - x, x - wp.float64(hi[axis])), wp.float64(0.0))
        out = out + d * d
    return out


@wp.func
def before(a: wp.vec3d, b: wp.vec3d) -> bool:
    """Test whether a precedes b in the order by x, then y, then z."""
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    return a[2] < b[2]


@wp.func
def along_edge(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d) -> wp.float64:
    """Return the parameter of the point closest to p on the edge a b: 0 at a, 1 at b. For a = b it is 1, because wp.min ignores NaN."""
    edge = b - a
    t = wp.dot(p - a, edge) / wp.dot(edge, edge)
    return wp.max(wp.min(t, wp.float64(1.0)), wp.float64(0.0))


@wp.func
def nearer_edge(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, best: Nearest, corner_a: int, corner_b: int) -> Nearest:
    """Return the closer to p of `best` and the point closest to p on the edge from a (corner number corner_a, 0 .. 2) to b (corner_b).
    Both triangles at an edge get the same bits, because the edge's ends are first sorted."""
    turned = before(b, a)
    start = wp.where(turned, b, a)
    end = wp.where(turned, a, b)
    t = along_edge(p, start, end)
    point = start + t * (end - start)
    if t == wp.float64(1.0):
        point = end
    d = p - point
    d2 = wp.dot(d, d)
    if not d2 < best.d2:
        return best
    out = Nearest()
    out.d2 = d2
    out.point = point
    s = wp.where(turned, wp.float64(1.0) - t, t)
    out.u = wp.where(corner_a == 1, wp.float64(1.0) - s, wp.where(corner_b == 1, s, wp.float64(0.0)))
    out.v = wp.where(corner_a == 2, wp.float64(1.0) - s, wp.where(corner_b == 2, s, wp.float64(0.0)))
    return out


@wp.func
def nothing_near() -> Nearest:
    best = Nearest()
    best.d2 = wp.float64(wp.inf)
    best.prim_id = -1
    return best


@wp.func
def on_edges(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> Nearest:
    """Return the point closest to p on the three edges of the triangle a b c."""
    out = nearer_edge(p, a, b, nothing_near(), 0, 1)
    out = nearer_edge(p, b, c, out, 1, 2)
    return nearer_edge(p, c, a, out, 2, 0)


@noinline
def on_flat(p: wp.vec3, triangle: Primitive) -> Nearest:
    """Return the point closest to p on a triangle without area; nothing if a corner is not finite."""
    if not (wp.isfinite(triangle.v0) and wp.isfinite(triangle.v1) and wp.isfinite(triangle.v2)):
        return nothing_near()
    return on_edges(wp.vec3d(p), wp.vec3d(triangle.v0), wp.vec3d(triangle.v1), wp.vec3d(triangle.v2))


@wp.func
def on_triangle(point: wp.vec3, triangle: Primitive) -> Nearest:
    """Return the triangle's point closest to `point`: inside the triangle if `point` projects into it, else on an edge.

    If a corner is NaN or infinite, d2 is infinite."""
    p = wp.vec3d(point)
    a = wp.vec3d(triangle.v0)
    b = wp.vec3d(triangle.v1)
    c = wp.vec3d(triangle.v2)
    ab = b - a
    ac = c - a
    ap = p - a
    normal = wp.cross(ab, ac)
    area = wp.dot(normal, normal)
    if not area < wp.float64(wp.inf):  # True only for corners that are not finite: float32 corners cannot overflow float64 here.
        return nothing_near()
    v = wp.dot(wp.cross(ab, ap), normal)
    u = wp.dot(wp.cross(ap, ac), normal)
    if u > wp.float64(0.0) and v > wp.float64(0.0) and u + v < area:
        out = Nearest()
        out.u = u / area
        out.v = v / area
        height = wp.dot(ap, normal)
        out.d2 = height * height / area
        out.point = a + out.u * ab + out.v * ac
        return out
    return on_edges(p, a, b, c)


@wp.func
def nearer(p: wp.vec3, triangle: Primitive, flat: bool, best: Nearest) -> Nearest:
    """Return the closer to p of `best` and the triangle's point. At equal distance, return the point with the lower prim_id."""
    lo = lower(lower(triangle.v0, triangle.v1), triangle.v2)
    hi = upper(upper(triangle.v0, triangle.v1), triangle.v2)
    pad = box_pad(lo, hi)
    least = squared_distance(p, padded_lo(lo, pad), padded_hi(hi, pad))
    if least > best.d2:
        return best
    found = Nearest()
    if flat:
        found = on_flat(p, triangle)
    else:
        found = on_triangle(p, triangle)
    found.d2 = wp.max(found.d2, least)
    found.prim_id = triangle.prim_id
    if found.d2 < best.d2 or (found.d2 == best.d2 and best.prim_id >= 0 and found.prim_id < best.prim_id):
        return found
    return best
