"""How trees of planes are stored, for the walk of kernels.traverse.planes: nodes, places, and the functions of `planes.Layout`."""

from typing import Any

import warp as wp

from wrt.kernels.structs import bit_count
from wrt.kernels.traverse.common import Probe

MAX_LEVELS = 20  # Levels of an octree: corners of cells, in units of the finest cell, are integers that are exact in float32.
PLANE = wp.constant(3)  # `axis` of a plane that is not at right angles to an axis.
LEAF = wp.constant(4)  # `axis` of a leaf.
KD_LEAF = wp.constant(3)  # KdNode.word modulo 4 in a leaf.


@wp.struct
class KdNode:
    """A node of 8 bytes. In an inner node, `split` is the plane's coordinate, word = 4 * left + axis, and the right child is node left + 1.
    In a leaf, `split` is the number of primitives, and word = 4 * first + KD_LEAF, where `first` is the first primitive's index."""

    split: float
    word: int


@wp.struct
class BspNode:
    """The plane dot(normal, p) + offset = 0 and its children: one below the plane (negative values), and one above it.
    A child without primitives has no node. The others are consecutive from node `first` on; bit k of `count` is 1 if child k (0: below) has
    one. A leaf has the `count` primitives from index `first` on."""

    normal: wp.vec3
    offset: float
    tolerance: float  # Half of the plane's thickness, without the part proportional to the ray's distance.
    axis: int  # 0, 1, 2: the plane is p[axis] + offset = 0; PLANE: the plane has any orientation; LEAF: a leaf.
    first: int
    count: int


@wp.struct
class OctreeNode:
    """A node of 8 bytes. A leaf (count >= 0) lists the primitives references[first] .. references[first + count - 1].
    In an inner node, -count is the mask of the octants that have a node; their nodes are consecutive from `first` on. Bit k of the mask
    stands for octant k, where the bits of value 1, 2, 4 in k select the upper half in x, y, z."""

    first: int
    count: int


@wp.struct
class OctreeLayout:
    """The root's cell lo .. hi, and the finest cells: cubes of edge `size`, 2^levels along each axis. They begin at lo and are cut off at
    hi."""

    lo: wp.vec3
    hi: wp.vec3
    size: float
    levels: int


@wp.struct
class Octants:
    """Octants of a cell, after a choice between its halves along the axes before `axis`."""

    index: int  # Node of the cell.
    axis: int  # Axis of the next plane.
    mask: int  # The octants, as in OctreeNode, with or without a node.
    half: int  # Edge of an octant, in units of the finest cells.
    corner: wp.vec3i  # Lowest corner of the octants: along `axis`, then along the two next axes, cyclically.


@wp.func
def octree_planes(layout: Any, corner: wp.vec3i) -> wp.vec3:
    """Return the coordinates of a corner that is given in units of the finest cells. Monotone, and inside the root's cell.
    Builder and traversal share this function. layout: an OctreeLayout, or an octree."""
    return wp.min(layout.lo + layout.size * wp.vec3(float(corner[0]), float(corner[1]), float(corner[2])), layout.hi)


@wp.func
def octant_corner(octant: int, half: int) -> wp.vec3i:
    """Return an octant's lowest corner minus its cell's lowest corner. half: half the cell's edge. Units are the finest cells."""
    return half * wp.vec3i(octant & 1, (octant >> 1) & 1, (octant >> 2) & 1)


@wp.func
def root_node(accel: Any) -> int:
    return 0


@wp.func
def same_index(place: int) -> int:
    return place


@wp.func
def kd_leaf(node: KdNode) -> wp.vec2i:
    return wp.vec2i(node.word >> 2, wp.where((node.word & 3) == KD_LEAF, int(node.split), -1))


@wp.func
def kd_plane(accel: Any, node: KdNode, place: int, probe: Probe) -> wp.vec3:
    axis = node.word & 3
    return wp.vec3(node.split - probe.box.origin[axis], probe.box.inv_dir[axis], 0.0)


@wp.func
def kd_child(node: KdNode, place: int, above: bool) -> int:
    return (node.word >> 2) + wp.where(above, 1, 0)


@wp.func
def kd_has_child(node: KdNode, place: int, above: bool) -> bool:
    return True


@wp.func
def kd_normal(node: KdNode) -> wp.vec4:
    normal = wp.vec4(0.0, 0.0, 0.0, -node.split)
    normal[node.word & 3] = 1.0
    return normal


@wp.func
def bsp_leaf(node: BspNode) -> wp.vec2i:
    return wp.vec2i(node.first, wp.where(node.axis == LEAF, node.count, -1))


@wp.func
def bsp_plane(accel: Any, node: BspNode, place: int, probe: Probe) -> wp.vec3:
    if node.axis < PLANE:
        return wp.vec3(-node.offset - probe.box.origin[node.axis], probe.box.inv_dir[node.axis], node.tolerance)
    return wp.vec3(-(wp.dot(node.normal, probe.box.origin) + node.offset), 1.0 / wp.dot(node.normal, probe.ray.direction), node.tolerance)


@wp.func
def bsp_child(node: BspNode, place: int, above: bool) -> int:
    return node.first + wp.where(above, node.count & 1, 0)


@wp.func
def bsp_has_child(node: BspNode, place: int, above: bool) -> bool:
    return (node.count & wp.where(above, 2, 1)) != 0


@wp.func
def bsp_normal(node: BspNode) -> wp.vec4:
    return wp.vec4(node.normal[0], node.normal[1], node.normal[2], node.offset)


@wp.func
def octree_root(accel: Any) -> Octants:
    place = Octants()
    place.mask = 0xFF
    place.half = (1 << accel.levels) >> 1
    return place


@wp.func
def octree_index(place: Octants) -> int:
    return place.index


@wp.func
def octree_leaf(node: OctreeNode) -> wp.vec2i:
    return wp.vec2i(node.first, node.count)


@wp.func
def octree_plane(accel: Any, node: OctreeNode, place: Octants, probe: Probe) -> wp.vec3:
    axis = place.axis
    wall = wp.min(accel.lo[axis] + accel.size * float(place.corner[0] + place.half), accel.hi[axis])
    return wp.vec3(wall - probe.box.origin[axis], probe.box.inv_dir[axis], 0.0)


@wp.func
def octants_beyond(node: OctreeNode, place: Octants, above: bool) -> int:
    """Return the mask of the octants that have a node, on one side of the plane."""
    lower = 0x0F3355 >> (8 * place.axis)
    return place.mask & -node.count & wp.where(above, ~lower, lower)


@wp.func
def octree_child(node: OctreeNode, place: Octants, above: bool) -> Octants:
    """Return the octants on one side of the plane; below and above the last plane, there is one octant: a cell with a node."""
    out = Octants()
    out.corner = wp.vec3i(place.corner[1], place.corner[2], place.corner[0] + wp.where(above, place.half, 0))
    mask = octants_beyond(node, place, above)
    if place.axis < 2:
        out.index = place.index
        out.axis = place.axis + 1
        out.mask = mask
        out.half = place.half
    else:
        out.index = node.first + bit_count(-node.count & (mask - 1))
        out.mask = 0xFF
        out.half = place.half >> 1
    return out


@wp.func
def octree_has_child(node: OctreeNode, place: Octants, above: bool) -> bool:
    return octants_beyond(node, place, above) != 0
