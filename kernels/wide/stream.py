"""Many rays through a wide BVH on the CPU: two ways to keep one core busy, for the same hits to the last bit.

Rays that go the same way are taken through the tree as a packet (Wald et al. 2001, "Interactive Rendering with Coherent Ray
Tracing"): a node is met by a beam around all rays, and then only those of its children that the beam meets are tested against
the rays, sixteen at a time. Rays that do not are taken one step at a time by turns, many of them under way at once, so that the
core has something to do while a ray waits for memory or for its own last result.
"""

from functools import cache

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import NO_HIT, Hit, Surfaces, kernel
from wrt.kernels.traverse.common import Probe, Units, make_intersect
from wrt.kernels.wide.lanes import make_lanes
from wrt.kernels.wide.nodes import first_reference, make_box_test, node_size
from wrt.kernels.wide.packets import (
    ENTRY,
    LANES,
    MET,
    PACKET_SIZE,
    ROW,
    STACK_WORDS,
    TO_POP,
    Scratch,
    begin,
    children,
    count_of,
    lowest_of_all,
    meets,
    pop,
    put_bits,
    put_number,
    put_slot,
    reaching,
    set_up,
    sift,
    slot_at,
    step,
    triangles,
    write_dark,
    write_hits,
)
from wrt.kernels.wide.traverse import (
    EMPTY_STACK,
    LEAF_RANGE,
    STACK_SIZE,
    WideTraversal,
    key_of,
    make_gather,
    make_struct,
    reference_of,
    t_of,
)

WIDTH = 8
lowest, number, bits = make_lanes(WIDTH).lowest, make_lanes(WIDTH).value, make_lanes(WIDTH).bits
NODE = node_size(WIDTH, False)
REFERENCES = first_reference(WIDTH, False)
PACKETS = 4  # set up at a time
SLOTS = 16  # rays under way at a time
FEW = 6  # rays up to so many are tested one by one with the triangles of a leaf
WORDS = 8  # of a slot
# Packets are given up for a while where one after another falls apart: so many in a row, for so many that follow.
IN_A_ROW, BREAK = 4, 32
GIVEN_UP = WORDS * SLOTS  # where Scratch.slots counts: those in a row below 0, those that are left above
COHERENT = 1 << LANES  # what `set_up` adds to the mask of rays that have a beam

# A packet leaves as many entries as a ray alone, but the nearest child is on the stack as well, before it is taken from there.
ENTRIES = STACK_SIZE + 1
key_stack, mask_stack = wp.types.vector(ENTRIES, wp.uint64), wp.types.vector(ENTRIES, wp.int32)


@wp.func_native(EMPTY_STACK.replace("TYPE", f"wp::vec_t<{ENTRIES}, wp::uint64>"))
def empty_keys() -> key_stack: ...


@wp.func_native(EMPTY_STACK.replace("TYPE", f"wp::vec_t<{ENTRIES}, wp::int32>"))
def empty_masks() -> mask_stack: ...


@wp.func
def vector(packet: wp.array(dtype=wp.float32), first: int) -> wp.vec3:
    """Three rows of one lane."""
    return wp.vec3(number(packet, first), number(packet, first + LANES), number(packet, first + 2 * LANES))


@wp.func
def probe_at(packet: wp.array(dtype=wp.float32), ray: int) -> Probe:
    """The scalar units' set-up, from one column of a packet."""
    probe = Probe()
    probe.ray.origin = vector(packet, ray + wp.static(ROW["origin_x"]))
    probe.ray.direction = vector(packet, ray + wp.static(ROW["direction_x"]))
    probe.ray.t_min = number(packet, ray + wp.static(ROW["t_min"]))
    probe.box.origin = probe.ray.origin
    probe.box.inv_dir = vector(packet, ray + wp.static(ROW["inverse_x"]))
    probe.box.t_min = probe.ray.t_min
    axes = bits(packet, ray + wp.static(ROW["axes"]))
    probe.triangle.kx = axes & 3
    probe.triangle.ky = (axes >> 2) & 3
    probe.triangle.kz = axes >> 4
    probe.triangle.shear_x = number(packet, ray + wp.static(ROW["shear_x"]))
    probe.triangle.shear_y = number(packet, ray + wp.static(ROW["shear_y"]))
    probe.triangle.shear_z = number(packet, ray + wp.static(ROW["shear_z"]))
    return probe


