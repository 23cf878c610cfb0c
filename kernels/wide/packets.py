"""Packets and interleaved rays, for kernels of one CPU thread: each function calls C++ (packet.h, set_up.h, interleaved.h).

The results have the bits of the box and triangle units (tests/kernels/wide/test_packets.py). The argument `base` is the index in
Scratch.packets where a packet begins; `ray` is the index of a ray's column, base + lane. A beam bounds all rays of a packet
(layout.BEAM)."""

from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from wrt.kernels.headers import with_headers
from wrt.kernels.hit_lists import TOUCHES, HitLists, sort_and_trim
from wrt.kernels.query import HitArrays, RenderRays
from wrt.kernels.structs import Primitive, kernel
from wrt.kernels.wide.lanes import CHECK_MASK, bits
from wrt.kernels.wide.layout import ENTRY, ENTRY_RAYS, LAYOUT_H, LISTED, SLOT_SIZE, STACK_WORDS, TOUCHED
from wrt.kernels.wide.traverse import make_struct

WideBvh = make_struct(Primitive)
HEADERS = with_headers("wide/set_up.h", "wide/interleaved.h", layout=LAYOUT_H)

if TYPE_CHECKING:  # type checkers skip device code (structs.py)
    from typing import no_type_check as packet_kernel
else:
    def packet_kernel(function):
        """Make a kernel that can call the functions of this file."""
        return kernel(function, extra_build_options=HEADERS)


# Indices of Scratch.report: packets that failed in succession; packets to interleave before the next is walked; both for packets whose
# directions differ in sign; 1 if a ray was invalid.
FAILED, PAUSED, MIXED_FAILED, MIXED_PAUSED, ANY_REFUSED = (wp.constant(place) for place in range(5))
REPORT_SIZE = 5


@wp.struct
class Scratch:
    """The working memory of one thread."""

    packets: wp.array(dtype=wp.float32)  # PACKET_SIZE floats per packet.
    stacks: wp.array(dtype=wp.uint32)  # STACK_WORDS words per slot; during a packet's walk, the packet's stack.
    slots: wp.array(dtype=wp.int32)  # SLOT_SIZE words per slot.
    report: wp.array(dtype=wp.int32)  # REPORT_SIZE counts, which a launch sets to 0 first.


def flag(value: bool) -> str:
    """Return a bool as a C++ template argument."""
    return "true" if value else "false"


# --- a packet ---------------------------------------------------------------------------------------------------------


@cache
def make_set_up(rays_struct: Any, any_hit: bool = False) -> Any:
    """Return set_up for rays_struct: RayArrays, WorldRays, or RenderRays, whose directions it does not scale.

    any_hit: set up the field `margin`, too; and the walk accepts packets whose directions differ in sign (MIXED)."""
    plain = rays_struct is not RenderRays
    excludes = "nullptr" if plain else "rays.exclude.data + first"

    @wp.func_native(f"""
    return wrt::set_up<{flag(plain)}, {flag(any_hit)}>(wrt::pointers_to(rays, first, {excludes}), count, pad, mixes,
                                                       scratch.packets.data + base);
    """)
    def set_up(rays: rays_struct, first: int, count: int, pad: float, mixes: bool, scratch: Scratch, base: int) -> int:
        """Set up rays first .. first + count - 1. Return the mask of rays whose segments are not empty, plus COHERENT or MIXED.

        The factor `pad` is nodes.far_pad. mixes: also store the beam of a MIXED packet."""

    return set_up


@cache
def make_children(any_hit: bool, mixed: bool = False) -> Any:
    @wp.func_native(f"""
    return wrt::children<{flag(any_hit)}, {flag(mixed)}>(accel.nodes.data, accel.primitives.data, scratch.packets.data + base, reference,
                                          mask, scratch.stacks.data, size);
    """)
    def children(accel: WideBvh, scratch: Scratch, base: int, reference: int, mask: int, size: int) -> int:
        """Push the children of node `reference` that rays of the mask enter onto a stack of `size` entries; return the new size.

        The nearest child is on top. For any-hit rays, the node's last entered child is on top. The packet must have a beam.
        mixed: the beam may have no bounds on some axes."""

    return children


