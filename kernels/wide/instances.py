"""Traversal of instances for many rays on the CPU. The hits have the bits of traverse/instances.py, which walks with one ray at a time.

The upper level is a wide BVH whose leaves are single placements. Packets and interleaved rays walk it as they walk a structure over one
mesh (wide/batch.py). At a placement, the rays of a packet that enter its box change to its space together, and walk its structure as a
packet of their own. An interleaved ray changes to its space alone, and its slot continues with the steps of the placed structure."""

from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from wrt.kernels.headers import with_headers
from wrt.kernels.query import FilteredRays, HitArrays, RayArrays, WorldRays
from wrt.kernels.rows import put_int
from wrt.kernels.structs import Surfaces, kernel
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.instances import make_struct
from wrt.kernels.traverse.stack import reference_of
from wrt.kernels.wide.batch import (
    MIN_VISITS,
    PACKETS,
    SLOTS,
    STOPPED,
    count_walk,
    make_interleaved,
    make_packet_walk,
    make_visit,
    pop_packet,
)
from wrt.kernels.wide.lanes import bits, lowest
from wrt.kernels.wide.lanes import value as number
from wrt.kernels.wide.layout import ACTIVE, COHERENT, ENTRY, FIELD, LANES, LAYOUT_H, PACKET_SIZE, REFUSED, SLOT, SLOT_SIZE, STACK_WORDS
from wrt.kernels.wide.nodes import far_pad
from wrt.kernels.wide.packets import (
    ANY_REFUSED,
    FAILED,
    PAUSED,
    Scratch,
    WideBvh,
    count_of,
    flag,
    key_at,
    lowest_of_all,
    make_set_up,
    prefetch_next,
    rays_meeting_root,
    slot_at,
    store_bits,
    write_hits,
    write_occluded,
)
from wrt.kernels.wide.references import DONE, EMPTY, leaf_first

Instances = make_struct(WideBvh)
HEADERS = with_headers("wide/instances.h", layout=LAYOUT_H)

if TYPE_CHECKING:  # type checkers skip device code (structs.py)
    from typing import no_type_check as instances_kernel
else:
    def instances_kernel(function):
        """Make a kernel that can call the functions of this file."""
        return kernel(function, extra_build_options=HEADERS)

# The first packets of Scratch are in the spaces of placements: of a packet that walks, and of the ray in each slot. Scratch has two stacks
# and two slots for each interleaved ray. The second, at an index higher by SLOTS, is for the upper level. Packets use its stacks, too.
PLACED = (SLOTS + LANES - 1) // LANES
FILTERS = (PLACED + PACKETS) * PACKET_SIZE  # Index in Scratch.packets, behind the packets, of each packet's structs.Filter: rays_seeing.
FILTERS_SIZE = 2 * LANES * PACKETS
TOP_STACK = STACK_WORDS * SLOTS // ENTRY  # First entry of a packet's stack in the upper level.
FEW_PLACED = 3  # If at most so many rays of a packet enter a placement, they are interleaved.


class TopSteps(NamedTuple):
    """Functions of packets.py for the upper level. Each calls C++ (instances.h)."""

    children: Any  # As make_children.
    rays_meeting: Any  # As rays_meeting_root, for the root of a world.
    begin: Any  # begin, step, pop: as in Steps.
    step: Any
    pop: Any


@cache
def make_top_steps(any_hit: bool) -> TopSteps:
    hits, memory = flag(any_hit), "accel.wide.data, scratch.packets.data"
    stack = f"scratch.stacks.data, {STACK_WORDS} * slot, scratch.slots.data + {SLOT_SIZE} * slot"

    @wp.func_native(f"return wrt::top_children<{hits}>({memory} + base, reference, mask, scratch.stacks.data, size);")
    def children(accel: Instances, scratch: Scratch, base: int, reference: int, mask: int, size: int) -> int: ...

    @wp.func_native(f"return wrt::rays_meeting_top({memory} + base, root, mask);")
    def rays_meeting(accel: Instances, scratch: Scratch, base: int, root: int, mask: int) -> int: ...

    @wp.func_native(f"return wrt::begin<{hits}>(accel.wide.data, root, scratch.packets.data, ray, {stack});")
    def begin(accel: Instances, scratch: Scratch, slot: int, root: int, ray: int) -> int: ...

    @wp.func_native(f"return wrt::top_step<{hits}>({memory}, {stack});")
    def step(accel: Instances, scratch: Scratch, slot: int) -> int: ...

    @wp.func_native(f"return wrt::pop<{hits}>(accel.wide.data, reach, {stack});")
    def pop(accel: Instances, scratch: Scratch, slot: int, reach: float) -> int: ...

    return TopSteps(children, rays_meeting, begin, step, pop)


