"""Traversal of a wide BVH for many rays on the CPU: packets and interleaved rays. The hits have the bits of the traversal for one ray.

Sixteen rays with similar directions walk the tree as a packet (Wald et al. 2001, "Interactive Rendering with Coherent Ray Tracing"). At a
node, a beam around all rays is tested first. The children that the beam enters are then tested against all sixteen rays at once. All other
rays are interleaved: one thread has many rays in progress, and each ray takes one step in turn. So the core has work, while some rays
wait for memory or for the result of an instruction."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.hit_lists import HitLists
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.rows import put_int
from wrt.kernels.structs import Surfaces
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.stack import reference_of, t_of
from wrt.kernels.wide.lanes import bits, lowest
from wrt.kernels.wide.lanes import value as number
from wrt.kernels.wide.layout import ACTIVE, COHERENT, FIELD, LANES, MIXED, PACKET_SIZE, REFUSED, ROW_SIZE, SLOT, SLOT_SIZE, WIDTH
from wrt.kernels.wide.leaves import make_packet_leaf, make_row_test
from wrt.kernels.wide.nodes import far_pad
from wrt.kernels.wide.packets import (
    ANY_REFUSED,
    FAILED,
    MIXED_FAILED,
    MIXED_PAUSED,
    PAUSED,
    REPORT_SIZE,
    Scratch,
    WideBvh,
    begin_lists,
    count_of,
    key_at,
    lowest_of_all,
    make_children,
    make_set_up,
    make_steps,
    packet_kernel,
    prefetch_next,
    rays_at,
    rays_meeting_root,
    rays_reaching,
    slot_at,
    store_bits,
    write_hits,
    write_lists,
    write_occluded,
)
from wrt.kernels.wide.references import DONE, EMPTY, leaf_count, leaf_first

PACKETS = 4  # Number of packets that are set up together.
SLOTS = 24  # Number of interleaved rays in progress.
MIN_VISITS = 6  # Mean number of rays per node from which a packet is faster than interleaving its rays.
# Numbers of nodes between which the walk of a MIXED packet stops if it is below MIN_VISITS.
FIRST_STOP, LAST_STOP = 6, 16
# Results of a packet's walk. All rays are finished, and their visits reached MIN_VISITS (TOGETHER) or did not (APART). Or the walk has
# STOPPED: the rays begin again one by one. The hits found so far shorten them; lists begin empty.
TOGETHER, APART, STOPPED = (wp.constant(result) for result in range(3))
# A packet below MIN_VISITS has failed. After MAX_FAILED failures in succession, the rays of the next PAUSE packets are interleaved, or of
# the next MIXED_PAUSE packets of the kind MIXED.
MAX_FAILED, PAUSE, MIXED_PAUSE = 4, 32, 128


@wp.func
def pop_packet(scratch: Scratch, base: int, size: int, bottom: int):
    """Pop entries of a packet's stack, down to `bottom`, until rays reach one. Return the mask of these rays, and the stack's new size."""
    mask = int(0)
    while size > bottom and mask == 0:
        size = size - 1
        mask = rays_at(scratch.stacks, size) & rays_reaching(t_of(key_at(scratch.stacks, size)), scratch, base)
    return mask, size


def make_packet_walk(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Return walk, which traces a packet of rays through the tree.
    The packet must have a beam: bounds of the origins and directions of all its rays, tested first at each node (layout.BEAM).
    Only any-hit packets may be MIXED: for closest hits, interleaving their rays is faster."""
    children, test_leaf = make_children(any_hit), make_packet_leaf(units, any_hit, accepts)
    mixed_children = make_children(any_hit, True) if any_hit else children

    @wp.func
    def walk(accel: WideBvh, surfaces: Any, scratch: Scratch, base: int, active: int) -> int:
        """Trace the active rays; active: the result of set_up. Return TOGETHER, APART or STOPPED."""
        result = int(APART)
        nodes = int(0)
        visits = int(0)
        size = int(0)
        reference = int(0)
        mask = active & wp.static(COHERENT - 1)
        while True:
            if reference < 0:
                test_leaf(accel, surfaces, reference, mask, scratch, base)
            else:
                nodes += 1
                visits += count_of(mask)
                if wp.static(not any_hit):
                    size = children(accel, scratch, base, reference, mask, size)
                elif active < MIXED:
                    size = children(accel, scratch, base, reference, mask, size)
                elif visits < MIN_VISITS * nodes and nodes >= FIRST_STOP and nodes <= LAST_STOP:
                    result = STOPPED
                    size = int(0)
                else:
                    size = mixed_children(accel, scratch, base, reference, mask, size)
            mask, size = pop_packet(scratch, base, size, 0)
            if mask == 0:
                break
            reference = reference_of(key_at(scratch.stacks, size))
        if result != STOPPED and visits >= MIN_VISITS * nodes:
            result = TOGETHER
        return result

    return walk


@wp.func
def count_walk(scratch: Scratch, failed_at: int, together: bool):
    """Count a packet's walk in scratch.report; failed_at: FAILED or MIXED_FAILED. The entry behind it is PAUSED or MIXED_PAUSED."""
    failed = wp.where(together, 0, slot_at(scratch.report, failed_at) + 1)
    if failed == MAX_FAILED:  # After this pause, a single failure starts the next pause.
        failed = failed - 1
        pause = wp.where(failed_at == MIXED_FAILED, MIXED_PAUSE, PAUSE)
        put_int(scratch.report, failed_at + wp.static(PAUSED - FAILED), pause)
    put_int(scratch.report, failed_at, failed)


