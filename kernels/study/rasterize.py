"""A rasterizer with a z-buffer, in float64.

It computes the same hits as rays through the pixels' centres, by another method and without code of the ray units. So rasterizer and ray
units can check each other. Triangles are in homogeneous pixel coordinates (Olano and Greer 1997, "Triangle scan conversion using 2D
homogeneous coordinates"), so that a triangle through the camera's plane needs no clipping. Each pixel stores the smallest key (depth,
prim_id), so the order of triangles does not matter.
"""

import warp as wp

from wrt.kernels.structs import kernel

ROUNDOFF = wp.constant(wp.float64(2.0**-53))
SPLITTER = wp.constant(wp.float64(2.0**27 + 1.0))
CENTRE_PAD = wp.constant(wp.float64(1e-9))  # in pixels; exceeds the rounding error of a projected vertex
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))


@wp.struct
class View:
    """A pinhole camera and its picture."""

    origin: wp.vec3d
    from_pixels: wp.mat33d  # Maps (x, y, 1), in pixels from the top left corner, to a direction with component 1 along the view axis.
    to_pixels: wp.mat33d  # Inverse of from_pixels: maps a point minus `origin` to homogeneous pixels (x w, y w, w).
    width: int
    height: int


@wp.struct
class Edge:
    """An edge function normal . (x, y, 1), which is 0 on the edge."""

    normal: wp.vec3d
    slack: wp.float64  # Bound on the function's rounding error.


@kernel
def project(view: View, vertices: wp.array(dtype=wp.vec3), first: int, projected: wp.array(dtype=wp.vec3d)):
    """Project vertices to homogeneous pixels. Each vertex is rounded once, so triangles that share it use the same coordinates."""
    i = first + wp.tid()
    projected[i] = view.to_pixels @ (wp.vec3d(vertices[i]) - view.origin)