@wp.func
def best_at(packet: wp.array(dtype=wp.float32), ray: int) -> Hit:
    best = Hit()
    best.t = number(packet, ray + wp.static(ROW["t"]))
    best.u = number(packet, ray + wp.static(ROW["u"]))
    best.v = number(packet, ray + wp.static(ROW["v"]))
    best.prim_id = bits(packet, ray + wp.static(ROW["prim_id"]))
    return best


def make_leaf_test(units: Units, any_hit: bool):
    """The triangles of a row that are in a mask against one ray of a packet; whether the ray has found what it asks for."""
    gather = make_gather(units.triangle_test.record, WIDTH)
    intersect = make_intersect(units)

    @wp.func
    def test_row(rows: wp.array(dtype=wp.float32), first: int, mask: int, surfaces: Surfaces, packet: wp.array(dtype=wp.float32),
                 ray: int) -> bool:
        probe = probe_at(packet, ray)
        best = best_at(packet, ray)
        while mask != 0:
            best = intersect(probe, surfaces, gather(rows, first + lowest(mask)), best)
            mask = mask & (mask - 1)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    mask = int(0)
        t = best.t
        if wp.static(any_hit):
            t = wp.where(best.prim_id != NO_HIT, -float(wp.inf), t)  # nothing else is reached
        put_number(packet, ray + wp.static(ROW["t"]), t)
        put_number(packet, ray + wp.static(ROW["u"]), best.u)
        put_number(packet, ray + wp.static(ROW["v"]), best.v)
        put_bits(packet, ray + wp.static(ROW["prim_id"]), best.prim_id)
        return wp.static(any_hit) and best.prim_id != NO_HIT

    return test_row


@wp.func
def row_of(reference: int) -> int:
    """The first row of a leaf."""
    return (-1 - reference) / LEAF_RANGE


@wp.func
def size_of(reference: int) -> int:
    """The number of its triangles."""
    return (-1 - reference) % LEAF_RANGE + 1


def make_together(units: Units, any_hit: bool):
    """A packet with a beam, from the root."""
    struct = make_struct(units.triangle_test.record)
    row_size = units.triangle_test.record.numpy_dtype()["itemsize"] // 4 * WIDTH
    test_row = make_leaf_test(units, any_hit)

    @wp.func
    def test_leaf(accel: struct, surfaces: Surfaces, reference: int, mask: int, packet: wp.array(dtype=wp.float32), base: int):
        left = size_of(reference)
        first = row_of(reference) * wp.static(row_size)
        while left > 0 and mask != 0:
            n = wp.min(left, WIDTH)
            if count_of(mask) > FEW:
                found = triangles(accel.primitives, first, n, mask, any_hit, packet, base)
                if wp.static(any_hit):
                    mask = mask & ~found
            else:
                rays = int(mask)
                while rays != 0:
                    lane = lowest(rays)
                    rays = rays & (rays - 1)
                    candidates = sift(accel.primitives, first, (2 << (n - 1)) - 1, packet, base + lane)
                    if candidates != 0:
                        if test_row(accel.primitives, first, candidates, surfaces, packet, base + lane):
                            mask = mask & ~(1 << lane)
            left = left - WIDTH
            first = first + wp.static(row_size)

    @wp.func
    def together(accel: struct, surfaces: Surfaces, packet: wp.array(dtype=wp.float32), base: int, active: int) -> int:
        """1 where it was worth it, -1 where two rays hardly ever met the same leaf, 0 without any leaf."""
        leaves = int(0)
        visits = int(0)
        stack = empty_keys()
        masks = empty_masks()
        size = int(0)
        reference = int(0)
        mask = int(active)
        while True:
            if reference < 0:
                leaves += 1
                visits += count_of(mask)
                test_leaf(accel, surfaces, reference, mask, packet, base)
            else:
                first = reference * NODE
                met = children(accel.nodes, first, mask, packet, base)
                under = size
                while met != 0:
                    lane = lowest(met)
                    met = met & (met - 1)
                    key = key_of(number(packet, base + ENTRY + lane), bits(accel.nodes, first + REFERENCES + lane))
                    at = size
                    if wp.static(not any_hit):  # sorted, the farthest deepest
                        while at > under and stack[at - 1] < key:
                            stack[at] = stack[at - 1]
                            masks[at] = masks[at - 1]
                            at = at - 1
                    stack[at] = key
                    masks[at] = bits(packet, base + MET + lane)
                    size = size + 1
            mask = int(0)
            while size > 0 and mask == 0:
                size = size - 1
                mask = masks[size] & reaching(t_of(stack[size]), packet, base)
            if mask == 0:
                break
            reference = reference_of(stack[size])
        return wp.where(leaves == 0, 0, wp.where(visits < 2 * leaves, -1, 1))

    return together


