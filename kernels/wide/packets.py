"""Packets and interleaved rays: what kernels of one CPU thread call. Each function here is a call of C++ (packet.h, set_up.h,
interleaved.h).

They compute what the scalar units compute, to the last bit: a test holds the two together. A packet is named by where it begins in
Scratch.packets (`base`), a ray by its column there (`ray`: base + lane).
"""

from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from wrt.kernels.headers import with_headers
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import Primitive, kernel
from wrt.kernels.wide.layout import ENTRY, ENTRY_RAYS, LAYOUT_H, SLOT_SIZE, STACK_WORDS
from wrt.kernels.wide.traverse import make_struct

WideBvh = make_struct(Primitive)
HEADERS = with_headers("wide/set_up.h", "wide/interleaved.h", layout=LAYOUT_H)

if TYPE_CHECKING:  # as in structs
    from typing import no_type_check as packet_kernel
else:
    def packet_kernel(function):
        """A kernel that may call the functions of this file."""
        return kernel(function, extra_build_options=HEADERS)


FAILED, PAUSED, ANY_REFUSED = (wp.constant(place) for place in range(3))
REPORT_SIZE = 3


@wp.struct
class Scratch:
    """What one thread works in. packets: PACKET_SIZE each; stacks: STACK_WORDS a slot, or before these one packet's; slots:
    SLOT_SIZE each.

    report: what batch.make_kernel counts in a launch and leaves behind it. At FAILED: packets in a row that fell apart; PAUSED:
    packets until one is tried again; ANY_REFUSED: 1 where a query refuses one of the rays, which the host reads.
    """

    packets: wp.array(dtype=wp.float32)
    stacks: wp.array(dtype=wp.uint32)
    slots: wp.array(dtype=wp.int32)
    report: wp.array(dtype=wp.int32)


def flag(value: bool) -> str:
    """A template's argument."""
    return "true" if value else "false"


# --- a packet ---------------------------------------------------------------------------------------------------------


@cache
def make_set_up(rays_struct: Any) -> Any:
    """set_up for RayArrays, or for RenderRays, whose directions are taken as they are."""
    plain = rays_struct is RayArrays
    excludes = "nullptr" if plain else "rays.exclude.data + first"

    @wp.func_native(f"""
    return wrt::set_up<{flag(plain)}>(wrt::pointers_to(rays, first, {excludes}), count, pad, scratch.packets.data + base);
    """)
    def set_up(rays: rays_struct, first: int, count: int, pad: float, scratch: Scratch, base: int) -> int:
        """Set up rays first .. first + count - 1; return the mask of those that are not empty, and COHERENT if they have a beam.
        pad: nodes.far_pad."""

    return set_up


@cache
def make_children(any_hit: bool) -> Any:
    @wp.func_native(f"""
    return wrt::children<{flag(any_hit)}>(accel.nodes.data, accel.primitives.data, scratch.packets.data + base, reference, mask,
                                          scratch.stacks.data, size);
    """)
    def children(accel: WideBvh, scratch: Scratch, base: int, reference: int, mask: int, size: int) -> int:
        """Put the children of a node that rays of the mask meet on a stack of `size` entries, the nearest last or, for any hit, as
        they are in the node; return the size it then has. Only with a beam."""

    return children


@wp.func_native("return wrt::meets(accel.nodes.data, mask, scratch.packets.data + base);")
def meets(accel: WideBvh, scratch: Scratch, base: int, mask: int) -> int:
    """Return the rays of the mask that meet a child of the root; write ROOT_ENTRIES."""


@wp.func_native("return wrt::reaching(t_entry, scratch.packets.data + base);")
def reaching(t_entry: float, scratch: Scratch, base: int) -> int:
    """Return the mask of the rays that reach so far."""


@cache
def make_triangles(any_hit: bool) -> Any:
    @wp.func_native(f"""
    return wrt::triangles<{flag(any_hit)}>(accel.primitives.data + first, count, mask, scratch.packets.data + base);
    """)
    def triangles(accel: WideBvh, first: int, count: int, mask: int, scratch: Scratch, base: int) -> int:
        """Test the first `count` triangles of a row against the rays of the mask; return those that hit one. After any hit t is
        -inf."""

    return triangles


