"""Which part of a primitive is in a cell: clipped triangles for trees of planes, and a faster test for grids and octrees. On the CPU.
Sutherland and Hodgman 1974, "Reentrant Polygon Clipping", in float64. The triangle unit accepts hits slightly beside a triangle: within a
few u (2^-24) of its extent. So the cell grows by a margin of twice this distance. The resulting box grows by the same margin. Then no hit
on the triangle lies in a leaf that does not list the triangle."""

import warp as wp

from wrt.kernels.units.box import PAD_COORDINATE, PAD_EXTENT, half_area

CLIP_EXTENT = wp.constant(wp.float64(2.0 * PAD_EXTENT))
CLIP_COORDINATE = wp.constant(wp.float64(PAD_COORDINATE))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
MAX_CORNERS = 13  # 3 of a triangle, 1 more for each of seven planes, and 3 in case that rounding adds some


@wp.struct
class Shapes:
    """The primitives of a scene, first the triangles, then the spheres. lo, hi and exact are indexed by prim_id."""

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
def corner_of(shapes: Shapes, prim_id: int, k: int) -> wp.vec3:
    return shapes.vertices[shapes.faces[prim_id][k]]


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
def cut_by_plane(polygon: wp.array(dtype=wp.vec3d), n: int, clipped: wp.array(dtype=wp.vec3d), normal: wp.vec3d,
                 offset: wp.float64) -> int:
    """Clip a polygon of n corners, in place, to the side of the plane where dot(normal, p) + offset >= 0.
    Return the new number of corners, at most MAX_CORNERS; further corners are dropped. The array `clipped` is scratch."""
    m = int(0)
    last = polygon[n - 1]
    last_inside = wp.dot(normal, last) + offset
    for i in range(n):
        corner = polygon[i]
        inside = wp.dot(normal, corner) + offset
        if (inside < wp.float64(0.0)) != (last_inside < wp.float64(0.0)) and m < wp.static(MAX_CORNERS):
            clipped[m] = last + (last_inside / (last_inside - inside)) * (corner - last)
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
        normal = wp.vec3d()
        normal[axis] = wp.where(plane % 2 == 0, wp.float64(1.0), wp.float64(-1.0))
        wall = wp.where(plane % 2 == 0, lo[axis], hi[axis])
        if wp.where(plane % 2 == 0, low[axis] < wall, high[axis] > wall):
            n = cut_by_plane(polygon, n, clipped, normal, -normal[axis] * wall)
            if n == 0 or n == wp.static(MAX_CORNERS):
                return n
    return n


@wp.func
def clip_to_cell(shapes: Shapes, prim_id: int, cell_lo: wp.vec3, cell_hi: wp.vec3, normal: wp.vec3d, offset: wp.float64) -> Box:
    """Return the box of a primitive's part in a cell, grown by the margin, then cut off at the cell. Without such a part, it is empty.
    Triangles are also clipped to the half-space dot(normal, p) + offset >= 0; with the normal 0, there is no half-space."""
    if shapes.exact[prim_id] == wp.uint8(0):
        return within_cell(shapes.lo[prim_id], shapes.hi[prim_id], cell_lo, cell_hi)
    polygon = wp.zeros(shape=wp.static(MAX_CORNERS), dtype=wp.vec3d)
    clipped = wp.zeros(shape=wp.static(MAX_CORNERS), dtype=wp.vec3d)
    for i in range(3):
        polygon[i] = wp.vec3d(corner_of(shapes, prim_id, i))
    e = wp.max(wp.max(polygon[0], polygon[1]), polygon[2]) - wp.min(wp.min(polygon[0], polygon[1]), polygon[2])
    pad = CLIP_EXTENT * wp.max(e)
    margin = wp.vec3d(pad, pad, pad)
    low = wp.vec3d(cell_lo)
    high = wp.vec3d(cell_hi)
    n = clip_triangle(polygon, clipped, low - (margin + CLIP_COORDINATE * wp.abs(low)),
                      high + (margin + CLIP_COORDINATE * wp.abs(high)))
    if n > 0 and n < wp.static(MAX_CORNERS) and wp.dot(normal, normal) > wp.float64(0.0):
        n = cut_by_plane(polygon, n, clipped, normal, offset + pad + CLIP_COORDINATE * wp.abs(offset))
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


@wp.struct
class TriangleCell:
    """A triangle set up for the test, in float64: rounding errors are far below the pad."""

    v0: wp.vec3d
    v1: wp.vec3d
    v2: wp.vec3d
    normal: wp.vec3d  # Normal of the triangle's plane, not normalised.
    grow: wp.vec3d  # Pad of the triangle's box along each axis.


@wp.func
def triangle_cell(shapes: Shapes, prim_id: int) -> TriangleCell:
    """Set up a triangle for the test `meets_cell`.
    The triangle, grown by the pad, contains every hit that the triangle unit may accept, except for errors proportional to the hit's
    distance. The traversal covers these (kernels.traverse.planes, kernels.traverse.grid)."""
    a = corner_of(shapes, prim_id, 0)
    b = corner_of(shapes, prim_id, 1)
    c = corner_of(shapes, prim_id, 2)
    out = TriangleCell()
    out.v0 = wp.vec3d(a)
    out.v1 = wp.vec3d(b)
    out.v2 = wp.vec3d(c)
    out.normal = wp.cross(out.v1 - out.v0, out.v2 - out.v0)
    below = wp.vec3d(wp.min(wp.min(a, b), c)) - wp.vec3d(shapes.lo[prim_id])
    above = wp.vec3d(shapes.hi[prim_id]) - wp.vec3d(wp.max(wp.max(a, b), c))
    out.grow = wp.max(below, above)
    return out


