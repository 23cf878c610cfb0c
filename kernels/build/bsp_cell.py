"""The cells of a BSP tree during its build: convex polyhedra in float64, their surface areas, and their cuts by planes.
A cell is a list of faces, convex polygons with corners counterclockwise from outside. Cells only serve the surface area heuristic: whether
a leaf lists a primitive does not depend on them. So rounding in a sliver, or a cell with too many faces, worsens the tree but loses no
hit."""

import warp as wp

MAX_FACES = wp.constant(48)
MAX_POINTS = wp.constant(288)  # a convex polyhedron with f faces has at most 6 f - 12 corners of faces


@wp.struct
class Cells:
    """Cells, each in a slot s, with n_faces[s] faces.
    Face f begins at points[s * MAX_POINTS + first[s * (MAX_FACES + 1) + f]], and ends where face f + 1 begins."""

    n_faces: wp.array(dtype=wp.int32)
    first: wp.array(dtype=wp.int32)
    points: wp.array(dtype=wp.vec3d)
    area: wp.array(dtype=wp.float64)  # Face f has the area area[s * MAX_FACES + f].


@wp.func
def plane_side(n: wp.vec3d, d: wp.float64, p: wp.vec3d) -> wp.float64:
    """Return n . p + d, the plane's value at a point: positive on the side that the normal points to."""
    return n[0] * p[0] + n[1] * p[1] + n[2] * p[2] + d


@wp.func
def snapped_side(n: wp.vec3d, d: wp.float64, eps: wp.float64, p: wp.vec3d) -> wp.float64:
    """Return the plane's value n . p + d at a point, or 0 if its size is at most eps. So all corners of a face in the plane get 0."""
    s = plane_side(n, d, p)
    return wp.where(wp.abs(s) > eps, s, wp.float64(0.0))


@wp.func
def crossing(p: wp.vec3d, q: wp.vec3d, s_p: wp.float64, s_q: wp.float64) -> wp.vec3d:
    """Return the intersection of the segment from p to q with a plane, whose values s_p at p and s_q at q have opposite signs."""
    return p + (s_p / (s_p - s_q)) * (q - p)


@wp.func
def turn(x: wp.float64, y: wp.float64) -> wp.float64:
    """Return a monotone function of the angle of (x, y), from -2 at -pi to 2 at pi; (x, y) must not be 0.
    Unlike atan2, it has the same bits on all machines."""
    a = wp.float64(1.0) - x / (wp.abs(x) + wp.abs(y))
    return wp.where(y < wp.float64(0.0), -a, a)


@wp.func
def box_cell(cells: Cells, slot: int, lo: wp.vec3d, hi: wp.vec3d):
    """Write the box lo .. hi, six quads, to a slot."""
    for face in range(6):
        axis = face / 2
        a = (axis + 1) % 3
        b = (axis + 2) % 3
        for k in range(4):
            # The square (0,0), (1,0), (1,1), (0,1) is counterclockwise about +axis; the low face has the reverse order.
            i = wp.where(face % 2 == 1, k, 3 - k)
            p = wp.vec3d()
            p[axis] = wp.where(face % 2 == 1, hi[axis], lo[axis])
            p[a] = wp.where(i == 1 or i == 2, hi[a], lo[a])
            p[b] = wp.where(i >= 2, hi[b], lo[b])
            cells.points[slot * MAX_POINTS + face * 4 + k] = p
    for face in range(7):
        cells.first[slot * (MAX_FACES + 1) + face] = 4 * face
    cells.n_faces[slot] = 6
    measure_cell(cells, slot)


@wp.func
def points_of(cells: Cells, slot: int, face: int) -> wp.vec2i:
    """Return the range (begin, end) of a face's points in cells.points."""
    first = slot * (MAX_FACES + 1) + face
    return wp.vec2i(slot * MAX_POINTS + cells.first[first], slot * MAX_POINTS + cells.first[first + 1])