class Changes(NamedTuple):
    """Functions for the change to the space of a placement and back. Each calls C++ (instances.h)."""

    place_packet: Any  # Set up the rays of the mask in the packet at `base` as packet 0 in a placement's space. Return as set_up.
    take_packet: Any  # Store the hits of packet 0 that are better than those of the packet at `base`.
    place_ray: Any  # As place_packet, for one ray. The arguments `ray` and `local` are the indices of its columns.
    take_hit: Any  # As take_packet, for one ray.


@cache
def make_changes(any_hit: bool, pad: float) -> Changes:
    place, packets, hits = "accel.placements.data[placement]", "scratch.packets.data", flag(any_hit)

    @wp.func_native(f"return wrt::place_packet<{hits}>({packets} + base, {place}, mask, {pad!r}, {packets});")
    def place_packet(accel: Instances, placement: int, scratch: Scratch, base: int, mask: int) -> int: ...

    @wp.func_native(f"wrt::take_hits<{LANES}, {hits}>({{{packets} + base}}, {place}, {{{packets}}});")
    def take_packet(accel: Instances, placement: int, scratch: Scratch, base: int) -> None: ...

    @wp.func_native(f"wrt::place_ray({packets} + ray, {place}, {pad!r}, {packets} + local);")
    def place_ray(accel: Instances, placement: int, scratch: Scratch, ray: int, local: int) -> None: ...

    @wp.func_native(f"wrt::take_hits<1, {hits}>({{{packets} + ray}}, {place}, {{{packets} + local}});")
    def take_hit(accel: Instances, placement: int, scratch: Scratch, ray: int, local: int) -> None: ...

    return Changes(place_packet, take_packet, place_ray, take_hit)


@wp.func_native(f"""
    int* const words = scratch.slots.data + {SLOT_SIZE} * slot;
    wrt::clear(scratch.stacks.data, {STACK_WORDS} * slot);
    words[{SLOT["ray"]}] = ray;
    words[{SLOT["next"]}] = next;
    words[{SLOT["place"]}] = {STACK_WORDS} * slot;
    words[{SLOT["placement"]}] = placement;
""")
def fill_slot(scratch: Scratch, slot: int, ray: int, next: int, placement: int) -> None:
    """Put a ray with an empty stack into a slot."""


def make_store_roots(rays_struct: Any) -> Any:
    @wp.func_native("""
        return wrt::store_roots(rays.world.data + (rays.world.strides[0] == 0 ? 0 : first), rays.world.strides[0] != 0, accel.roots.data,
                                accel.roots.shape[0], count, active, scratch.packets.data + base);
    """)
    def store_roots(accel: Instances, rays: rays_struct, first: int, count: int, active: int, scratch: Scratch, base: int) -> int:
        """Store the root of each ray's world. Return the mask `active` (see set_up) as instances.h describes."""

    return store_roots


@wp.func_native(f"""
    int* const to = (int*)scratch.packets.data + {FILTERS} + {2 * LANES} * packet;
    for (int j = 0; j < count; ++j) {{
        to[j] = rays.exclude.data[rays.exclude.strides[0] == 0 ? 0 : first + j];
        to[{LANES} + j] = rays.mask.data[rays.mask.strides[0] == 0 ? 0 : first + j];
    }}
""")
def store_filters(rays: FilteredRays, first: int, count: int, scratch: Scratch, packet: int) -> None: ...


@wp.func_native(f"""
    const int id = accel.ids.data[placement];
    return wrt::rays_seeing((const int*)scratch.packets.data + {FILTERS} + {2 * LANES} * packet, accel.bodies.data[id],
                            accel.masks.data[id], mask);
""")
def rays_seeing(accel: Instances, placement: int, scratch: Scratch, packet: int, mask: int) -> int:
    """Return the rays of the mask, of packet PLACED + `packet`, that see a placement."""


