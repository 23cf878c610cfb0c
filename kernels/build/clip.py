"""Clip triangles to axis-aligned cells and return the boxes of the clipped polygons, for builders on the CPU.
Sutherland and Hodgman 1974, "Reentrant Polygon Clipping", in float64. The triangle unit accepts hits slightly beside a triangle: within a
few u (2^-24) of its extent. So the cell grows by a margin of twice this distance. The resulting box grows by the same margin. Then no hit
on the triangle lies in a leaf that does not list the triangle."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.units.box import PAD_COORDINATE, PAD_EXTENT

CLIP_EXTENT = wp.constant(wp.float64(2.0 * PAD_EXTENT))
CLIP_COORDINATE = wp.constant(wp.float64(PAD_COORDINATE))
MAX_CORNERS = 12  # 3 of a triangle, 1 more for each of six planes, and 3 in case that rounding adds some


@wp.struct
class Clippable:
    """The primitives of a scene: faces, lo, hi and exact are indexed by prim_id."""

    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    lo: wp.array(dtype=wp.vec3)  # lo, hi: the primitives' padded boxes.
    hi: wp.array(dtype=wp.vec3)
    exact: wp.array(dtype=wp.uint8)  # 1: clip the triangle; 0: clip its box (for spheres, and for triangles near float32's limits).


@wp.struct
class Box:
    """A box; an empty box has lo = inf, hi = -inf."""

    lo: wp.vec3
    hi: wp.vec3


@wp.func
def empty_box() -> Box:
    box = Box()
    box.lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    box.hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    return box


@wp.func
def within_cell(lo: wp.vec3, hi: wp.vec3, cell_lo: wp.vec3, cell_hi: wp.vec3) -> Box:
    """Return the intersection of a box with a cell, or an empty box if the intersection has no volume."""
    box = Box()
    box.lo = wp.max(lo, cell_lo)
    box.hi = wp.min(hi, cell_hi)
    if not (box.lo[0] < box.hi[0] and box.lo[1] < box.hi[1] and box.lo[2] < box.hi[2]):
        return empty_box()
    return box


@wp.func
def cut_by_plane(polygon: wp.array(dtype=wp.vec3d), n: int, clipped: wp.array(dtype=wp.vec3d), axis: int, sign: wp.float64,
                 wall: wp.float64) -> int:
    """Clip a polygon of n corners, in place, to the side of the plane p[axis] = wall that `sign` selects (1 above, -1 below).
    Return the new number of corners, at most MAX_CORNERS; further corners are dropped. The array `clipped` is scratch."""
    m = int(0)
    last = polygon[n - 1]
    last_inside = sign * (last[axis] - wall)
    for i in range(n):
        corner = polygon[i]
        inside = sign * (corner[axis] - wall)
        if (inside < wp.float64(0.0)) != (last_inside < wp.float64(0.0)) and m < wp.static(MAX_CORNERS):
            cut = last + (last_inside / (last_inside - inside)) * (corner - last)
            cut[axis] = wall
            clipped[m] = cut
            m = m + 1
        if inside >= wp.float64(0.0) and m < wp.static(MAX_CORNERS):
            clipped[m] = corner
            m = m + 1
        last = corner
        last_inside = inside
    for i in range(m):
        polygon[i] = clipped[i]
    return m


@wp.func
def clip_triangle(polygon: wp.array(dtype=wp.vec3d), clipped: wp.array(dtype=wp.vec3d), lo: wp.vec3d, hi: wp.vec3d) -> int:
    """Clip the triangle at the front of `polygon` to the box lo .. hi, in place; return the number of corners.
    If the number is MAX_CORNERS, corners may be missing, and the polygon is not usable. The array `clipped` is scratch."""
    low = wp.min(wp.min(polygon[0], polygon[1]), polygon[2])
    high = wp.max(wp.max(polygon[0], polygon[1]), polygon[2])
    n = int(3)
    planes = int(6)
    for plane in range(planes):
        axis = plane / 2
        sign = wp.where(plane % 2 == 0, wp.float64(1.0), wp.float64(-1.0))
        wall = wp.where(plane % 2 == 0, lo[axis], hi[axis])
        if wp.where(plane % 2 == 0, low[axis] < wall, high[axis] > wall):
            n = cut_by_plane(polygon, n, clipped, axis, sign, wall)
            if n == 0 or n == wp.static(MAX_CORNERS):
                return n
    return n


@wp.func
def clip_to_cell(shapes: Clippable, prim_id: int, cell_lo: wp.vec3, cell_hi: wp.vec3) -> Box:
    """Return the box of a primitive's part in a cell, grown by the margin, then cut off at the cell. Without such a part, it is empty."""
    if shapes.exact[prim_id] == wp.uint8(0):
        return within_cell(shapes.lo[prim_id], shapes.hi[prim_id], cell_lo, cell_hi)
    polygon = wp.zeros(shape=wp.static(MAX_CORNERS), dtype=wp.vec3d)
    clipped = wp.zeros(shape=wp.static(MAX_CORNERS), dtype=wp.vec3d)
    face = shapes.faces[prim_id]
    for i in range(3):
        polygon[i] = wp.vec3d(shapes.vertices[face[i]])
    e = wp.max(wp.max(polygon[0], polygon[1]), polygon[2]) - wp.min(wp.min(polygon[0], polygon[1]), polygon[2])
    pad = CLIP_EXTENT * wp.max(wp.max(e[0], e[1]), e[2])
    margin = wp.vec3d(pad, pad, pad)
    low = wp.vec3d(cell_lo)
    high = wp.vec3d(cell_hi)
    n = clip_triangle(polygon, clipped, low - (margin + CLIP_COORDINATE * wp.abs(low)),
                      high + (margin + CLIP_COORDINATE * wp.abs(high)))
    if n == 0:
        return empty_box()
    if n == wp.static(MAX_CORNERS):
        return within_cell(shapes.lo[prim_id], shapes.hi[prim_id], cell_lo, cell_hi)
    lo = polygon[0]
    hi = polygon[0]
    for i in range(n):
        lo = wp.min(lo, polygon[i])
        hi = wp.max(hi, polygon[i])
    lo = lo - margin - CLIP_COORDINATE * wp.abs(lo)
    hi = hi + margin + CLIP_COORDINATE * wp.abs(hi)
    return within_cell(wp.vec3(lo), wp.vec3(hi), cell_lo, cell_hi)


@kernel
def clip_references(shapes: Clippable, prim_id: wp.array(dtype=wp.int32), cell_lo: wp.vec3, cell_hi: wp.vec3,
                    lo: wp.array(dtype=wp.vec3), hi: wp.array(dtype=wp.vec3)):
    """Store in lo[i] and hi[i] the box that clip_to_cell returns for the primitive prim_id[i]."""
    i = wp.tid()
    box = clip_to_cell(shapes, prim_id[i], cell_lo, cell_hi)
    lo[i] = box.lo
    hi[i] = box.hi