def make_by_turns(units: Units, any_hit: bool):
    """Rays of several packets, each for itself, from the root. waiting: a bit for each; lane after lane, packet after packet."""
    struct = make_struct(units.triangle_test.record)
    row_size = units.triangle_test.record.numpy_dtype()["itemsize"] // 4 * WIDTH
    test_row = make_leaf_test(units, any_hit)

    @wp.func
    def start(accel: struct, scratch: Scratch, slot: int, ray: int):
        begin(accel.nodes, accel.primitives, scratch.packets, ray / LANES * PACKET_SIZE + ray % LANES, scratch.stacks,
              slot * STACK_WORDS, scratch.slots, slot * WORDS)

    @wp.func
    def visit_leaf(accel: struct, surfaces: Surfaces, scratch: Scratch, slot: int, ray: int, reference: int) -> bool:
        """Sift the triangles of the last row; those of others are also tested. Whether the ray has found what it asks for."""
        n = size_of(reference)
        first = row_of(reference) * wp.static(row_size)
        while n > WIDTH:
            candidates = sift(accel.primitives, first, wp.static((1 << WIDTH) - 1), scratch.packets, ray)
            if test_row(accel.primitives, first, candidates, surfaces, scratch.packets, ray):
                return True
            n = n - WIDTH
            first = first + wp.static(row_size)
        candidates = sift(accel.primitives, first, (2 << (n - 1)) - 1, scratch.packets, ray)
        put_slot(scratch.slots, slot * WORDS + 3, candidates | TO_POP)
        put_slot(scratch.slots, slot * WORDS + 4, first)
        return False

    @wp.func
    def turn(accel: struct, surfaces: Surfaces, scratch: Scratch, slot: int) -> bool:
        """One node, one row of triangles, or what is left to do after them; False where the ray is done."""
        ray = slot_at(scratch.slots, slot * WORDS)
        before = slot_at(scratch.slots, slot * WORDS + 3)
        if before != 0:
            if before != TO_POP:
                if test_row(accel.primitives, slot_at(scratch.slots, slot * WORDS + 4), before & (TO_POP - 1), surfaces,
                            scratch.packets, ray):
                    return False
            return pop(accel.nodes, accel.primitives, number(scratch.packets, ray + wp.static(ROW["t"])), scratch.stacks,
                       slot * STACK_WORDS, scratch.slots, slot * WORDS)
        reference = slot_at(scratch.slots, slot * WORDS + 1)
        if reference < 0:
            return not visit_leaf(accel, surfaces, scratch, slot, ray, reference)
        step(accel.nodes, accel.primitives, scratch.packets, scratch.stacks, scratch.slots, slot * WORDS)
        return True

    @wp.func
    def by_turns(accel: struct, surfaces: Surfaces, scratch: Scratch, waiting: wp.uint64):
        live = int(0)
        slot = int(0)
        while slot < SLOTS and waiting != wp.uint64(0):
            start(accel, scratch, slot, lowest_of_all(waiting))
            waiting = waiting & (waiting - wp.uint64(1))
            live = live | (1 << slot)
            slot = slot + 1
        while live != 0:
            todo = int(live)
            while todo != 0:
                slot = lowest(todo)
                todo = todo & (todo - 1)
                if not turn(accel, surfaces, scratch, slot):
                    if waiting != wp.uint64(0):
                        start(accel, scratch, slot, lowest_of_all(waiting))
                        waiting = waiting & (waiting - wp.uint64(1))
                    else:
                        live = live & ~(1 << slot)

    return by_turns