def make_top_walk(units: Units, any_hit: bool) -> Any:
    """Return walk, which traces a packet of rays through the instances. The packet must have a beam."""
    children, (place_packet, take_packet, _, _) = make_top_steps(any_hit).children, make_changes(any_hit, far_pad(units.box))
    walk_packet = make_packet_walk(units, any_hit, None)
    interleaved = make_interleaved(units, any_hit, None)

    @wp.func
    def visit(accel: Instances, surfaces: Surfaces, placement: int, mask: int, scratch: Scratch, base: int):
        """Trace the rays of the mask through a placement's structure."""
        if wp.static(units.filtered):
            mask = rays_seeing(accel, placement, scratch, base / PACKET_SIZE - PLACED, mask)
            if mask == 0:
                return
        bottom = accel.bottoms[accel.placements[placement].bottom]
        active = place_packet(accel, placement, scratch, base, mask)
        result = int(STOPPED)
        if active >= COHERENT and count_of(mask) > FEW_PLACED:
            result = walk_packet(bottom, surfaces, scratch, 0, active)
        if result == STOPPED:
            active = rays_meeting_root(bottom, scratch, 0, active & wp.static(COHERENT - 1))
            interleaved(bottom, surfaces, scratch, wp.uint64(active))
        take_packet(accel, placement, scratch, base)

    @wp.func
    def walk(accel: Instances, surfaces: Surfaces, scratch: Scratch, base: int, root: int, active: int) -> bool:
        """Trace the rays in the mask `active` from the node `root`. Return whether on average MIN_VISITS of them enter a placement."""
        visits = int(0)
        rays = int(0)
        size = int(TOP_STACK)
        reference = int(root)
        mask = int(active)
        while True:
            if reference < 0:
                visits += 1
                rays += count_of(mask)
                visit(accel, surfaces, leaf_first(reference), mask, scratch, base)
            else:
                size = children(accel, scratch, base, reference, mask, size)
            mask, size = pop_packet(scratch, base, size, TOP_STACK)
            if mask == 0:
                break
            reference = reference_of(key_at(scratch.stacks, size))
        return rays >= MIN_VISITS * visits

    return walk


def make_start(any_hit: bool, place_ray: Any, worlds: bool, filtered: bool) -> Any:
    """Return descend and start, which bring a slot's ray to its next placement. Both return False after the last placement."""
    top_begin, top_step, top_pop = make_top_steps(any_hit)[2:]

    @wp.func
    def next_seen(accel: Instances, scratch: Scratch, slot: int, next: int) -> int:
        """Return `next`, or, if it is a placement that the ray does not see, what the ray visits next in the upper level."""
        column = slot_at(scratch.slots, SLOT_SIZE * (SLOTS + slot) + wp.static(SLOT["ray"]))
        while next < 0:
            if rays_seeing(accel, leaf_first(next), scratch, column / PACKET_SIZE - PLACED, 1 << column % PACKET_SIZE) != 0:
                break
            next = top_pop(accel, scratch, SLOTS + slot, number(scratch.packets, column + wp.static(FIELD["t"])))
        return next

    @wp.func
    def descend(accel: Instances, scratch: Scratch, slot: int, next: int) -> bool:
        """Walk the upper level to the ray's next placement, and change to its space."""
        top = SLOT_SIZE * (SLOTS + slot)
        if wp.static(filtered):
            next = next_seen(accel, scratch, slot, next)
        while next > 0:
            next = top_step(accel, scratch, SLOTS + slot)
            if wp.static(filtered):
                next = next_seen(accel, scratch, slot, next)
        if next == EMPTY:
            return False
        local = slot / LANES * PACKET_SIZE + slot % LANES
        placement = leaf_first(next)
        place_ray(accel, placement, scratch, slot_at(scratch.slots, top + wp.static(SLOT["ray"])), local)
        fill_slot(scratch, slot, local, 0, placement)
        return True

    @wp.func
    def start(accel: Instances, scratch: Scratch, slot: int, ray: int) -> bool:
        """Put ray `ray` = LANES * packet + lane into a slot."""
        column = (PLACED + ray / LANES) * PACKET_SIZE + ray % LANES
        root = int(0)
        if wp.static(worlds):
            root = bits(scratch.packets, column + wp.static(FIELD["root"]))
            if root < 0:
                fill_slot(scratch, SLOTS + slot, column, ~root, 0)
                return descend(accel, scratch, slot, top_step(accel, scratch, SLOTS + slot))
        return descend(accel, scratch, slot, top_begin(accel, scratch, SLOTS + slot, root, column))

    return descend, start


def make_turn(units: Units, any_hit: bool, take_hit: Any, descend: Any) -> Any:
    """Return turn, which visits the node or leaf of a slot's ray, and chooses the next one. It returns False if the ray is finished."""
    visit = make_visit(units, any_hit, None)
    top_pop = make_top_steps(any_hit).pop

    @wp.func
    def turn(accel: Instances, surfaces: Surfaces, scratch: Scratch, slot: int) -> bool:
        words = slot * SLOT_SIZE
        placement = slot_at(scratch.slots, words + wp.static(SLOT["placement"]))
        bottom = accel.bottoms[accel.placements[placement].bottom]
        next = visit(bottom, surfaces, scratch, slot)
        if next != EMPTY and next != DONE:
            prefetch_next(bottom, next)
            return True
        ray = slot_at(scratch.slots, words + SLOT_SIZE * SLOTS + wp.static(SLOT["ray"]))
        take_hit(accel, placement, scratch, ray, slot_at(scratch.slots, words + wp.static(SLOT["ray"])))
        if next == DONE:
            return False
        return descend(accel, scratch, slot, top_pop(accel, scratch, SLOTS + slot, number(scratch.packets, ray + wp.static(FIELD["t"]))))

    return turn


