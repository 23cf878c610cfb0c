"""Traversal of the octree: from the root down to the octants that the ray meets, from front to back.
Glassner 1984, "Space Subdivision for Fast Ray Tracing". The stack has one entry per level, with a mask of the pending octants, as in Laine
and Karras 2010, "Efficient Sparse Voxel Octrees". The distance to each plane is computed from the plane's coordinate, so that errors do not
accumulate. The walk enters the same octants as the conservative box test. Octants without primitives have no node."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.cell_ray import cell_slack, earlier, later
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import Mailbox, make_mailbox_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer, write_step
from wrt.kernels.traverse.steps import ENTERED, INNER, STAYS, box_step
from wrt.kernels.units.box import BoxRay, slab_interval

MAX_LEVELS = 20  # levels, and stack entries: corners of cells, in units of the finest cell, are integers that are exact in float32


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


@wp.func
def octree_planes(layout: OctreeLayout, corner: wp.vec3i) -> wp.vec3:
    """Return the coordinates of a corner that is given in units of the finest cells. Monotone, and inside the root's cell.
    Builder and traversal share this function."""
    return wp.min(layout.lo + layout.size * wp.vec3(float(corner[0]), float(corner[1]), float(corner[2])), layout.hi)


@wp.func
def octant_corner(octant: int, half: int) -> wp.vec3i:
    """Return an octant's lowest corner minus its cell's lowest corner. half: half the cell's edge. Units are the finest cells."""
    return half * wp.vec3i(octant & 1, (octant >> 1) & 1, (octant >> 2) & 1)


@wp.func
def distances(layout: OctreeLayout, ray: BoxRay, corner: wp.vec3i) -> wp.vec3:
    """Return t where the ray meets each of the three planes through a corner; NaN for a plane that contains the ray."""
    return wp.cw_mul(octree_planes(layout, corner) - ray.origin, ray.inv_dir)


@wp.func
def latest(t: wp.vec3, begin: float) -> float:
    """Return the largest of `begin` and three distances, ignoring NaN."""
    out = wp.where(t[0] > begin, t[0], begin)
    out = wp.where(t[1] > out, t[1], out)
    return wp.where(t[2] > out, t[2], out)


@wp.func
def earliest(t: wp.vec3, end: float) -> float:
    """Return the smallest of `end` and three distances, ignoring NaN."""
    out = wp.where(t[0] < end, t[0], end)
    out = wp.where(t[1] < out, t[1], out)
    return wp.where(t[2] < out, t[2], out)


@wp.func
def in_order(mask: int, flip: int) -> int:
    """Permute the bits of an 8-bit mask: bit k of the result is bit k ^ flip of `mask`."""
    out = mask
    out = wp.where((flip & 1) != 0, ((out & 0x55) << 1) | ((out >> 1) & 0x55), out)
    out = wp.where((flip & 2) != 0, ((out & 0x33) << 2) | ((out >> 2) & 0x33), out)
    return wp.where((flip & 4) != 0, ((out & 0x0F) << 4) | ((out >> 4) & 0x0F), out)


@wp.func
def octants_met(occupied: int, enter: float, middle: wp.vec3, leave: float) -> int:
    """Return the mask of the occupied octants of a cell that the ray meets. It is in the cell from t = `enter` to `leave`, both widened.
    Octants are in the order of the ray: the bits of value 1, 2, 4 in an index are 0 for the nearer half in x, y, z. Argument `middle` has t
    at the planes between the halves. Each axis gives an octant an interval of t. The ray meets the octant unless one interval begins after
    another ends. The result equals box tests of all octants."""
    met = occupied
    x = later(middle[0])
    y = later(middle[1])
    z = later(middle[2])
    met = wp.where(enter > x, met & 0xAA, met)
    met = wp.where(enter > y, met & 0xCC, met)
    met = wp.where(enter > z, met & 0xF0, met)
    met = wp.where(middle[0] > leave, met & 0x55, met)
    met = wp.where(middle[1] > leave, met & 0x33, met)
    met = wp.where(middle[2] > leave, met & 0x0F, met)
    met = wp.where(middle[0] > y, met & ~0x22, met)
    met = wp.where(middle[0] > z, met & ~0x0A, met)
    met = wp.where(middle[1] > x, met & ~0x44, met)
    met = wp.where(middle[1] > z, met & ~0x0C, met)
    met = wp.where(middle[2] > x, met & ~0x50, met)
    return wp.where(middle[2] > y, met & ~0x30, met)


