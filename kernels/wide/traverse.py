"""The traversal unit of the wide BVHs: nodes of 4 or 8 children, whose boxes are tested as one row, like the triangles of a leaf.

Wald, Benthin and Boulos 2008, "Getting Rid of Packets"; Afra and Ernst 2008 and 2010 for one ray at a time. A row of triangles
is only sifted: those that the watertight unit would refuse in float32 are left out, and the unit itself decides on the others,
so that the answers are its own to the last bit. Children are visited from the near to the far: the nearest at once, the others
by way of the stack, the farthest deepest; what was popped and begins beyond the closest hit is dropped. Any hit asks for no
order: there the last child comes first, and the builder puts leaves and large boxes last.
"""

from functools import cache

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, PlanePrimitive, Primitive, Ray, Surfaces
from wrt.kernels.traverse.common import Probe, Units, make_intersect, make_probe, no_hit
from wrt.kernels.traverse.counters import Counts, Recorder, make_counters
from wrt.kernels.units.triangle import component
from wrt.kernels.wide.lanes import EMPTY, LaneRay, make_lanes
from wrt.kernels.wide.nodes import first_reference, make_box_test, node_size

# The builder lets no walk have more entries than this (kernels.build_wide.collapse).
STACK_SIZE = 64
# A reference is EMPTY, an inner node's index, or -1 - (LEAF_RANGE * (where its primitives begin) + number of primitives - 1).
LEAF_RANGE = 64
# Where an endless ray ends for the boxes: one that is entered at infinity is not entered.
MAX_T = wp.constant(3.4028234663852886e38)


@cache
def make_struct(record):
    """nodes: as in kernels.wide_nodes, the root first. primitives: rows of as many primitives as a node has children: first the
    first number of `record` of all of them, then the second ... Leaves begin with a row of their own, and their references count
    rows; where nodes are compressed, leaves follow each other without a gap, and references count primitives."""

    @wp.struct
    class WideBvh:
        nodes: wp.array(dtype=wp.float32)
        primitives: wp.array(dtype=wp.float32)
        recorder: Recorder

    return WideBvh


stack_type = wp.types.vector(STACK_SIZE, wp.uint64)

# Warp sets every new vector to 0: of these 512 bytes most rays use a few.
EMPTY_STACK = """
    alignas(TYPE) char memory[sizeof(TYPE)];
    return *(TYPE*)memory;
"""


@wp.func_native(EMPTY_STACK.replace("TYPE", f"wp::vec_t<{STACK_SIZE}, wp::uint64>"))
def empty_stack() -> stack_type: ...


@wp.func
def key_of(t: float, reference: int) -> wp.uint64:
    """An entry of the stack: sorted by t, which is never below 0 nor -0."""
    return (wp.uint64(wp.cast(t, wp.uint32)) << wp.uint64(32)) | wp.uint64(wp.cast(reference, wp.uint32))


@wp.func
def reference_of(key: wp.uint64) -> int:
    return wp.cast(wp.uint32(key & wp.uint64(0xFFFFFFFF)), wp.int32)


@wp.func
def t_of(key: wp.uint64) -> float:
    return wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)


@wp.func
def lane_ray(probe: Probe, pad: float) -> LaneRay:
    """Set-up, once a ray. pad: what widens the far distances."""
    out = LaneRay()
    out.box = probe.box
    out.box.t_min = probe.box.t_min + 0.0  # not -0: entries are sorted by their bits
    out.far_inv_dir = pad * probe.box.inv_dir
    out.near_x = wp.where(probe.box.inv_dir[0] < 0.0, 1, 0)
    out.near_y = wp.where(probe.box.inv_dir[1] < 0.0, 3, 2)
    out.near_z = wp.where(probe.box.inv_dir[2] < 0.0, 5, 4)
    out.kx = probe.triangle.kx
    out.ky = probe.triangle.ky
    out.kz = probe.triangle.kz
    out.shear_x = probe.triangle.shear_x
    out.shear_y = probe.triangle.shear_y
    origin = probe.ray.origin
    out.origin = wp.vec3(component(origin, out.kx), component(origin, out.ky), component(origin, out.kz))
    return out


