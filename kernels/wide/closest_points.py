"""Closest points on a mesh or on instances: a walk over a wide BVH in the order of distance from a point.

A triangle without area has NaN in the first corner of its record, so that no ray hits it. But points have a distance to it: it is a segment
or a point. So its corners are read from the mesh.

Over instances, a walk over the upper level leads to the wide BVHs in their own spaces. A map that scales the axes differently changes which
point is closest. So boxes are compared in the structure's space, with the map's least factor as the bound, and each triangle that is left
is transformed to world space and rounded to float32, as in a joined mesh. Distances and points therefore equal those of the joined mesh."""

from functools import cache
from typing import TYPE_CHECKING, Any

import warp as wp

from wrt.kernels.headers import with_headers
from wrt.kernels.structs import Primitive, kernel, on_cuda
from wrt.kernels.traverse.bvh2 import STACK_SIZE as TOP_STACK_SIZE
from wrt.kernels.traverse.bvh2 import Bvh2Node, child_of
from wrt.kernels.traverse.instances import make_struct as make_instances
from wrt.kernels.traverse.stack import key_of, make_uninitialized, reference_of, t_of
from wrt.kernels.wide.closest_triangle import Nearest, nearer, nothing_near, squared_distance
from wrt.kernels.wide.lanes import bits, lanes_only, row_type
from wrt.kernels.wide.layout import HI_X, HI_Y, HI_Z, LO_X, LO_Y, LO_Z, STACK_SIZE, NodeLayout
from wrt.kernels.wide.nodes import make_plane, node_type
from wrt.kernels.wide.references import EMPTY, leaf_count, leaf_first
from wrt.kernels.wide.traverse import make_gather, make_struct, row_size

if TYPE_CHECKING:  # type checkers skip device code (structs.py)
    from typing import no_type_check as points_kernel
else:
    def points_kernel(function):
        """Make a kernel that can call the functions of closest.h."""
        return kernel(function, extra_build_options=with_headers("wide/closest.h"))

NOTHING = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))  # No node: greater than every stack entry.
BELOW = wp.constant(1.0 - 2.0**-20)  # Factor for the rounding of boxes and squared distances to float32.
BLUR = wp.constant(2.0**-22)  # Bound on the rounding of a local point to float32, as a fraction of its largest coordinate.
ROUNDING = wp.constant(2.0**-22)  # Widening of the upper level's boxes, as a fraction of their coordinates.
POINT_ROUNDING = wp.constant(wp.float64(2.0**-36))  # Error of a local point over the point's coordinates (MAX_SPREAD).
empty_stack = make_uninitialized(STACK_SIZE, wp.uint64)
empty_keys = make_uninitialized(TOP_STACK_SIZE + 1, wp.uint64)
empty_counts = make_uninitialized(TOP_STACK_SIZE + 1, wp.int32)


@wp.struct
class PointRows:
    """Query points and their closest points. If no triangle was found, distance is inf, prim_id is -1, and all other entries are 0."""

    query: wp.array(dtype=wp.vec3)
    root: wp.array(dtype=wp.int32)  # For instances: root node of the point's world, or -1.
    distance: wp.array(dtype=wp.float32)
    point: wp.array(dtype=wp.vec3)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)
    prim_id: wp.array(dtype=wp.int32)


@wp.struct
class PointSurfaces:
    """The triangles of a mesh, or of the structures below instances. All other fields are for instances only."""

    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    first_face: wp.array(dtype=wp.int32)  # Index in `faces` of the face with prim_id 0 of each structure below.
    # By placement, in the order of Instances.placements. world_x, world_y, world_z: rows of the map from the structure's space.
    world_x: wp.array(dtype=wp.vec4d)
    world_y: wp.array(dtype=wp.vec4d)
    world_z: wp.array(dtype=wp.vec4d)
    least: wp.array(dtype=wp.float64)  # Least factor by which the map scales distances.
    margin: wp.array(dtype=wp.float64)  # Bound on the rounding of corners in world space.


@wp.struct
class Place:
    """A query point, and what the walk over a structure needs of its placement; without instances, the identity."""

    point: wp.vec3
    local: wp.vec3  # In the structure's space.
    blur: float  # Bound on the rounding of `local`, along each axis.
    index: int  # Index of the placement.
    first_face: int
    first_prim: int
    least: wp.float64
    margin: wp.float64


# --- a wide BVH --------------------------------------------------------------------------------------------------------