@wp.func
def measure_cell(cells: Cells, slot: int):
    """Compute and store the areas of a cell's faces."""
    for face in range(cells.n_faces[slot]):
        points = points_of(cells, slot, face)
        origin = cells.points[points[0]]
        total = wp.vec3d()
        for i in range(points[0] + 1, points[1] - 1):
            total += wp.cross(cells.points[i] - origin, cells.points[i + 1] - origin)
        cells.area[slot * MAX_FACES + face] = wp.float64(0.5) * wp.length(total)


@wp.func
def cell_area(cells: Cells, slot: int) -> wp.float64:
    """Return the surface area of a cell."""
    total = wp.float64(0.0)
    for face in range(cells.n_faces[slot]):
        total += cells.area[slot * MAX_FACES + face]
    return total


@wp.func
def copy_cell(source: Cells, slot: int, target: Cells, to: int):
    for face in range(source.n_faces[slot]):
        target.area[to * MAX_FACES + face] = source.area[slot * MAX_FACES + face]
    for face in range(source.n_faces[slot] + 1):
        target.first[to * (MAX_FACES + 1) + face] = source.first[slot * (MAX_FACES + 1) + face]
    for i in range(source.first[slot * (MAX_FACES + 1) + source.n_faces[slot]]):
        target.points[to * MAX_POINTS + i] = source.points[slot * MAX_POINTS + i]
    target.n_faces[to] = source.n_faces[slot]


@wp.struct
class CutFace:
    """A face cut by a plane."""

    above: wp.vec3d  # Twice the area vector of the face's part above the plane.
    down: wp.vec3d  # Point where an edge crosses the plane downwards, if `crossed`.
    up: wp.vec3d  # Point where an edge crosses the plane upwards, if `crossed`.
    crossed: bool  # True if edges of the face cross the plane.
    highest: wp.float64  # Largest value of the plane at a corner, at least 0.
    lowest: wp.float64  # Smallest value of the plane at a corner, at most 0.


@wp.func
def cut_face(cells: Cells, points: wp.vec2i, n: wp.vec3d, d: wp.float64, eps: wp.float64) -> CutFace:
    zero = wp.float64(0.0)
    out = CutFace()
    p = cells.points[points[1] - 1]
    s_p = snapped_side(n, d, eps, p)
    first = p
    out.down = p
    out.up = p
    for i in range(points[0], points[1]):
        q = cells.points[i]
        s_q = snapped_side(n, d, eps, q)
        out.highest = wp.max(out.highest, s_q)
        out.lowest = wp.min(out.lowest, s_q)
        if s_p >= zero and s_q >= zero:
            out.above += wp.cross(p - first, q - first)
        elif s_p >= zero:
            out.down = crossing(p, q, s_p, s_q)
            out.above += wp.cross(p - first, out.down - first)
            out.crossed = True
        elif s_q >= zero:
            out.up = crossing(p, q, s_p, s_q)
            out.above += wp.cross(out.up - first, q - first)
            out.crossed = True
        p = q
        s_p = s_q
    if out.crossed:
        out.above += wp.cross(out.down - first, out.up - first)
    return out


@wp.func
def split_areas(cells: Cells, slot: int, n: wp.vec3d, d: wp.float64, eps: wp.float64) -> wp.vec2d:
    """Return the surface areas (below, above) of a cell's parts on both sides of a plane; eps: see snapped_side.
    Each area includes the cut, the polygon in which the plane meets the cell. The cut has an edge for each face that the plane crosses. Its
    area is the sum of the triangles of these edges with a point of the cut, in any order. If the plane contains a face, or the cell has no
    volume, one part has no volume: its area is at least twice the cut's."""
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    below = wp.float64(0.0)
    above = wp.float64(0.0)
    closing = wp.float64(0.0)
    within = wp.float64(0.0)  # area of the faces in the plane
    cut = wp.vec3d()
    on_cut = wp.vec3d()
    met = bool(False)
    for face in range(cells.n_faces[slot]):
        part = cut_face(cells, points_of(cells, slot, face), n, d, eps)
        area = cells.area[slot * MAX_FACES + face]
        if part.crossed:
            high = wp.min(half * wp.length(part.above), area)
            above += high
            below += area - high
            if not met:
                on_cut = part.down
                met = True
            cut += wp.cross(part.down - on_cut, part.up - on_cut)
        elif part.highest > zero:
            above += area
        elif part.lowest < zero:
            below += area
        else:
            closing = wp.max(closing, area)
            within += area
    closing = wp.max(closing, half * wp.length(cut))
    within = wp.max(within, closing)
    return wp.vec2d(wp.max(below + within, closing + closing), wp.max(above + within, closing + closing))