@cache
def make_gather(record, width):
    """One lane of a block of rows as a record."""
    value, bits = make_lanes(width).value, make_lanes(width).bits

    @wp.func
    def gather_corners(rows: wp.array(dtype=wp.float32), i: int) -> Primitive:
        out = Primitive()
        out.v0 = wp.vec3(value(rows, i), value(rows, i + width), value(rows, i + 2 * width))
        out.v1 = wp.vec3(value(rows, i + 3 * width), value(rows, i + 4 * width), value(rows, i + 5 * width))
        out.v2 = wp.vec3(value(rows, i + 6 * width), value(rows, i + 7 * width), value(rows, i + 8 * width))
        out.prim_id = bits(rows, i + 9 * width)
        return out

    @wp.func
    def plane(rows: wp.array(dtype=wp.float32), i: int) -> wp.vec4:
        return wp.vec4(value(rows, i), value(rows, i + width), value(rows, i + 2 * width), value(rows, i + 3 * width))

    @wp.func
    def gather_planes(rows: wp.array(dtype=wp.float32), i: int) -> PlanePrimitive:
        out = PlanePrimitive()
        out.a = plane(rows, i)
        out.b = plane(rows, i + 4 * width)
        out.c = plane(rows, i + 8 * width)
        out.prim_id = bits(rows, i + 12 * width)
        return out

    return {Primitive: gather_corners, PlanePrimitive: gather_planes}[record]


def make_row_test(units: Units, any_hit, accepts, width):
    """The unit that tests those primitives of a row that are in the mask; its numbers begin at `first`."""
    intersect = make_intersect(units, accepts)
    gather = make_gather(units.triangle_test.record, width)
    candidates, lowest = make_lanes(width).candidates, make_lanes(width).lowest
    sifted = units.triangle == "watertight"

    @wp.func
    def test_row(rows: wp.array(dtype=wp.float32), first: int, mask: int, surfaces: Surfaces, probe: Probe, ray: LaneRay,
                 best: Hit) -> Hit:
        if wp.static(sifted):
            mask = mask & candidates(rows, first, ray)
        while mask != 0:
            best = intersect(probe, surfaces, gather(rows, first + lowest(mask)), best)
            mask = mask & (mask - 1)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    return best
        return best

    return test_row