def make_visit(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Return visit(accel, surfaces, scratch, slot), which visits the node or leaf of a slot's ray. It returns the ray's next reference:
    EMPTY if none is left, DONE if the ray ends at its first hit."""
    test_row = make_row_test(units, any_hit, accepts, True)  # Inlining makes closest hits 1.02 times, any hits 1.05 times as fast.
    _, step, pop = make_steps(any_hit)

    @wp.func
    def visit(accel: WideBvh, surfaces: Any, scratch: Scratch, slot: int) -> int:
        words = slot * SLOT_SIZE
        reference = slot_at(scratch.slots, words + wp.static(SLOT["next"]))
        if reference >= 0:
            return step(accel, scratch, slot)
        ray = slot_at(scratch.slots, words + wp.static(SLOT["ray"]))
        left = leaf_count(reference)
        first = leaf_first(reference) * ROW_SIZE
        while left > 0:
            if test_row(accel, first, wp.min(left, WIDTH), surfaces, scratch, ray):
                return DONE
            left = left - WIDTH
            first = first + ROW_SIZE
        return pop(accel, scratch, slot, number(scratch.packets, ray + wp.static(FIELD["t"])))

    return visit


def make_interleaved(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Return interleaved, which traces rays of PACKETS packets through the tree, one step of each ray in turn.

    The mask `waiting` has a bit for each ray to trace: bit LANES * packet + lane."""
    visit, begin = make_visit(units, any_hit, accepts), make_steps(any_hit).begin
    surfaces_type: Any = HitLists if units.lists else Surfaces

    @wp.func
    def start(accel: WideBvh, scratch: Scratch, slot: int, ray: int):
        """Put ray `ray` = LANES * packet + lane into a slot. It enters a child of the root (rays_meeting_root), so a next node exists."""
        column = ray / LANES * PACKET_SIZE + ray % LANES
        prefetch_next(accel, begin(accel, scratch, slot, column))

    @wp.func
    def turn(accel: WideBvh, surfaces: Any, scratch: Scratch, slot: int) -> bool:
        """Visit the node or leaf of a slot's ray. Return False if the ray is finished."""
        next = visit(accel, surfaces, scratch, slot)
        if next == EMPTY or next == DONE:
            return False
        prefetch_next(accel, next)
        return True

    @wp.func
    def interleaved(accel: WideBvh, surfaces: surfaces_type, scratch: Scratch, waiting: wp.uint64):
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

    return interleaved


@cache
def make_kernel(units: Units, any_hit: bool, rays_struct: Any = RayArrays, accepts: Any = None) -> Any:
    """Return the kernel that traces the rays first .. end - 1 in a single thread, PACKETS packets at a time.

    The kernel writes to `out` and to scratch.report. `out` is HitArrays or, with any_hit, an array of bool. With units.lists it is
    HitLists: these need any_hit, whose walk sorts no children, and HitLists.limit ends no walk. All arrays must be contiguous."""
    walk_packet = make_packet_walk(units, any_hit, accepts)
    interleaved = make_interleaved(units, any_hit, accepts)
    set_up = make_set_up(rays_struct, any_hit)
    write = write_lists if units.lists else write_occluded if any_hit else write_hits
    out_type: Any = HitLists if units.lists else wp.array(dtype=wp.bool) if any_hit else HitArrays

    @packet_kernel
    def trace(accel: WideBvh, surfaces: Surfaces, rays: rays_struct, out: out_type, scratch: Scratch, first: int, end: int):
        for i in range(REPORT_SIZE):
            put_int(scratch.report, i, 0)
        for block in range(first, end, wp.static(PACKETS * LANES)):
            single_rays = wp.uint64(0)
            mixes = slot_at(scratch.report, MIXED_PAUSED) == 0  # Else MIXED packets get no beam, which takes long.
            packets = wp.min((end - block + LANES - 1) / LANES, PACKETS)  # Not a constant: Warp would unroll the loop over the walk.
            for p in range(packets):
                base = PACKET_SIZE * p
                count = wp.min(end - block - LANES * p, LANES)
                active = set_up(rays, block + LANES * p, count, wp.static(far_pad(units.box)), mixes, scratch, base)
                store_bits(scratch.packets, base + ACTIVE, active)
                if bits(scratch.packets, base + REFUSED) != 0:
                    put_int(scratch.report, ANY_REFUSED, 1)
            for p in range(packets):
                base = PACKET_SIZE * p
                active = bits(scratch.packets, base + ACTIVE)
                failed_at = wp.where(wp.static(any_hit) and active >= MIXED, MIXED_FAILED, FAILED)
                paused = slot_at(scratch.report, failed_at + wp.static(PAUSED - FAILED))
                result = int(STOPPED)
                if active >= COHERENT and paused == 0 and (mixes or active < MIXED):
                    if wp.static(units.lists):
                        begin_lists(block + LANES * p, scratch, base)
                        result = walk_packet(accel, out, scratch, base, active)
                    else:
                        result = walk_packet(accel, surfaces, scratch, base, active)
                    count_walk(scratch, failed_at, result == TOGETHER)
                else:
                    put_int(scratch.report, failed_at + wp.static(PAUSED - FAILED), wp.max(paused - 1, 0))
                if result == STOPPED:
                    if wp.static(units.lists):
                        begin_lists(block + LANES * p, scratch, base)  # the rays begin again
                    active = rays_meeting_root(accel, scratch, base, active & wp.static(COHERENT - 1))
                    single_rays = single_rays | (wp.uint64(active) << wp.uint64(LANES * p))
            if wp.static(units.lists):
                interleaved(accel, out, scratch, single_rays)
            else:
                interleaved(accel, surfaces, scratch, single_rays)
            for p in range(packets):
                write(out, block + LANES * p, wp.min(end - block - LANES * p, LANES), scratch, PACKET_SIZE * p)

    return trace