@wp.func_native("return wrt::rays_meeting_root(accel.nodes.data, mask, scratch.packets.data + base);")
def rays_meeting_root(accel: WideBvh, scratch: Scratch, base: int, mask: int) -> int:
    """Return the mask of the rays in `mask` that enter a child of the root; write their entry distances to ROOT_ENTRIES."""


@wp.func_native("return wrt::rays_reaching(t_entry, scratch.packets.data + base);")
def rays_reaching(t_entry: float, scratch: Scratch, base: int) -> int:
    """Return the mask of the packet's rays whose t (best hit so far, or t_max) is at least t_entry."""


@cache
def make_triangles(goal: int) -> Any:
    @wp.func_native(f"""
    return wrt::triangles<{int(goal)}>(accel.primitives.data + first, count, mask, scratch.packets.data + base);
    """)
    def triangles(accel: WideBvh, first: int, count: int, mask: int, scratch: Scratch, base: int) -> int:
        """Test the first `count` triangles of a row against the rays of the mask; return the mask of rays that hit a triangle.

        goal FIND_ANY: t of rays that hit a triangle becomes -inf."""

    return triangles


@wp.func_native("wrt::triangles<wrt::LIST_ALL>(accel.primitives.data + first, count, mask, scratch.packets.data + base, lists);")
def list_triangles(accel: WideBvh, first: int, count: int, mask: int, lists: HitLists, scratch: Scratch, base: int) -> None:
    """List all hits of the first `count` triangles of a row by the rays of the mask."""


@wp.func_native("wrt::keep_best(scratch.packets.data + base, (float*)scratch.slots.data);")
def keep_best(scratch: Scratch, base: int) -> None:
    """Keep the best hits of all rays of a packet in Scratch.slots, which only interleaved rays use."""


@wp.func_native("wrt::restore_best(scratch.packets.data + base, (float*)scratch.slots.data, lane);")
def restore_best(scratch: Scratch, base: int, lane: int) -> None:
    """Give one ray of the packet the best hit that keep_best kept."""


@wp.func_native("wrt::write_hits(hits, first, count, scratch.packets.data + base);")
def write_hits(hits: HitArrays, first: int, count: int, scratch: Scratch, base: int) -> None: ...


@wp.func_native("wrt::write_occluded(occluded.data + first, count, scratch.packets.data + base);")
def write_occluded(occluded: wp.array(dtype=wp.bool), first: int, count: int, scratch: Scratch, base: int) -> None: ...


@wp.func_native("wrt::begin_lists(first, scratch.packets.data + base);")
def begin_lists(first: int, scratch: Scratch, base: int) -> None:
    """Make the lists of a packet's rays empty; first: index of its first ray in HitLists."""


@wp.func
def write_lists(lists: HitLists, first: int, count: int, scratch: Scratch, base: int):
    """Sort the lists of `count` rays that have room for all hits, and store HitLists.count."""
    for j in range(count):
        n = bits(scratch.packets, base + j + LISTED)
        if n == 0 and bits(scratch.packets, base + j + TOUCHED) != 0:
            n = TOUCHES
        row = lists.first[first + j]
        if n > 1 and n <= lists.first[first + j + 1] - row:
            n = sort_and_trim(lists.rows, row, n, lists.limit)
        lists.count[first + j] = n


@wp.func_native(f"return wrt::load<wp::uint64>(stacks.data + {ENTRY} * i);")
def key_at(stacks: wp.array(dtype=wp.uint32), i: int) -> wp.uint64:
    """Return the key of entry i of a packet's stack."""


