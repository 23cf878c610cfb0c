"""Closest points on instances: a walk over the upper level, and below it over the wide BVHs in their own spaces.

A map that scales the axes differently changes which point is closest. So boxes are compared in the structure's space, with the map's least
factor as the bound, and each triangle that is left is transformed to world space and rounded to float32, as in a joined mesh. Distances and
points therefore equal those of the joined mesh."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import Primitive, kernel
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node, child_of
from wrt.kernels.traverse.instances import make_struct as make_instances
from wrt.kernels.traverse.stack import key_of, make_uninitialized, reference_of, t_of
from wrt.kernels.wide.closest_point import (
    Nearest,
    PointArrays,
    PointSearch,
    make_closest_point,
    nearer_of,
    nothing_near,
    on_edges,
    on_triangle,
    squared_distance,
    store_nearest,
)
from wrt.kernels.wide.layout import NodeLayout
from wrt.kernels.wide.references import leaf_count, leaf_first
from wrt.kernels.wide.traverse import make_gather, make_struct, row_size

ROUNDING = wp.constant(2.0**-22)  # Widening of the upper level's boxes, as a fraction of their coordinates.
POINT_ROUNDING = wp.constant(wp.float64(2.0**-36))  # Error of a local point over the point's coordinates (MAX_SPREAD).
empty_keys = make_uninitialized(STACK_SIZE + 1, wp.uint64)
empty_counts = make_uninitialized(STACK_SIZE + 1, wp.int32)


@wp.struct
class PointPlaces:
    """What closest points need of placements, in the order of Instances.placements, and the faces of the lower level."""

    world_x: wp.array(dtype=wp.vec4d)  # world_x, world_y, world_z: rows of the affine map from the structure's space to world space.
    world_y: wp.array(dtype=wp.vec4d)
    world_z: wp.array(dtype=wp.vec4d)
    least: wp.array(dtype=wp.float64)  # Least factor by which the map scales distances.
    margin: wp.array(dtype=wp.float64)  # Bound on the rounding of corners in world space.
    vertices: wp.array(dtype=wp.vec3)  # vertices, faces, first_face: see wrt.accel.queries.part_faces.
    faces: wp.array(dtype=wp.vec3i)
    first_face: wp.array(dtype=wp.int32)


@wp.struct
class PlacedPoint:
    """A query point in one placement."""

    point: wp.vec3
    local: wp.vec3d  # In the structure's space.
    index: int  # Index of the placement.
    first_face: int
    first_prim: int
    least: wp.float64
    margin: wp.float64


@wp.func
def local_point(place: PlacedPoint) -> wp.vec3d:
    return place.local


@wp.func
def local_reach(place: PlacedPoint, best: Nearest) -> wp.float64:
    """Return the largest squared distance, in the structure's space, of a box that may contain a closer point than `best`."""
    far = (wp.sqrt(best.d2) + place.margin) / place.least
    return far * far


@wp.func
def world_corner(places: PointPlaces, index: int, corner: wp.vec3) -> wp.vec3:
    c = wp.vec4d(wp.float64(corner[0]), wp.float64(corner[1]), wp.float64(corner[2]), wp.float64(1.0))
    return wp.vec3(float(wp.dot(places.world_x[index], c)), float(wp.dot(places.world_y[index], c)),
                   float(wp.dot(places.world_z[index], c)))


@wp.func
def nearer_placed(places: PointPlaces, place: PlacedPoint, record: Primitive, best: Nearest) -> Nearest:
    """Return the closer of `best` and the point on one triangle, in world space."""
    flat = not wp.isfinite(record.v0)  # without area, or not finite: kernels.wide.closest_point
    local = record
    if flat:
        face = places.faces[place.first_face + record.prim_id]
        local.v0 = places.vertices[face[0]]
        local.v1 = places.vertices[face[1]]
        local.v2 = places.vertices[face[2]]
    triangle = Primitive()
    triangle.v0 = world_corner(places, place.index, local.v0)
    triangle.v1 = world_corner(places, place.index, local.v1)
    triangle.v2 = world_corner(places, place.index, local.v2)
    triangle.prim_id = record.prim_id + place.first_prim
    if not (wp.isfinite(triangle.v0) and wp.isfinite(triangle.v1) and wp.isfinite(triangle.v2)):
        return best
    found = on_triangle(place.point, triangle)
    if flat:
        found = on_edges(wp.vec3d(place.point), wp.vec3d(triangle.v0), wp.vec3d(triangle.v1), wp.vec3d(triangle.v2))
    return nearer_of(place.point, triangle, found, best)


def make_placed_search(layout: NodeLayout) -> PointSearch:
    """Make the functions of a walk over the structure of one placement; its `surfaces` is PointPlaces."""
    struct, gather = make_struct(Primitive), make_gather(Primitive, layout.width)
    width, size_of_row = layout.width, row_size(Primitive, layout.width)

    @wp.func
    def nearest_in_leaf(accel: struct, places: PointPlaces, reference: int, place: PlacedPoint, best: Nearest) -> Nearest:
        begin = leaf_first(reference) * wp.static(layout.unit)
        for i in range(begin, begin + leaf_count(reference)):
            row = i / width
            best = nearer_placed(places, place, gather(accel.primitives, row * size_of_row + i - row * width), best)
        return best

    return PointSearch(nearest_in_leaf, local_point, local_reach)


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


@cache
def make_placed_points_kernel(layout: NodeLayout) -> Any:
    """Return the kernel for points first .. first + dim - 1 (dim: launch size). roots: root node of each point's world, or -1."""
    struct = make_instances(make_struct(Primitive))
    closest_point = make_closest_point(layout, make_placed_search(layout))

    @wp.func
    def in_placement(accel: struct, places: PointPlaces, p: wp.vec3, index: int, best: Nearest) -> Nearest:
        placement = accel.placements[index]
        q = wp.vec4d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]), wp.float64(1.0))
        place = PlacedPoint()
        place.point = p
        place.local = wp.vec3d(wp.dot(placement.local_x, q), wp.dot(placement.local_y, q), wp.dot(placement.local_z, q))
        place.index = index
        place.first_face = places.first_face[placement.bottom]
        place.first_prim = placement.first_prim
        place.least = places.least[index]
        place.margin = places.margin[index] + POINT_ROUNDING * wp.float64(wp.max(wp.abs(p)))
        return closest_point(accel.bottoms[placement.bottom], places, place, best)

    @wp.func
    def closest_of_all(accel: struct, places: PointPlaces, root: int, p: wp.vec3) -> Nearest:
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
                    best = in_placement(accel, places, p, i, best)
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

    @kernel
    def placed_points(accel: struct, places: PointPlaces, points: wp.array(dtype=wp.vec3), roots: wp.array(dtype=wp.int32),
                      out: PointArrays, first: int):
        i = first + wp.tid()
        store_nearest(out, i, closest_of_all(accel, places, roots[i], points[i]))

    return placed_points