@wp.func
def has_extent(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> bool:
    """Test whether the corners are not on one line."""
    p = wp.vec3d(v0)
    n = wp.cross(wp.vec3d(v1) - p, wp.vec3d(v2) - p)
    return n[0] != ZERO or n[1] != ZERO or n[2] != ZERO


@wp.func
def centres_between(low: wp.float64, high: wp.float64, size: int) -> wp.vec2i:
    """Return the first and the last of the pixels 0 .. size - 1 with a centre in [low, high]; first > last if there is no such pixel."""
    end = wp.float64(size)
    first = wp.ceil(wp.clamp(low, ZERO, end) - HALF - CENTRE_PAD)
    last = wp.floor(wp.clamp(high, ZERO, end) - HALF + CENTRE_PAD)
    return wp.vec2i(wp.max(int(first), 0), wp.min(int(last), size - 1))


@wp.func
def pixel_box(view: View, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec4i:
    """Return the box of pixels (x0, y0, x1, y1), inclusive, that a triangle may cover; x0 > x1 if it covers none.
    For a triangle in front of the camera's plane, this is the box around its projected corners. For a triangle through the plane, it is
    the whole picture, unless all corners are outside the same border of the picture."""
    none = wp.vec4i(0, 0, -1, -1)
    if a[2] > ZERO and b[2] > ZERO and c[2] > ZERO:
        ax = a[0] / a[2]
        bx = b[0] / b[2]
        cx = c[0] / c[2]
        columns = centres_between(wp.min(ax, wp.min(bx, cx)), wp.max(ax, wp.max(bx, cx)), view.width)
        if columns[0] > columns[1]:
            return none
        ay = a[1] / a[2]
        by = b[1] / b[2]
        cy = c[1] / c[2]
        rows = centres_between(wp.min(ay, wp.min(by, cy)), wp.max(ay, wp.max(by, cy)), view.height)
        if rows[0] > rows[1]:
            return none
        return wp.vec4i(columns[0], rows[0], columns[1], rows[1])
    if a[2] < ZERO and b[2] < ZERO and c[2] < ZERO:
        return none
    for axis in range(2):
        end = wp.float64(wp.where(axis == 0, view.width, view.height))
        if a[axis] < ZERO and b[axis] < ZERO and c[axis] < ZERO:
            return none
        if a[axis] > end * a[2] and b[axis] > end * b[2] and c[axis] > end * c[2]:
            return none
    return wp.vec4i(0, 0, view.width - 1, view.height - 1)


@kernel
def bound(view: View, vertices: wp.array(dtype=wp.vec3), projected: wp.array(dtype=wp.vec3d), faces: wp.array(dtype=wp.vec3i), first: int,
          boxes: wp.array(dtype=wp.vec4i)):
    """Store the pixel_box of each triangle. The box is empty for most small triangles, because they lie between the pixels' centres."""
    i = first + wp.tid()
    f = faces[i]
    box = pixel_box(view, projected[f[0]], projected[f[1]], projected[f[2]])
    if box[0] <= box[2]:
        if not has_extent(vertices[f[0]], vertices[f[1]], vertices[f[2]]):
            box = wp.vec4i(0, 0, -1, -1)
    boxes[i] = box


@wp.func
def edge_between(p: wp.vec3d, q: wp.vec3d, size: wp.vec2d) -> Edge:
    """Return the edge function of Olano and Greer: the plane through the camera and the edge's ends p and q. `size`: of the picture.
    Exchanging p and q negates the function exactly. The `slack` bounds the difference from `turn` at the same pixel: `turn` rounds
    p - (x, y) p_w in each factor, and this function rounds three products. The products are below (|p_x| + width |p_w|)
    (|q_y| + height |q_w|), or below the same expression with p and q exchanged."""
    edge = Edge()
    edge.normal = wp.cross(p, q)
    p_x = wp.abs(p[0]) + size[0] * wp.abs(p[2])
    p_y = wp.abs(p[1]) + size[1] * wp.abs(p[2])
    q_x = wp.abs(q[0]) + size[0] * wp.abs(q[2])
    q_y = wp.abs(q[1]) + size[1] * wp.abs(q[2])
    edge.slack = wp.float64(16.0) * ROUNDOFF * (p_x * q_y + p_y * q_x)
    return edge


@wp.func
def cut(span: wp.vec2d, edge: Edge, side: wp.float64, y: wp.float64) -> wp.vec2d:
    """Clip the pixel row y's span from x = span[0] to span[1] to one side (1 or -1) of an edge that is moved outwards by edge.slack."""
    slope = side * edge.normal[0]
    rest = side * (edge.normal[1] * y + edge.normal[2]) + edge.slack
    if slope > ZERO:
        return wp.vec2d(wp.max(span[0], -rest / slope), span[1])
    if slope < ZERO:
        return wp.vec2d(span[0], wp.min(span[1], -rest / slope))
    return wp.where(rest < ZERO, wp.vec2d(ZERO, -wp.float64(1.0)), span)


@wp.func
def product_error(a: wp.float64, b: wp.float64) -> wp.float64:
    """Return the exact rounding error of a * b, which must not over- or underflow (Dekker 1971, section 5.9)."""
    t = SPLITTER * a
    a_high = t - (t - a)
    a_low = a - a_high
    t = SPLITTER * b
    b_high = t - (t - b)
    b_low = b - b_high
    return ((a_high * b_high - a * b) + a_high * b_low + a_low * b_high) + a_low * b_low


@wp.func
def turn(p: wp.vec2d, q: wp.vec2d) -> wp.float64:
    """Return twice the signed area of the triangle (0, p, q), with the exact sign. Exchanging p and q negates the result exactly.
    Rounding is monotone, so two products that round to different numbers are in the right order. Else, their rounding errors decide."""
    left = p[0] * q[1]
    right = p[1] * q[0]
    if left != right:
        return left - right
    return product_error(p[0], q[1]) - product_error(p[1], q[0])


@wp.func
def owns(p: wp.vec2d, q: wp.vec2d, area: wp.float64) -> bool:
    """Apply the fill rule: return whether a triangle owns a pixel whose centre, the origin here, is on the triangle's edge from p to q.
    The rule moves all centres right by an infinitesimal, and down by a smaller one. So exactly one of two neighbours owns a centre on their
    common edge, and exactly one of a fan of triangles owns a centre on their common corner. The triangle's area may have any sign. The edge
    must be in front of the camera, with p and q on opposite sides of the centre."""
    if p[1] != q[1]:
        return (p[1] > q[1]) == (area > ZERO)
    return (q[0] > p[0]) == (area > ZERO)


@wp.func
def depth_at(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.float64:
    """Return the depth at which the line through a pixel's centre meets a triangle, in units of the direction (x, y, 1); < 0 on a miss.
    The corners are moved so that the centre is the origin. This rounds, but equally for all triangles that share a corner. Later decisions
    are exact, so no centre falls between two triangles. Both sides of a triangle count. Edge-on or behind the camera is a miss."""
    p = wp.vec2d(a[0] - x * a[2], a[1] - y * a[2])
    q = wp.vec2d(b[0] - x * b[2], b[1] - y * b[2])
    r = wp.vec2d(c[0] - x * c[2], c[1] - y * c[2])
    w_a = turn(q, r)
    w_b = turn(r, p)
    w_c = turn(p, q)
    miss = -wp.float64(1.0)
    if (w_a < ZERO or w_b < ZERO or w_c < ZERO) and (w_a > ZERO or w_b > ZERO or w_c > ZERO):
        return miss
    area = w_a + w_b + w_c
    if area == ZERO:
        return miss
    if w_a == ZERO and not owns(q, r, area):
        return miss
    if w_b == ZERO and not owns(r, p, area):
        return miss
    if w_c == ZERO and not owns(p, q, area):
        return miss
    return (w_a * a[2] + w_b * b[2] + w_c * c[2]) / area


@wp.func
def key_of(depth: wp.float32, prim_id: int) -> wp.uint64:
    """Return a key that sorts by depth, then by prim_id. For floats >= 0, the bits have the same order as the values."""
    return (wp.uint64(wp.cast(depth, wp.uint32)) << wp.uint64(32)) | wp.uint64(prim_id)


@wp.struct
class Corners:
    """A triangle in homogeneous pixels."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d
    prim_id: int


@wp.func
def draw_row(view: View, corners: Corners, columns: wp.vec2i, row: int, keys: wp.array(dtype=wp.uint64)):
    """Update the keys of those pixels columns[0] .. columns[1] of a row that a triangle covers."""
    y = wp.float64(row) + HALF
    for column in range(columns[0], columns[1] + 1):
        x = wp.float64(column) + HALF
        w = depth_at(corners.a, corners.b, corners.c, x, y)
        if w >= ZERO:
            # The key of -0 would be greater than all others, so take the absolute value.
            depth = wp.float32(wp.abs(w) * wp.length(view.from_pixels @ wp.vec3d(x, y, wp.float64(1.0))))
            if wp.isfinite(depth):
                wp.atomic_min(keys, row * view.width + column, key_of(depth, corners.prim_id))


@kernel
def rasterize(view: View, projected: wp.array(dtype=wp.vec3d), faces: wp.array(dtype=wp.vec3i), boxes: wp.array(dtype=wp.vec4i),
              prim_ids: wp.array(dtype=wp.int32), bands: wp.vec2i, keys: wp.array(dtype=wp.uint64)):
    """Draw triangles in bands of rows. The launch has the dimensions (bands, triangles); bands: (first row, rows per band).
    On CUDA, threads may share a pixel, because atomic_min is atomic. On the CPU it is not atomic: each band needs its own launch."""
    band, i = wp.tid()
    corners = Corners()
    corners.prim_id = prim_ids[i]
    box = boxes[corners.prim_id]
    top = wp.max(box[1], bands[0] + band * bands[1])
    bottom = wp.min(box[3], bands[0] + band * bands[1] + bands[1] - 1)
    if box[0] > box[2] or top > bottom:
        return
    f = faces[corners.prim_id]
    a = projected[f[0]]
    b = projected[f[1]]
    c = projected[f[2]]
    corners.a = a
    corners.b = b
    corners.c = c
    size = wp.vec2d(wp.float64(view.width), wp.float64(view.height))
    edge_a = edge_between(b, c, size)
    edge_b = edge_between(c, a, size)
    edge_c = edge_between(a, b, size)
    # The sign of the determinant tells the inner side of the edges of a triangle in front of the camera. If rounding makes the sign
    # uncertain, because the triangle is edge-on or passes through the camera, both sides are drawn.
    det = wp.dot(a, edge_a.normal)
    slack = wp.float64(4.0) * (
        wp.abs(a[2]) * edge_a.slack + wp.abs(b[2]) * edge_b.slack + wp.abs(c[2]) * edge_c.slack
    )
    for turned in range(2):
        side = wp.float64(1 - 2 * turned)
        if side * det >= -slack:
            for row in range(top, bottom + 1):
                y = wp.float64(row) + HALF
                span = wp.vec2d(wp.float64(box[0]) + HALF, wp.float64(box[2]) + HALF)
                span = cut(span, edge_a, side, y)
                span = cut(span, edge_b, side, y)
                span = cut(span, edge_c, side, y)
                if span[0] <= span[1]:
                    columns = wp.vec2i(int(wp.ceil(span[0] - HALF)), int(wp.floor(span[1] - HALF)))
                    draw_row(view, corners, columns, row, keys)