@wp.func_native(f"return (int)stacks.data[{ENTRY} * i + {ENTRY_RAYS}];")
def rays_at(stacks: wp.array(dtype=wp.uint32), i: int) -> int:
    """Return the mask of the rays in entry i of a packet's stack."""


# --- one ray of a packet, and its slot --------------------------------------------------------------------------------


class Steps(NamedTuple):
    """Functions for the steps of an interleaved ray. Each returns the next reference, or EMPTY if the ray is finished.

    The next child is the nearest pending child. For any-hit rays, it is the last pending child."""

    begin: Any  # Put a ray into a slot, and choose the first child of the root.
    step: Any  # Visit a node, and choose the next child: of this node or from the stack.
    pop: Any  # Choose a child from the stack that begins at or before `reach`, the ray's t.


@cache
def make_steps(any_hit: bool) -> Steps:
    slot = f"scratch.stacks.data, {STACK_WORDS} * slot, scratch.slots.data + {SLOT_SIZE} * slot"

    @wp.func_native(f"return wrt::begin<{flag(any_hit)}>(accel.nodes.data, 0, scratch.packets.data, ray, {slot});")
    def begin(accel: WideBvh, scratch: Scratch, slot: int, ray: int) -> int: ...

    @wp.func_native(f"return wrt::step<{flag(any_hit)}>(accel.nodes.data, scratch.packets.data, {slot});")
    def step(accel: WideBvh, scratch: Scratch, slot: int) -> int: ...

    @wp.func_native(f"return wrt::pop<{flag(any_hit)}>(accel.nodes.data, reach, {slot});")
    def pop(accel: WideBvh, scratch: Scratch, slot: int, reach: float) -> int: ...

    return Steps(begin, step, pop)


@wp.func_native("return mask & wrt::spheres_of(accel.primitives.data + first, n_triangles);")
def spheres_of(accel: WideBvh, first: int, mask: int, n_triangles: int) -> int:
    """Return the mask of the spheres among the primitives of a row that are in `mask`."""


@cache
def make_ray_triangles(goal: int, inlined: bool) -> Any:
    name = "ray_triangles_here" if inlined else "ray_triangles"

    @wp.func_native(f"return wrt::{name}<{int(goal)}>(accel.primitives.data + first, mask, scratch.packets.data + ray);")
    def ray_triangles(accel: WideBvh, first: int, mask: int, scratch: Scratch, ray: int) -> int:
        """Test the triangles in the mask of a row. Store the nearest hit in the ray's column; return the triangle's lane, or -1 on a miss.

        goal FIND_ANY: the result tells only hit (0) or miss (-1), and u and v are not set."""

    return ray_triangles


@cache
def make_list_ray_triangles(inlined: bool) -> Any:
    name = "ray_triangles_here" if inlined else "ray_triangles"

    @wp.func_native(f"wrt::{name}<wrt::LIST_ALL>(accel.primitives.data + first, mask, scratch.packets.data + ray, lists);")
    def list_ray_triangles(accel: WideBvh, first: int, mask: int, lists: HitLists, scratch: Scratch, ray: int) -> None:
        """List all hits of the triangles in the mask of a row by one ray."""

    return list_ray_triangles


@wp.func_native("wrt::prefetch(accel.nodes.data, accel.primitives.data, reference);")
def prefetch_next(accel: WideBvh, reference: int) -> None:
    """Prefetch the first cache lines of the node or leaf that `reference` points to."""


@wp.func_native(f"{CHECK_MASK}    return __builtin_ctzll(mask);")
def lowest_of_all(mask: wp.uint64) -> int: ...


@wp.func_native("return __builtin_popcount(mask);")
def count_of(mask: int) -> int: ...


@wp.func_native("wrt::store(packet.data + (long long)i, value);")
def store_bits(packet: wp.array(dtype=wp.float32), i: int, value: int) -> None: ...


@wp.func_native("return slots.data[(long long)i];")
def slot_at(slots: wp.array(dtype=wp.int32), i: int) -> int: ...