@cache
def make_bounds(width: int, compressed: bool) -> Any:
    """Return bounds(nodes, first, p, blur) -> row (closest.h: child_bounds); on CUDA, plain Warp computes one child after another."""
    (plane, _), row, node = make_plane(width, compressed), row_type(width), node_type(width, compressed)

    @wp.func
    def plain(nodes: wp.array(dtype=wp.float32), first: int, p: wp.vec3, blur: float) -> row:
        out = row()
        pad = wp.vec3(blur, blur, blur)
        for j in range(width):
            lo = wp.vec3(plane(nodes, first, LO_X, j), plane(nodes, first, LO_Y, j), plane(nodes, first, LO_Z, j))
            hi = wp.vec3(plane(nodes, first, HI_X, j), plane(nodes, first, HI_Y, j), plane(nodes, first, HI_Z, j))
            out[j] = BELOW * float(squared_distance(p, lo - pad, hi + pad))
        return out

    @wp.func_native(lanes_only(f"""
    {node}
    const auto bounds = wrt::child_bounds<wrt::Lanes<{width}>::Floats>(node, {{{{p[0], p[1], p[2]}}}}, blur);
    return wrt::load<wp::vec_t<{width}, wp::float32>>(&bounds);
    """, "{}"))
    def lanes(nodes: wp.array(dtype=wp.float32), first: int, p: wp.vec3, blur: float) -> row: ...

    @wp.func
    def bounds(nodes: wp.array(dtype=wp.float32), first: int, p: wp.vec3, blur: float) -> row:
        if on_cuda():
            return plain(nodes, first, p, blur)
        return lanes(nodes, first, p, blur)

    return bounds


@cache
def make_near_triangles(width: int) -> Any:
    """Return near_triangles(rows, first, p, blur, reach) -> mask (closest.h). On CUDA it returns the mask of all triangles of the row."""

    @wp.func_native(lanes_only(f"return wrt::near_triangles<{width}>(rows.data + (long long)first, {{{{p[0], p[1], p[2]}}}}, blur, reach);",
                               f"{(1 << width) - 1}"))
    def near_triangles(rows: wp.array(dtype=wp.float32), first: int, p: wp.vec3, blur: float, reach: float) -> int: ...

    return near_triangles


@cache
def make_closest_point(layout: NodeLayout, instances: bool) -> Any:
    """Return closest_point(accel, surfaces, place, best) -> Nearest: the closer of `best` and the closest point on any triangle."""
    struct, gather = make_struct(Primitive), make_gather(Primitive, layout.width)
    (_, exists), bounds = make_plane(layout.width, layout.compressed), make_bounds(layout.width, layout.compressed)
    near_triangles, width, size_of_row = make_near_triangles(layout.width), layout.width, row_size(Primitive, layout.width)

    @wp.func
    def world_corner(surfaces: PointSurfaces, index: int, corner: wp.vec3) -> wp.vec3:
        c = wp.vec4d(wp.float64(corner[0]), wp.float64(corner[1]), wp.float64(corner[2]), wp.float64(1.0))
        return wp.vec3(float(wp.dot(surfaces.world_x[index], c)), float(wp.dot(surfaces.world_y[index], c)),
                       float(wp.dot(surfaces.world_z[index], c)))

    @wp.func
    def nearer_of_row(rows: wp.array(dtype=wp.float32), first: int, surfaces: PointSurfaces, place: Place, best: Nearest) -> Nearest:
        """Return the closer of `best` and the point of the triangle whose record begins at rows[first]."""
        triangle = gather(rows, first)
        flat = not wp.isfinite(triangle.v0)
        if flat:
            face = surfaces.faces[place.first_face + triangle.prim_id]
            triangle.v0 = surfaces.vertices[face[0]]
            triangle.v1 = surfaces.vertices[face[1]]
            triangle.v2 = surfaces.vertices[face[2]]
        if wp.static(instances):
            triangle.v0 = world_corner(surfaces, place.index, triangle.v0)
            triangle.v1 = world_corner(surfaces, place.index, triangle.v1)
            triangle.v2 = world_corner(surfaces, place.index, triangle.v2)
            triangle.prim_id = triangle.prim_id + place.first_prim
        return nearer(place.point, triangle, flat, best)

    @wp.func
    def reach_of(place: Place, best: Nearest) -> float:
        """Return the largest squared distance, in the structure's space, of a box that may contain a point as close as `best`."""
        if wp.static(instances):
            far = (wp.sqrt(best.d2) + place.margin) / place.least
            return float(far * far)
        return float(best.d2)

    @wp.func
    def nearest_in_leaf(accel: struct, surfaces: PointSurfaces, reference: int, place: Place, best: Nearest) -> Nearest:
        i = leaf_first(reference) * wp.static(layout.unit)
        end = i + leaf_count(reference)
        while i < end:
            row = i / width
            mask = near_triangles(accel.primitives, row * size_of_row, place.local, place.blur, reach_of(place, best))
            for lane in range(i - row * width, wp.min(end - row * width, width)):
                if (mask & (1 << lane)) != 0:
                    best = nearer_of_row(accel.primitives, row * size_of_row + lane, surfaces, place, best)
            i = (row + 1) * width
        return best

    @wp.func
    def closest_point(accel: struct, surfaces: PointSurfaces, place: Place, best: Nearest) -> Nearest:
        stack = empty_stack()
        size = int(0)
        reference = int(0)
        while True:
            near = wp.uint64(NOTHING)
            if reference < 0:
                best = nearest_in_leaf(accel, surfaces, reference, place, best)
            reach = reach_of(place, best)
            if reference >= 0:
                first = reference * wp.static(layout.size)
                found = bounds(accel.nodes, first, place.local, place.blur)
                for j in range(wp.static(layout.width)):
                    child = bits(accel.nodes, first + wp.static(layout.references) + j)
                    if found[j] <= reach and child != EMPTY and exists(accel.nodes, first, j):
                        key = key_of(found[j], child)
                        far = wp.max(near, key)
                        near = wp.min(near, key)
                        if far != NOTHING:
                            stack[size] = far
                            size = size + 1
            # Next is the nearest child or, without one, an entry of the stack. Entries farther than the best are dropped, but not entries
            # at the same distance: they may have a lower prim_id.
            while near == NOTHING and size > 0:
                size = size - 1
                if t_of(stack[size]) <= reach:
                    near = stack[size]
            if near == NOTHING:
                break
            reference = reference_of(near)
        return best

    return closest_point