@cache
def make_kernel(units: Units, any_hit: bool):
    """Rays first .. end - 1, a block of PACKETS packets a thread, one thread after another in the same scratch. out:
    HitArrays, or for any hit an array of bool. Arrays must have no gaps."""
    struct = make_struct(units.triangle_test.record)
    pad = make_box_test(units.box, WIDTH, False)[2]
    together = make_together(units, any_hit)
    by_turns = make_by_turns(units, any_hit)
    write = write_dark if any_hit else write_hits
    out_type = wp.array(dtype=wp.bool) if any_hit else HitArrays

    @kernel
    def trace(accel: struct, surfaces: Surfaces, rays: RayArrays, out: out_type, scratch: Scratch, first: int, end: int):
        block = first + wp.static(PACKETS * LANES) * wp.tid()
        if wp.tid() == 0:
            put_slot(scratch.slots, GIVEN_UP, 0)
        alone = wp.uint64(0)
        for p in range(PACKETS):
            count = wp.min(end - block - LANES * p, LANES)
            if count > 0:
                base = PACKET_SIZE * p
                active = set_up(rays, block + LANES * p, count, wp.static(float(pad)), scratch.packets, base)
                given_up = slot_at(scratch.slots, GIVEN_UP)
                if active >= COHERENT and given_up <= 0:
                    worth = together(accel, surfaces, scratch.packets, base, active - COHERENT)
                    given_up = wp.where(worth > 0, 0, given_up + worth)
                    put_slot(scratch.slots, GIVEN_UP, wp.where(given_up == -IN_A_ROW, BREAK, given_up))
                else:
                    if given_up > 0:  # the last of them is followed by one more try
                        put_slot(scratch.slots, GIVEN_UP, wp.where(given_up == 1, 1 - IN_A_ROW, given_up - 1))
                    active = active & wp.static(COHERENT - 1)
                    active = meets(accel.nodes, 0, active, scratch.packets, base)
                    alone = alone | (wp.uint64(active) << wp.uint64(LANES * p))
        by_turns(accel, surfaces, scratch, alone)
        for p in range(PACKETS):
            count = wp.min(end - block - LANES * p, LANES)
            if count > 0:
                write(out, block + LANES * p, count, scratch.packets, PACKET_SIZE * p)

    return trace


class StreamTraversal(WideTraversal):
    """Plain nodes of 8, for which there is a kernel for many rays at a time."""

    stream_block = PACKETS * LANES
    stream_sizes = PACKETS * PACKET_SIZE, STACK_WORDS * SLOTS, GIVEN_UP + 1  # lengths of a Scratch's arrays

    def __init__(self) -> None:
        super().__init__(WIDTH)

    def make_stream(self, units: Units, any_hit: bool):
        """None for units that it has no lanes for."""
        if units.triangle != "watertight" or units.box == "plain" or units.spheres or units.counters or units.instances:
            return None
        return make_kernel(units, any_hit)
