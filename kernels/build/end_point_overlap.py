"""The end-point overlap (EPO) of a bounding volume hierarchy, for each triangle, on the CPU.
Aila, Karras and Laine 2013, "On Quality Metrics of Bounding Volume Hierarchies". A ray that ends at a point of the surface visits every
node whose box contains the point. The visit is in vain if the point's triangle is not in the node's subtree. The EPO of a triangle is its
area in boxes of such nodes, computed by clipping in float64."""

import warp as wp

from wrt.kernels.build.clip import MAX_CORNERS, clip_triangle
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import STACK_SIZE


@wp.struct
class Children:
    """The children of all nodes: child k of node i has the index i * width + k; node 0 is the root."""

    width: int  # Number of children of a node.
    lo: wp.array(dtype=wp.vec3)
    hi: wp.array(dtype=wp.vec3)
    first: wp.array(dtype=wp.int32)  # Index in `order` of a leaf's first primitive, or index of an inner node.
    count: wp.array(dtype=wp.int32)  # Number of a leaf's primitives; 0: an inner node; < 0: no child.
    order: wp.array(dtype=wp.int32)  # prim_id of the primitives, leaf after leaf.


@wp.func
def area_inside(v0: wp.vec3d, v1: wp.vec3d, v2: wp.vec3d, lo: wp.vec3d, hi: wp.vec3d) -> wp.float64:
    """Return the area of a triangle's part in the closed box lo .. hi; -1 if they do not touch."""
    low = wp.min(wp.min(v0, v1), v2)
    high = wp.max(wp.max(v0, v1), v2)
    for axis in range(3):
        if not (low[axis] <= hi[axis] and high[axis] >= lo[axis]):
            return wp.float64(-1.0)
    polygon = wp.zeros(shape=wp.static(MAX_CORNERS), dtype=wp.vec3d)
    clipped = wp.zeros(shape=wp.static(MAX_CORNERS), dtype=wp.vec3d)
    polygon[0] = v0
    polygon[1] = v1
    polygon[2] = v2
    n = clip_triangle(polygon, clipped, lo, hi)
    if n == 0:
        return wp.float64(-1.0)
    doubled = wp.vec3d()
    for i in range(1, n - 1):
        doubled = doubled + wp.cross(polygon[i] - polygon[0], polygon[i + 1] - polygon[0])
    return wp.float64(0.5) * wp.length(doubled)


@wp.func
def belongs(tree: Children, child: int, prim_id: int) -> int:
    """Return 1 if the leaf with the index `child` lists the primitive, else 0."""
    for i in range(tree.first[child], tree.first[child] + tree.count[child]):
        if tree.order[i] == prim_id:
            return 1
    return 0


@kernel
def end_point_overlap(tree: Children, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i), first: int,
                      out: wp.array(dtype=wp.float64)):
    """Store the area of triangle i = first + tid in the boxes of nodes whose subtrees do not contain it. In a leaf's box, it counts once
    for each primitive of the leaf. The walk visits all boxes that the triangle meets, and adds a node's box after the node's subtree."""
    i = first + wp.tid()
    face = faces[i]
    v0 = wp.vec3d(vertices[face[0]])
    v1 = wp.vec3d(vertices[face[1]])
    v2 = wp.vec3d(vertices[face[2]])
    lane = wp.zeros(shape=wp.static(STACK_SIZE + 1), dtype=wp.int32)
    end = wp.zeros(shape=wp.static(STACK_SIZE + 1), dtype=wp.int32)
    below = wp.zeros(shape=wp.static(STACK_SIZE + 1), dtype=wp.int32)  # 1 if the subtree contains the triangle
    area = wp.zeros(shape=wp.static(STACK_SIZE + 1), dtype=wp.float64)
    end[0] = tree.width
    level = int(0)
    cost = wp.float64(0.0)
    while level >= 0:
        child = lane[level]
        if child == end[level]:
            if level > 0:  # the root contains every triangle
                if below[level] == 0:
                    cost = cost + area[level]
                else:
                    below[level - 1] = 1
            level = level - 1
            continue
        lane[level] = child + 1
        count = tree.count[child]
        if count < 0:
            continue
        inside = area_inside(v0, v1, v2, wp.vec3d(tree.lo[child]), wp.vec3d(tree.hi[child]))
        if inside < wp.float64(0.0):
            continue
        if count > 0:
            if belongs(tree, child, i) == 1:
                below[level] = 1
            else:
                cost = cost + inside * wp.float64(count)
            continue
        level = level + 1
        lane[level] = tree.first[child] * tree.width
        end[level] = lane[level] + tree.width
        below[level] = 0
        area[level] = inside
    out[i] = cost
