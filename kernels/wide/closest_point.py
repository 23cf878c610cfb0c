"""Closest points on a mesh: a walk over a wide BVH in the order of distance from a point.

A triangle without area has NaN in the first corner of its record, so that no ray hits it. But points have a distance to it: it is a segment
or a point. So its corners are read from the mesh.

The distance to a triangle is computed in float64 (Ericson 2005, "Real-Time Collision Detection", section 5.1). It is clamped to at least
the distance to the triangle's padded box. Rounding is monotone, so no box of a node above a triangle is farther than the triangle.
Therefore the nearest triangle does not depend on the tree."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import Primitive, Surfaces, kernel, noinline
from wrt.kernels.traverse.stack import key_of, make_uninitialized, reference_of, t_of
from wrt.kernels.units.box import box_pad, padded_hi, padded_lo
from wrt.kernels.units.triangle import lower, upper
from wrt.kernels.wide.lanes import bits
from wrt.kernels.wide.layout import HI_X, HI_Y, HI_Z, LO_X, LO_Y, LO_Z, STACK_SIZE, NodeLayout
from wrt.kernels.wide.nodes import make_plane
from wrt.kernels.wide.references import EMPTY, leaf_count, leaf_first
from wrt.kernels.wide.traverse import make_gather, make_struct, row_size

empty_stack = make_uninitialized(STACK_SIZE, wp.uint64)
NOTHING = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))  # No node: greater than every stack entry.


@wp.struct
class Nearest:
    """A point on a triangle, and its squared distance from the query point; prim_id = -1: no triangle found."""

    d2: wp.float64
    point: wp.vec3d
    u: wp.float64
    v: wp.float64
    prim_id: int


@wp.struct
class PointArrays:
    """Closest points, one entry per query point. If no triangle was found, distance is inf, prim_id is -1, and all other entries are 0."""

    distance: wp.array(dtype=wp.float32)
    point: wp.array(dtype=wp.vec3)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)
    prim_id: wp.array(dtype=wp.int32)


@wp.func
def squared_distance(p: Any, lo: wp.vec3, hi: wp.vec3) -> wp.float64:
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
def on_edges(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> Nearest:
    """Return the point closest to p on the three edges of the triangle a b c."""
    out = Nearest()
    out.d2 = wp.float64(wp.inf)
    out = nearer_edge(p, a, b, out, 0, 1)
    out = nearer_edge(p, b, c, out, 1, 2)
    return nearer_edge(p, c, a, out, 2, 0)


@wp.func
def on_triangle(point: wp.vec3, triangle: Primitive) -> Nearest:
    """Return the triangle's point closest to `point`: inside the triangle if `point` projects into it, else on an edge.

    If a corner is NaN or infinite, as in the record of a triangle without area, d2 is infinite."""
    p = wp.vec3d(point)
    a = wp.vec3d(triangle.v0)
    b = wp.vec3d(triangle.v1)
    c = wp.vec3d(triangle.v2)
    out = Nearest()
    out.d2 = wp.float64(wp.inf)
    ab = b - a
    ac = c - a
    ap = p - a
    normal = wp.cross(ab, ac)
    area = wp.dot(normal, normal)
    if not area < wp.float64(wp.inf):  # True only for corners that are not finite: float32 corners cannot overflow float64 here.
        return out
    v = wp.dot(wp.cross(ab, ap), normal)
    u = wp.dot(wp.cross(ap, ac), normal)
    if u > wp.float64(0.0) and v > wp.float64(0.0) and u + v < area:
        out.u = u / area
        out.v = v / area
        height = wp.dot(ap, normal)
        out.d2 = height * height / area
        out.point = a + out.u * ab + out.v * ac
        return out
    return on_edges(p, a, b, c)


@wp.func
def nearer_of(p: wp.vec3, triangle: Primitive, on: Nearest, best: Nearest) -> Nearest:
    """Return the closer to p of `best` and `on`, a point on this triangle. At equal distance, return the point with the lower prim_id."""
    lo = lower(lower(triangle.v0, triangle.v1), triangle.v2)
    hi = upper(upper(triangle.v0, triangle.v1), triangle.v2)
    pad = box_pad(lo, hi)
    found = on
    found.d2 = wp.max(found.d2, squared_distance(p, padded_lo(lo, pad), padded_hi(hi, pad)))
    found.prim_id = triangle.prim_id
    if found.d2 < best.d2 or (found.d2 == best.d2 and best.prim_id >= 0 and found.prim_id < best.prim_id):
        return found
    return best


@noinline
def nearer_flat(p: wp.vec3, surfaces: Surfaces, prim_id: int, best: Nearest) -> Nearest:
    """Return the closer to p of `best` and a triangle without area: its three edges. The corners are read from the mesh."""
    face = surfaces.faces[prim_id]
    triangle = Primitive()
    triangle.v0 = surfaces.vertices[face[0]]
    triangle.v1 = surfaces.vertices[face[1]]
    triangle.v2 = surfaces.vertices[face[2]]
    triangle.prim_id = prim_id
    if not (wp.isfinite(triangle.v0) and wp.isfinite(triangle.v1) and wp.isfinite(triangle.v2)):
        return best
    on = on_edges(wp.vec3d(p), wp.vec3d(triangle.v0), wp.vec3d(triangle.v1), wp.vec3d(triangle.v2))
    return nearer_of(p, triangle, on, best)


class PointSearch(NamedTuple):
    """Functions of a walk over one BVH. `place` is the query point, or the record that kernels.wide.closest_placed has of it."""

    nearest_in_leaf: Any  # (accel, surfaces, reference, place, best) -> the closer of `best` and the points on the leaf's triangles.
    point: Any  # (place) -> point in the space of the boxes.
    reach: Any  # (place, best) -> largest squared distance of a box that may contain a point as close as `best`.


@wp.func
def itself(p: wp.vec3) -> wp.vec3:
    return p


@wp.func
def best_d2(p: wp.vec3, best: Nearest) -> wp.float64:
    return best.d2


def make_search(layout: NodeLayout) -> PointSearch:
    """Make the functions of a walk over one mesh in world space."""
    struct, gather = make_struct(Primitive), make_gather(Primitive, layout.width)
    width, size_of_row = layout.width, row_size(Primitive, layout.width)

    @wp.func
    def nearest_in_leaf(accel: struct, surfaces: Surfaces, reference: int, p: wp.vec3, best: Nearest) -> Nearest:
        begin = leaf_first(reference) * wp.static(layout.unit)
        for i in range(begin, begin + leaf_count(reference)):
            row = i / width
            record = gather(accel.primitives, row * size_of_row + i - row * width)
            found = on_triangle(p, record)
            if found.d2 < wp.float64(wp.inf):
                best = nearer_of(p, record, found, best)
            else:
                best = nearer_flat(p, surfaces, record.prim_id, best)
        return best

    return PointSearch(nearest_in_leaf, itself, best_d2)


@wp.func
def nothing_near() -> Nearest:
    best = Nearest()
    best.d2 = wp.float64(wp.inf)
    best.prim_id = -1
    return best


def make_closest_point(layout: NodeLayout, search: PointSearch) -> Any:
    """Return closest_point(accel, surfaces, place, best) -> Nearest: the closer of `best` and the closest point on any triangle."""
    struct, (nearest_in_leaf, point, reach) = make_struct(Primitive), search
    plane, exists = make_plane(layout.width, layout.compressed)

    @wp.func
    def distance_to_child(accel: struct, first: int, j: int, p: Any) -> wp.float64:
        lo = wp.vec3(plane(accel.nodes, first, LO_X, j), plane(accel.nodes, first, LO_Y, j), plane(accel.nodes, first, LO_Z, j))
        hi = wp.vec3(plane(accel.nodes, first, HI_X, j), plane(accel.nodes, first, HI_Y, j), plane(accel.nodes, first, HI_Z, j))
        return squared_distance(p, lo, hi)

    @wp.func
    def closest_point(accel: struct, surfaces: Any, place: Any, best: Nearest) -> Nearest:
        p = point(place)
        stack = empty_stack()
        size = int(0)
        reference = int(0)
        while True:
            near = wp.uint64(NOTHING)
            if reference < 0:
                best = nearest_in_leaf(accel, surfaces, reference, place, best)
            else:
                first = reference * wp.static(layout.size)
                for j in range(wp.static(layout.width)):
                    child = bits(accel.nodes, first + wp.static(layout.references) + j)
                    if child != EMPTY and exists(accel.nodes, first, j):
                        d2 = distance_to_child(accel, first, j, p)
                        if d2 <= reach(place, best):
                            key = key_of(float(d2), child)
                            far = wp.max(near, key)
                            near = wp.min(near, key)
                            if far != NOTHING:
                                stack[size] = far
                                size = size + 1
            # Next is the nearest child or, without one, an entry of the stack. Entries farther than the best are dropped, but not entries
            # at the same distance: they may have a lower prim_id.
            while near == NOTHING and size > 0:
                size = size - 1
                if t_of(stack[size]) <= float(reach(place, best)):
                    near = stack[size]
            if near == NOTHING:
                break
            reference = reference_of(near)
        return best

    return closest_point


@wp.func
def store_nearest(out: PointArrays, i: int, found: Nearest):
    out.distance[i] = float(wp.sqrt(found.d2))
    out.point[i] = wp.vec3(found.point)
    out.u[i] = float(found.u)
    out.v[i] = float(found.v)
    out.prim_id[i] = found.prim_id


@cache
def make_closest_point_kernel(layout: NodeLayout) -> Any:
    """Return the kernel for points first .. first + dim - 1 (dim: launch size). The tree's primitives have the layout "corners"."""
    struct, closest_point = make_struct(Primitive), make_closest_point(layout, make_search(layout))

    @kernel
    def closest_points(accel: struct, surfaces: Surfaces, points: wp.array(dtype=wp.vec3), out: PointArrays, first: int):
        i = first + wp.tid()
        store_nearest(out, i, closest_point(accel, surfaces, points[i], nothing_near()))

    return closest_points