@cache
def make_struct(record: Any) -> Any:
    """Make the structure's type, for primitives stored as `record` in the order of prim_id; nodes[0] is the root."""

    @wp.struct
    class Octree:
        lo: wp.vec3  # lo, hi, size, levels: the OctreeLayout.
        hi: wp.vec3
        size: float
        levels: int
        pad: float  # Largest pad of a triangle's box.
        extent: float  # Largest extent of a triangle's box.
        mailbox: int  # 1: use a mailbox (kernels.traverse.leaf); 0: do not.
        nodes: wp.array(dtype=OctreeNode)
        references: wp.array(dtype=wp.int32)  # Indices into `primitives`.
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Octree


@wp.struct
class OctreeRay:
    """A ray set up for the walk."""

    layout: OctreeLayout
    box: BoxRay
    backwards: wp.vec3i  # For each axis: 1 if the direction's component is negative, else 0.
    flip: int  # `backwards` as a mask. XOR with it converts an octant's index from the order of space to the order of the ray.
    begin: float  # t where the walk begins.
    slack: float  # Length, in t, by which the walk continues behind the best hit.


@wp.func
def octree_ray(accel: Any, box: BoxRay, t_min: float) -> OctreeRay:
    """Set up a ray for the walk."""
    out = OctreeRay()
    out.layout.lo = accel.lo
    out.layout.hi = accel.hi
    out.layout.size = accel.size
    out.layout.levels = accel.levels
    out.box = box
    out.backwards = wp.vec3i(wp.where(box.inv_dir[0] < 0.0, 1, 0), wp.where(box.inv_dir[1] < 0.0, 1, 0),
                             wp.where(box.inv_dir[2] < 0.0, 1, 0))
    out.flip = out.backwards[0] + 2 * out.backwards[1] + 4 * out.backwards[2]
    out.slack = cell_slack(box, accel.pad, accel.extent)
    out.begin = earlier(t_min) - out.slack
    return out


@wp.func
def distance_to_cell(ray: OctreeRay, corner: wp.vec3i, size: int) -> float:
    """Return t, at least ray.begin, where the ray enters a cell. Its lowest corner and edge `size` are in units of the finest cells."""
    return latest(distances(ray.layout, ray.box, corner + size * ray.backwards), ray.begin)


@wp.func
def enter_octants(ray: OctreeRay, occupied: int, corner: wp.vec3i, size: int, enter: float, limit: float) -> int:
    """Return the mask, in the order of the ray, of the occupied octants that the ray meets at t <= limit in a cell.
    The cell has the lowest corner `corner` and the edge `size`, in units of the finest cells. The ray enters the cell at t = enter."""
    forwards = wp.vec3i(1, 1, 1) - ray.backwards
    leave = later(earliest(distances(ray.layout, ray.box, corner + size * forwards), float(wp.inf)))
    half = size >> 1
    middle = distances(ray.layout, ray.box, corner + wp.vec3i(half, half, half))
    return octants_met(in_order(occupied, ray.flip), enter, middle, wp.where(limit < leave, limit, leave))


def make_record_octants(units: Units) -> Any:
    """Make record_octants, which records the octants of a node (kernels.traverse.steps)."""

    @wp.func
    def record_octants(recorder: Recorder, slot: int, ray: OctreeRay, node: OctreeNode, corner: wp.vec3i, size: int, met: int):
        """Record the octants of a node. corner, size: of its cell; met: the mask of `enter_octants`."""
        if wp.static(units.observer == "log"):
            half = size >> 1
            for octant in range(8):
                if ((-node.count) >> octant) & 1 != 0:
                    index = node.first + wp.bit_count(-node.count & ((1 << octant) - 1))
                    low = corner + octant_corner(octant, half)
                    lo = octree_planes(ray.layout, low)
                    hi = octree_planes(ray.layout, low + wp.vec3i(half, half, half))
                    entered = (met >> (octant ^ ray.flip)) & 1 != 0
                    t = wp.where(entered, distance_to_cell(ray, low, half), float(wp.inf))
                    write_step(recorder, slot, box_step(index, INNER, lo, hi, t))

    return record_octants