@wp.func
def order_by_angle(rim: wp.array(dtype=wp.vec3d), count: int, center: wp.vec3d, n: wp.vec3d):
    """Sort the first `count` points of `rim`, the corners of a cut, by their angle around `center`, counterclockwise about -n."""
    x_axis = wp.normalize(rim[0] - center)
    y_axis = wp.cross(x_axis, n)
    angle = wp.zeros(shape=48, dtype=wp.float64)
    for i in range(count):
        c = rim[i]
        a = turn(wp.dot(c - center, x_axis), wp.dot(c - center, y_axis))
        k = int(i)
        while k > 0 and angle[wp.max(k - 1, 0)] > a:
            angle[k] = angle[k - 1]
            rim[k] = rim[k - 1]
            k = k - 1
        angle[k] = a
        rim[k] = c


@wp.func
def clip_cell(cells: Cells, slot: int, to: int, n: wp.vec3d, d: wp.float64, eps: wp.float64):
    """Copy the part of a cell with n . p + d >= 0 to slot `to`. If it has too many faces or points for a slot, copy the whole cell."""
    zero = wp.float64(0.0)
    rim = wp.zeros(shape=48, dtype=wp.vec3d)
    n_rim = int(0)
    faces = int(0)
    size = int(0)
    base = to * MAX_POINTS
    full = bool(False)
    center = wp.vec3d()
    for face in range(cells.n_faces[slot]):
        points = points_of(cells, slot, face)
        start = int(size)
        if size + (points[1] - points[0]) + 2 > MAX_POINTS:
            full = True
            break
        p = cells.points[points[1] - 1]
        s_p = snapped_side(n, d, eps, p)
        leaves = int(0)
        for i in range(points[0], points[1]):
            q = cells.points[i]
            s_q = snapped_side(n, d, eps, q)
            if (s_p >= zero) != (s_q >= zero):
                c = crossing(p, q, s_p, s_q)
                if s_p != zero and s_q != zero:  # else p or q is the crossing
                    cells.points[base + size] = c
                    size = size + 1
                if s_p >= zero and leaves == 0 and n_rim < MAX_FACES:
                    rim[n_rim] = c  # store each corner of the cut once: two outlines of faces cross the plane there, in opposite directions
                    center += c
                    n_rim = n_rim + 1
                    leaves = 1
            if s_q >= zero:
                cells.points[base + size] = q
                size = size + 1
            p = q
            s_p = s_q
        if size - start >= 3:
            cells.first[to * (MAX_FACES + 1) + faces] = start
            faces = faces + 1
        else:
            size = start
    if full or faces + 1 > MAX_FACES or size + n_rim > MAX_POINTS:
        copy_cell(cells, slot, cells, to)
        return

    if n_rim >= 3:  # the cut closes the cell
        order_by_angle(rim, n_rim, center / wp.float64(n_rim), n)
        cells.first[to * (MAX_FACES + 1) + faces] = size
        for i in range(n_rim):
            cells.points[base + size + i] = rim[i]
        size = size + n_rim
        faces = faces + 1
    cells.first[to * (MAX_FACES + 1) + faces] = size
    cells.n_faces[to] = faces
    measure_cell(cells, to)