# --- kernels -----------------------------------------------------------------------------------------------------------


@wp.func
def squared_distance_to_child(p: wp.vec3, node: Bvh2Node, second: bool) -> wp.float64:
    """Return the squared distance to the box of a child of the upper level, widened for the rounding of corners; inf without a child."""
    lo = wp.where(second, node.lo_1, node.lo_0)
    hi = wp.where(second, node.hi_1, node.hi_0)
    if lo[0] > hi[0]:
        return wp.float64(wp.inf)
    wide = ROUNDING * wp.max(wp.max(wp.abs(lo)), wp.max(wp.abs(hi)))
    pad = wp.vec3(wide, wide, wide)
    return squared_distance(p, lo - pad, hi + pad)


def make_over_instances(layout: NodeLayout) -> Any:
    """Return closest_of_all(accel, surfaces, root, p) -> Nearest for structures over instances; root: as PointRows.root."""
    struct, closest_point = make_instances(make_struct(Primitive)), make_closest_point(layout, True)

    @wp.func
    def in_placement(accel: struct, surfaces: PointSurfaces, p: wp.vec3, index: int, best: Nearest) -> Nearest:
        placement = accel.placements[index]
        q = wp.vec4d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]), wp.float64(1.0))
        place = Place()
        place.point = p
        place.local = wp.vec3(float(wp.dot(placement.local_x, q)), float(wp.dot(placement.local_y, q)),
                              float(wp.dot(placement.local_z, q)))
        place.blur = BLUR * wp.max(wp.abs(place.local))
        place.index = index
        place.first_face = surfaces.first_face[placement.bottom]
        place.first_prim = placement.first_prim
        place.least = surfaces.least[index]
        place.margin = surfaces.margin[index] + POINT_ROUNDING * wp.float64(wp.max(wp.abs(p)))
        return closest_point(accel.bottoms[placement.bottom], surfaces, place, best)

    @wp.func
    def closest_of_all(accel: struct, surfaces: PointSurfaces, root: int, p: wp.vec3) -> Nearest:
        best = nothing_near()
        keys = empty_keys()
        counts = empty_counts()
        size = int(0)
        first = int(root)
        count = int(0)
        going = bool(root >= 0)
        while going:
            if count > 0:
                for i in range(first, first + count):
                    best = in_placement(accel, surfaces, p, i, best)
            else:
                node = accel.nodes[first]
                swapped = squared_distance_to_child(p, node, True) < squared_distance_to_child(p, node, False)
                for k in range(2):  # the nearer child is pushed last
                    second = (k == 0) != swapped
                    d2 = squared_distance_to_child(p, node, second)
                    if d2 < wp.float64(wp.inf) and d2 <= best.d2:
                        child = child_of(node, second)
                        keys[size] = key_of(float(d2), child.first)
                        counts[size] = child.count
                        size = size + 1
            # At the same distance, a box may contain a triangle with a lower prim_id.
            going = bool(False)
            while size > 0 and not going:
                size = size - 1
                if t_of(keys[size]) <= float(best.d2):
                    first = reference_of(keys[size])
                    count = counts[size]
                    going = True
        return best

    return struct, closest_of_all


def make_over_mesh(layout: NodeLayout) -> Any:
    """Return the function of `make_over_instances` for a structure over one mesh."""
    struct, closest_point = make_struct(Primitive), make_closest_point(layout, False)

    @wp.func
    def closest_of_mesh(accel: struct, surfaces: PointSurfaces, root: int, p: wp.vec3) -> Nearest:
        place = Place()
        place.point = p
        place.local = p
        return closest_point(accel, surfaces, place, nothing_near())

    return struct, closest_of_mesh


@cache
def make_closest_points_kernel(layout: NodeLayout, instances: bool) -> Any:
    """Return the kernel for points first .. first + dim - 1 (dim: launch size). The trees' primitives have the layout "corners"."""
    struct, closest = make_over_instances(layout) if instances else make_over_mesh(layout)

    @points_kernel
    def closest_points(accel: struct, surfaces: PointSurfaces, rows: PointRows, first: int):
        i = first + wp.tid()
        found = closest(accel, surfaces, rows.root[i], rows.query[i])
        rows.distance[i] = float(wp.sqrt(found.d2))
        rows.point[i] = wp.vec3(found.point)
        rows.u[i] = float(found.u)
        rows.v[i] = float(found.v)
        rows.prim_id[i] = found.prim_id

    return closest_points