def make_walk(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Make walk(accel, surfaces, probe, set_up, enter) -> best Hit; set_up: OctreeRay; enter: t at the root's cell."""
    visit_leaf = make_mailbox_leaf(units, any_hit, accepts)
    observe = make_observer(units, size_of(OctreeNode))
    record_octants = make_record_octants(units)

    @wp.func
    def walk(accel: Any, surfaces: Any, probe: Probe, set_up: OctreeRay, enter: float) -> Hit:
        best = no_hit(probe.ray)
        mailbox = Mailbox()
        stack_first = wp.zeros(shape=wp.static(MAX_LEVELS), dtype=wp.int32)
        stack_occupied = wp.zeros(shape=wp.static(MAX_LEVELS), dtype=wp.int32)
        stack_left = wp.zeros(shape=wp.static(MAX_LEVELS), dtype=wp.int32)
        level = int(0)
        entries = int(0)
        index = int(0)
        size = 1 << accel.levels
        corner = wp.vec3i()
        found = bool(True)
        while found:
            node = accel.nodes[index]
            left = int(0)
            observe.node(accel.recorder, probe.ray, index, wp.where(node.count < 0, wp.bit_count(-node.count), 0),
                         wp.where(node.count < 0, 1, 0))  # a leaf has no planes
            if node.count < 0:
                left = enter_octants(set_up, -node.count, corner, size, enter, later(best.t) + set_up.slack)
                record_octants(accel.recorder, probe.ray.slot, set_up, node, corner, size, left)
                if left != 0:
                    stack_first[level] = node.first
                    stack_occupied[level] = -node.count
                    stack_left[level] = left
                    level += 1
                    if (left & (left - 1)) != 0:
                        entries += 1
                        observe.push(accel.recorder, probe.ray, index, INNER, enter, entries - 1, entries)
            else:
                mailbox, best = visit_leaf(accel, surfaces, probe, node, mailbox, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
            # Continue with the first octant of the node just entered, or with the next pending octant that may contain a better hit.
            fresh = left != 0
            found = bool(False)
            while level > 0 and not found:
                left = stack_left[level - 1]
                if left == 0:
                    level -= 1
                else:
                    octant = wp.bit_count((left & -left) - 1) ^ set_up.flip
                    left = left & (left - 1)
                    stack_left[level - 1] = left
                    size = (1 << accel.levels) >> level
                    mask = -2 * size
                    corner = wp.vec3i(corner[0] & mask, corner[1] & mask, corner[2] & mask) + octant_corner(octant, size)
                    enter = distance_to_cell(set_up, corner, size)
                    found = fresh or enter <= later(best.t) + set_up.slack
                    index = stack_first[level - 1] + wp.bit_count(stack_occupied[level - 1] & ((1 << octant) - 1))
                    if not fresh:
                        entries -= wp.where(left == 0, 1, 0)
                        observe.pop(accel.recorder, probe.ray, index, INNER, enter, int(found) * ENTERED + int(left != 0) * STAYS)
                    fresh = False
        return best

    return walk


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found. Units.box has no effect."""
    probe_of = make_probe(units)
    walk = make_walk(units, any_hit, accepts)
    observe = make_observer(units, 0)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        set_up = octree_ray(accel, probe.box, ray.t_min)
        interval = slab_interval(probe.box, accel.lo, accel.hi)
        enter = wp.max(interval[0], set_up.begin)
        met = enter <= later(interval[1]) and enter <= later(best.t) + set_up.slack and enter < wp.inf
        observe.root(accel.recorder, ray, accel.lo, accel.hi, wp.where(met, enter, float(wp.inf)))
        if met:
            best = walk(accel, surfaces, probe, set_up, enter)
        return observe.finish(accel.recorder, ray, best)

    return traverse