@wp.func_native("wrt::write_hits(hits, first, count, scratch.packets.data + base);")
def write_hits(hits: HitArrays, first: int, count: int, scratch: Scratch, base: int) -> None: ...


@wp.func_native("wrt::write_occluded(occluded.data + first, count, scratch.packets.data + base);")
def write_occluded(occluded: wp.array(dtype=wp.bool), first: int, count: int, scratch: Scratch, base: int) -> None: ...


@wp.func_native(f"return wrt::load<wp::uint64>(stacks.data + {ENTRY} * i);")
def key_at(stacks: wp.array(dtype=wp.uint32), i: int) -> wp.uint64:
    """The key of entry i of a packet's stack."""


@wp.func_native(f"return (int)stacks.data[{ENTRY} * i + {ENTRY_RAYS}];")
def rays_at(stacks: wp.array(dtype=wp.uint32), i: int) -> int:
    """The mask of the rays of entry i."""


# --- one ray of a packet, and its slot --------------------------------------------------------------------------------


class Steps(NamedTuple):
    """begin: put a ray into a slot, at the root's children; step: from a node to the next child, its own or one on the stack; pop:
    to one on the stack; of those that begin at or before `reach`, the ray's t. All return the reference that is next, or EMPTY
    where the ray is done. The nearest child is next, or for any hit the last one."""

    begin: Any
    step: Any
    pop: Any


@cache
def make_steps(any_hit: bool) -> Steps:
    slot = f"scratch.stacks.data, {STACK_WORDS} * slot, scratch.slots.data + {SLOT_SIZE} * slot"

    @wp.func_native(f"return wrt::begin<{flag(any_hit)}>(accel.nodes.data, scratch.packets.data, ray, {slot});")
    def begin(accel: WideBvh, scratch: Scratch, slot: int, ray: int) -> int: ...

    @wp.func_native(f"return wrt::step<{flag(any_hit)}>(accel.nodes.data, scratch.packets.data, {slot});")
    def step(accel: WideBvh, scratch: Scratch, slot: int) -> int: ...

    @wp.func_native(f"return wrt::pop<{flag(any_hit)}>(accel.nodes.data, reach, {slot});")
    def pop(accel: WideBvh, scratch: Scratch, slot: int, reach: float) -> int: ...

    return Steps(begin, step, pop)


@wp.func_native("return mask & wrt::spheres_of(accel.primitives.data + first, n_triangles);")
def spheres_of(accel: WideBvh, first: int, mask: int, n_triangles: int) -> int:
    """Return those of a row's primitives in the mask that are no triangles."""


@cache
def make_ray_triangles(any_hit: bool, inlined: bool) -> Any:
    name = "ray_triangles_here" if inlined else "ray_triangles"

    @wp.func_native(f"return wrt::{name}<{flag(any_hit)}>(accel.primitives.data + first, mask, scratch.packets.data + ray);")
    def ray_triangles(accel: WideBvh, first: int, mask: int, scratch: Scratch, ray: int) -> int:
        """Put the nearest of a row's triangles in the mask that one ray of a packet hits into its column; return its lane, or -1.
        For any hit return 0, whichever it is, and no u and v."""

    return ray_triangles


@wp.func_native("wrt::prefetch(accel.nodes.data, accel.primitives.data, reference);")
def prefetch_next(accel: WideBvh, reference: int) -> None:
    """Prefetch the first cache lines of the node or the leaf that a reference points to."""


@wp.func_native("return __builtin_ctzll(mask);")
def lowest_of_all(mask: wp.uint64) -> int: ...


@wp.func_native("return __builtin_popcount(mask);")
def count_of(mask: int) -> int: ...


@wp.func_native("wrt::store(packet.data + (long long)i, value);")
def put_bits(packet: wp.array(dtype=wp.float32), i: int, value: int) -> None: ...


@wp.func_native("return slots.data[(long long)i];")
def slot_at(slots: wp.array(dtype=wp.int32), i: int) -> int: ...


@wp.func_native("slots.data[(long long)i] = value;")
def put_slot(slots: wp.array(dtype=wp.int32), i: int, value: int) -> None: ...