def make_traversal(units: Units, any_hit: bool, accepts, width: int, compressed: bool):
    """The closest hit, or any (the first that is found), in a tree of nodes of `width` children."""
    lanes = make_lanes(width)
    lowest, bits, prefetch = lanes.lowest, lanes.bits, lanes.prefetch
    entries, entered, pad = make_box_test(units.box, width, compressed)
    probe_of = make_probe(units)
    test_row = make_row_test(units, any_hit, accepts, width)
    fetch_node, fetch_primitive, push, finish = make_counters(units, 4 * node_size(width, compressed))
    struct = make_struct(units.triangle_test.record)
    size_of_node = node_size(width, compressed)
    references = first_reference(width, compressed)
    unit = 1 if compressed else width  # of primitives, in which references count
    row_size = units.triangle_test.record.numpy_dtype()["itemsize"] // 4 * width

    @wp.func
    def child(accel: struct, at: int) -> int:
        """The reference at `at`; what it refers to is called into the cache, as it is needed soon."""
        reference = bits(accel.nodes, at)
        if reference >= 0:
            prefetch(accel.nodes, reference * wp.static(size_of_node))
        else:
            prefetch(accel.primitives, (-1 - reference) / LEAF_RANGE * unit / width * wp.static(row_size))
        return reference

    @wp.func
    def count_node(accel: struct, ray: Ray, counts: Counts, index: int) -> Counts:
        if wp.static(units.counters):
            boxes = int(0)
            for j in range(width):
                if bits(accel.nodes, index * wp.static(size_of_node) + references + j) != EMPTY:
                    boxes += 1
            return fetch_node(accel.recorder, ray, counts, index, boxes)
        return counts

    @wp.func
    def test_leaf(accel: struct, surfaces: Surfaces, reference: int, probe: Probe, rows: LaneRay, best: Hit) -> Hit:
        begin = (-1 - reference) / LEAF_RANGE * unit
        end = begin + (-1 - reference) % LEAF_RANGE + 1
        while begin < end:
            row = begin / width
            lane = int(0)
            if wp.static(compressed):
                lane = begin - row * width
            n = wp.min(width - lane, end - begin)
            mask = ((2 << (n - 1)) - 1) << lane
            best = test_row(accel.primitives, row * wp.static(row_size), mask, surfaces, probe, rows, best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    return best
            begin = begin + n
        return best

    @wp.func
    def count_leaf(accel: struct, ray: Ray, counts: Counts, reference: int) -> Counts:
        if wp.static(units.counters):
            first = (-1 - reference) / LEAF_RANGE * unit
            counts.leaves += 1
            for j in range((-1 - reference) % LEAF_RANGE + 1):
                counts = fetch_primitive(accel.recorder, ray, counts, first + j)
        return counts

    @wp.func
    def count_pop(counts: Counts) -> Counts:
        if wp.static(units.counters):
            counts.pops += 1
        return counts

    @wp.func
    def traverse(accel: struct, surfaces: Surfaces, ray: Ray) -> Hit:
        probe = probe_of(ray)
        rows = lane_ray(probe, wp.static(float(pad)))
        best = no_hit(ray)
        best.t = wp.where(best.t < MAX_T, best.t, MAX_T)
        counts = Counts()
        stack = empty_stack()
        size = int(0)
        reference = int(0)
        while True:
            if reference < 0:
                best = test_leaf(accel, surfaces, reference, probe, rows, best)
                counts = count_leaf(accel, ray, counts, reference)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        return finish(accel.recorder, ray, counts, best)
            else:
                first = reference * wp.static(size_of_node)
                counts = count_node(accel, ray, counts, reference)
                t = entries(accel.nodes, first, rows)
                mask = entered(accel.nodes, first, rows, best.t)
                if mask != 0:
                    first = first + references
                    lane = lowest(mask)
                    mask = mask & (mask - 1)
                    near = key_of(t[lane], child(accel, first + lane))
                    begin = size
                    while mask != 0:
                        lane = lowest(mask)
                        mask = mask & (mask - 1)
                        key = key_of(t[lane], child(accel, first + lane))
                        if wp.static(any_hit):
                            stack[size] = near
                            near = key
                        else:
                            far = wp.max(near, key)
                            near = wp.min(near, key)
                            # Not sorted, but the farthest so far is deeper than this one: most nodes have two or three.
                            if size > begin:
                                under = stack[size - 1]
                                stack[size] = wp.min(far, under)
                                stack[size - 1] = wp.max(far, under)
                            else:
                                stack[size] = far
                        size = size + 1
                        counts = push(counts, size)
                    reference = reference_of(near)
                    continue
            # Pop; what begins beyond the closest hit is dropped. Equal stays: a tie may have a lower prim_id there.
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                counts = count_pop(counts)
                key = stack[size]
                if t_of(key) <= best.t:
                    reference = reference_of(key)
                    found = True
            if not found:
                break
        return finish(accel.recorder, ray, counts, best)

    return traverse


class WideTraversal:
    """What wrt.accel takes for the traversal's module, for one layout of nodes."""

    def __init__(self, width: int, compressed: bool = False) -> None:
        self.width = width
        self.compressed = compressed

    def make_struct(self, record):
        return make_struct(record)

    def make_traversal(self, units: Units, any_hit: bool, accepts=None):
        return make_traversal(units, any_hit, accepts, self.width, self.compressed)