@wp.func
def apart_along(u: wp.float64, v: wp.float64, a: wp.vec2d, b: wp.vec2d, half_u: wp.float64, half_v: wp.float64) -> bool:
    """Test in 2D whether the axis (u, v), at right angles to an edge, separates a box from a triangle.
    The box has its center at 0 and the half sizes half_u, half_v. Point a is on the edge, b is the opposite corner."""
    p = u * a[0] + v * a[1]
    q = u * b[0] + v * b[1]
    reach = wp.abs(u) * half_u + wp.abs(v) * half_v
    return wp.min(p, q) > reach or wp.max(p, q) < -reach


@wp.func
def edge_apart(edge: wp.vec3d, on: wp.vec3d, off: wp.vec3d, half: wp.vec3d) -> bool:
    """Test whether a cross product of `edge` with one of the three box axes separates the triangle from a cell with the half sizes `half`.
    Corner `on` of the edge and the opposite corner `off` are relative to the cell's center."""
    if apart_along(-edge[2], edge[1], wp.vec2d(on[1], on[2]), wp.vec2d(off[1], off[2]), half[1], half[2]):
        return True
    if apart_along(-edge[0], edge[2], wp.vec2d(on[2], on[0]), wp.vec2d(off[2], off[0]), half[2], half[0]):
        return True
    return apart_along(-edge[1], edge[0], wp.vec2d(on[0], on[1]), wp.vec2d(off[0], off[1]), half[0], half[1])


@wp.func
def meets_cell(triangle: TriangleCell, lo: wp.vec3, hi: wp.vec3) -> bool:
    """Test whether the grown triangle meets the closed cell lo .. hi; the triangle's padded box must meet the cell.
    Separating axes of a triangle and a box: Akenine-Moeller 2001, "Fast 3D Triangle-Box Overlap Testing" (JGT 6(1)), without the axes of
    the box, because the caller has compared the cell with the padded box.
    Conservative: it may return True for a triangle near the cell, and always does for an infinite cell. The triangle must be finite."""
    half_one = wp.float64(0.5)
    low = wp.vec3d(lo)
    high = wp.vec3d(hi)
    center = half_one * (low + high)
    half = half_one * (high - low) + triangle.grow
    a = triangle.v0 - center
    distance = wp.dot(triangle.normal, a)
    reach = wp.dot(wp.abs(triangle.normal), half)
    if wp.abs(distance) > reach:
        return False
    b = triangle.v1 - center
    c = triangle.v2 - center
    if edge_apart(b - a, a, c, half):
        return False
    if edge_apart(c - b, b, a, half):
        return False
    return not edge_apart(a - c, c, b, half)


@wp.func
def mean_of_clamped(x_0: wp.float64, x_1: wp.float64) -> wp.float64:
    """Return the mean of clamp(x, 0, 1) over the interval x_0 .. x_1."""
    low = wp.clamp(x_0, ZERO, ONE)
    high = wp.clamp(x_1, ZERO, ONE)
    if x_1 - x_0 < wp.float64(1e-9):
        return high
    return (wp.float64(0.5) * (high - low) * (high + low) + wp.max(x_1 - wp.max(x_0, ONE), ZERO)) / (x_1 - x_0)


@wp.func
def share_above(low: wp.float64, u: wp.float64, v: wp.float64) -> wp.float64:
    """Return the share of the unit square where low + u x + v y >= 0, for u and v of at least 0."""
    steep = wp.max(u, v)
    if steep == ZERO:
        return wp.where(low >= ZERO, ONE, ZERO)
    # At each place along the flat direction, the share of the steep direction that is above is 1 + (low + flat s) / steep, clamped.
    return mean_of_clamped(ONE + low / steep, ONE + (low + wp.min(u, v)) / steep)


@wp.func
def areas_of_parts(lo: wp.vec3d, hi: wp.vec3d, normal: wp.vec3d, offset: wp.float64) -> wp.vec2d:
    """Return the shares (below, above) of a box's surface area that its parts have, with the cut; (0, 0): the plane misses the box.
    The area vectors of a closed surface have the sum 0, so that the cut's is minus that of the parts of the six faces."""
    e = hi - lo
    step = wp.cw_mul(wp.abs(normal), e)
    middle = wp.float64(0.5) * wp.dot(normal, lo + hi) + offset
    low = middle - wp.float64(0.5) * (step[0] + step[1] + step[2])
    if low >= ZERO or low + step[0] + step[1] + step[2] <= ZERO:
        return wp.vec2d(ZERO, ZERO)
    above = ZERO
    cut = wp.vec3d()
    for axis in range(3):
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        near = e[u] * e[v] * share_above(low, step[u], step[v])
        far = e[u] * e[v] * share_above(low + step[axis], step[u], step[v])
        above += near + far
        cut[axis] = far - near
    total = wp.float64(2.0) * half_area(e)
    return wp.vec2d((total - above + wp.length(cut)) / total, (above + wp.length(cut)) / total)
