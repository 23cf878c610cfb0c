"""The test of a padded triangle against a cell of a grid or octree: whether the cell must list the triangle.
Separating axes of a triangle and a box: Akenine-Moeller 2001, "Fast 3D Triangle-Box Overlap Testing" (JGT 6(1)). The test leaves out the
axes of the box, because the caller has compared the cell with the triangle's padded box."""

import warp as wp


@wp.struct
class CellSource:
    """Triangles, and the padded boxes lo .. hi of all primitives: first the triangles, then the spheres."""

    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    lo: wp.array(dtype=wp.vec3)
    hi: wp.array(dtype=wp.vec3)


@wp.struct
class TriangleCell:
    """A triangle set up for the test, in float64: rounding errors are far below the pad."""

    v0: wp.vec3d
    v1: wp.vec3d
    v2: wp.vec3d
    normal: wp.vec3d  # Normal of the triangle's plane, not normalised.
    grow: wp.vec3d  # Pad of the triangle's box along each axis.


@wp.func
def triangle_cell(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3, lo: wp.vec3, hi: wp.vec3) -> TriangleCell:
    """Set up a triangle for the test; lo, hi: its padded box.
    The triangle, grown by the pad, contains every hit that the triangle unit may accept, except for errors proportional to the hit's
    distance. The traversal covers these (kernels.traverse.cell_ray)."""
    out = TriangleCell()
    out.v0 = wp.vec3d(v0)
    out.v1 = wp.vec3d(v1)
    out.v2 = wp.vec3d(v2)
    out.normal = wp.cross(out.v1 - out.v0, out.v2 - out.v0)
    below = wp.vec3d(wp.min(wp.min(v0, v1), v2)) - wp.vec3d(lo)
    above = wp.vec3d(hi) - wp.vec3d(wp.max(wp.max(v0, v1), v2))
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