def make_top_interleaved(units: Units, any_hit: bool, worlds: bool) -> Any:
    """Return interleaved, which traces rays of PACKETS packets through the instances, one step of each ray in turn.

    The mask `waiting` has a bit for each ray to trace: bit LANES * packet + lane, of the packets behind the first PLACED ones."""
    place_ray, take_hit = make_changes(any_hit, far_pad(units.box))[2:]
    descend, start = make_start(any_hit, place_ray, worlds, units.filtered)
    turn = make_turn(units, any_hit, take_hit, descend)

    @wp.func
    def interleaved(accel: Instances, surfaces: Surfaces, scratch: Scratch, waiting: wp.uint64):
        live = int(0)
        todo = int(wp.static((1 << SLOTS) - 1))  # Slots that are free, or whose ray takes its next step.
        while todo != 0:
            while todo != 0:
                slot = lowest(todo)
                todo = todo & (todo - 1)
                goes_on = bool(False)
                if (live >> slot) & 1 != 0:
                    goes_on = turn(accel, surfaces, scratch, slot)
                while waiting != wp.uint64(0) and not goes_on:
                    goes_on = start(accel, scratch, slot, lowest_of_all(waiting))
                    waiting = waiting & (waiting - wp.uint64(1))
                live = wp.where(goes_on, live | (1 << slot), live & ~(1 << slot))
            todo = int(live)

    return interleaved


@cache
def make_kernel(units: Units, any_hit: bool, rays_struct: Any = RayArrays) -> Any:
    """Return the kernel of batch.make_kernel for instances."""
    worlds = rays_struct in (WorldRays, FilteredRays)
    walk, interleaved = make_top_walk(units, any_hit), make_top_interleaved(units, any_hit, worlds)
    set_up, store_roots = make_set_up(rays_struct), make_store_roots(rays_struct)
    rays_meeting = make_top_steps(any_hit).rays_meeting
    write = write_occluded if any_hit else write_hits
    out_type = wp.array(dtype=wp.bool) if any_hit else HitArrays

    @instances_kernel
    def trace(accel: Instances, surfaces: Surfaces, rays: rays_struct, out: out_type, scratch: Scratch, first: int, end: int):
        put_int(scratch.report, FAILED, 0)
        put_int(scratch.report, PAUSED, 0)
        put_int(scratch.report, ANY_REFUSED, 0)
        for block in range(first, end, wp.static(PACKETS * LANES)):
            single_rays = wp.uint64(0)
            packets = wp.min((end - block + LANES - 1) / LANES, PACKETS)
            for p in range(packets):
                base = PACKET_SIZE * (PLACED + p)
                count = wp.min(end - block - LANES * p, LANES)
                active = set_up(rays, block + LANES * p, count, wp.static(far_pad(units.box)), False, scratch, base)
                if wp.static(worlds):
                    active = store_roots(accel, rays, block + LANES * p, count, active, scratch, base)
                if wp.static(units.filtered):
                    store_filters(rays, block + LANES * p, count, scratch, p)
                store_bits(scratch.packets, base + ACTIVE, active)
                if bits(scratch.packets, base + REFUSED) != 0:
                    put_int(scratch.report, ANY_REFUSED, 1)
            for p in range(packets):
                base = PACKET_SIZE * (PLACED + p)
                active = bits(scratch.packets, base + ACTIVE)
                paused = slot_at(scratch.report, PAUSED)
                root = int(0)
                if wp.static(worlds) and active != 0:
                    root = bits(scratch.packets, base + wp.static(FIELD["root"]) + lowest(active))
                if active >= COHERENT and paused == 0:
                    coherent = walk(accel, surfaces, scratch, base, root, active - COHERENT)
                    count_walk(scratch, FAILED, coherent)
                else:
                    put_int(scratch.report, PAUSED, wp.max(paused - 1, 0))
                    active = active & wp.static(COHERENT - 1)
                    if root >= 0:
                        active = rays_meeting(accel, scratch, base, root, active)
                    single_rays = single_rays | (wp.uint64(active) << wp.uint64(LANES * p))
            interleaved(accel, surfaces, scratch, single_rays)
            for p in range(packets):
                write(out, block + LANES * p, wp.min(end - block - LANES * p, LANES), scratch, PACKET_SIZE * (PLACED + p))

    return trace
