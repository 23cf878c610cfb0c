"""Packets: sixteen rays side by side, for one CPU thread that has many rays to trace.

The functions are C++ (the `.h` files beside this one), for the CPU only. They compute what the scalar units compute, to the last
bit: a test holds the two together. This file has the layouts that they work on; C++ gets its numbers from here.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.native import source
from wrt.kernels.query import FARTHEST, LARGEST, LENGTHEN, LONGEST, SHORTEN, SHORTEST, HitArrays, RayArrays
from wrt.kernels.structs import NO_HIT, Primitive, size_of
from wrt.kernels.units.box import FAR_PAD, PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST
from wrt.kernels.units.triangle import CLAMP_ROUNDING, CLAMP_STEP, SLOWEST
from wrt.kernels.wide.lanes import CACHE_LINE
from wrt.kernels.wide.nodes import PLANES, first_reference, node_size
from wrt.kernels.wide.references import LEAF_BITS
from wrt.kernels.wide.traverse import STACK_SIZE

WIDTH = 8  # children of a node, and triangles of a row
LANES = 16  # rays of a packet
PRIM_ID_ROW = size_of(Primitive) // 4 - 1  # of the rows of a leaf that make a row of primitives
COHERENT = 1 << LANES  # what set_up adds to the mask of active rays if they have a beam

# A packet is a block of floats. It begins with a row of sixteen lanes for each number that a ray has. turned: the origin, in the
# order kx, ky, kz; axes: kx, ky, kz in AXIS_BITS each; near: where the near planes begin in a node; exclude: Ray.exclude_plus_one.
ROWS = ("origin_x", "origin_y", "origin_z", "inverse_x", "inverse_y", "inverse_z", "far_x", "far_y", "far_z", "t_min", "t",
        "direction_x", "direction_y", "direction_z", "turned_x", "turned_y", "turned_z", "shear_x", "shear_y", "shear_z",
        "axes", "u", "v", "prim_id", "scale", "near_x", "near_y", "near_z", "exclude")
ROW = {name: LANES * i for i, name in enumerate(ROWS)}  # where each row begins
AXIS_BITS = 2

# Then the beam: intervals that hold the origins and the reciprocals of all its rays. Each word is there for x, y and z: the origin
# that is closest to the near planes, and to the far planes; the reciprocal of the largest magnitude, and of the smallest; the same
# two for far planes; and which plane of a node is near (as a float). One word more: the lowest t_min. And two that are not the
# beam's. REFUSED: the mask of rays whose numbers a query refuses (wrt.accel.queries.rays); ACTIVE: what set_up says.
BEAM_WORDS = ("near_origin", "far_origin", "largest", "smallest", "far_largest", "far_smallest", "near_row", "t_min")
BEAM = {name: LANES * len(ROWS) + 3 * i for i, name in enumerate(BEAM_WORDS)}
REFUSED = BEAM["t_min"] + 1
ACTIVE = REFUSED + 1

# Then what `meets` finds: for each child of the root a row of where the rays enter it, inf where they do not.
ROOT_ENTRIES = LANES * (ACTIVE // LANES + 1)
PACKET_SIZE = ROOT_ENTRIES + WIDTH * LANES  # a multiple of 16: where the first row begins at a cache line, all rows do

# An entry of a packet's stack: its key (traverse.stack.key_of), of two words; then the mask of the rays that go there (ENTRY_RAYS);
# then nothing, so that an entry is moved at once. A packet has one entry more than a ray alone: the nearest child is one as well.
# The stack is where those of slots begin, which are not yet in use.
ENTRY, ENTRY_RAYS = 4, 2

# The stack of one ray is made of levels, one for each node on the way to where the ray is that has children still to come. A level
# holds eight keys, where the node's references begin (LEVEL_REFERENCES), and the mask of the children to come (LEVEL_LEFT). A key
# is the distance, whose last four bits are replaced by the child's number + 8: four bits less do not matter for an order. A child
# that is not met, or was taken, has all bits, which is a NaN. Any hit needs no order, and has no keys. The first level is empty.
LEVEL = 16
LEVEL_REFERENCES = WIDTH
LEVEL_LEFT = WIDTH + 1
KEY_MASK = 2 * WIDTH - 1
# A level is added for a node with two or more children that are met, for which a single ray's walk has an entry on its stack.
STACK_WORDS = LEVEL * (STACK_SIZE + 2)

# A slot is where one ray is under way. ray: its column in `packets`; next: the reference to go to; place: its last level.
SLOT_WORDS = ("ray", "next", "place")
SLOT = {name: i for i, name in enumerate(SLOT_WORDS)}
SLOT_SIZE = 4

LAYOUT = {
    "WIDTH": WIDTH, "LANES": LANES, "COHERENT": COHERENT, "AXIS_BITS": AXIS_BITS, "AXIS_MASK": (1 << AXIS_BITS) - 1,
    "REFUSED": REFUSED, "ROOT_ENTRIES": ROOT_ENTRIES, "ENTRY": ENTRY, "ENTRY_RAYS": ENTRY_RAYS, "LEAF_BITS": LEAF_BITS,
    "CACHE_LINE": CACHE_LINE, "LEVEL": LEVEL, "LEVEL_REFERENCES": LEVEL_REFERENCES, "LEVEL_LEFT": LEVEL_LEFT,
    "KEY_MASK": KEY_MASK, "NODE_SIZE": node_size(WIDTH, False), "REFERENCES": first_reference(WIDTH, False),
    "PRIM_ID_ROW": PRIM_ID_ROW, "NO_HIT": NO_HIT,
    "LARGEST": LARGEST, "FARTHEST": FARTHEST, "SHORTEST": SHORTEST, "LONGEST": LONGEST, "LENGTHEN": LENGTHEN, "SHORTEN": SHORTEN,
    "FAR_PAD": FAR_PAD, "PAD_EXTENT": PAD_EXTENT, "PAD_COORDINATE": PAD_COORDINATE, "PAD_SMALLEST": PAD_SMALLEST,
    "CLAMP_ROUNDING": CLAMP_ROUNDING, "CLAMP_STEP": CLAMP_STEP, "SLOWEST": SLOWEST,
    **{name.upper(): first for name, first in ROW.items()},
    **{name.upper(): i for i, name in enumerate(PLANES)},
    **{f"BEAM_{name.upper()}": first for name, first in BEAM.items()},
    **{f"SLOT_{name.upper()}": i for name, i in SLOT.items()},
}


@wp.struct
class Scratch:
    """What one thread works in. packets: PACKET_SIZE each; stacks: STACK_WORDS a slot, or before these one packet's; slots:
    SLOT_SIZE each, then three numbers of batch.make_kernel."""

    packets: wp.array(dtype=wp.float32)
    stacks: wp.array(dtype=wp.uint32)
    slots: wp.array(dtype=wp.int32)


# --- a packet, which begins at `base` ---------------------------------------------------------------------------------


@cache
def make_set_up(rays_struct: Any) -> Any:
    """set_up for RayArrays, or for a Queue, whose directions are taken as they are."""

    @wp.func_native(source("wide/packet_set_up.h", QUEUE=rays_struct is not RayArrays, **LAYOUT))
    def set_up(rays: rays_struct, first: int, count: int, pad: float, packet: wp.array(dtype=wp.float32), base: int) -> int:
        """Rays first .. first + count - 1; the mask of those that are not empty, and COHERENT. pad: nodes.far_pad."""

    return set_up


@cache
def make_children(any_hit: bool, row_size: int, lines: int) -> Any:
    """row_size: of a row of primitives; lines: cache lines that are called in of what a child leads to."""

    @wp.func_native(source("wide/packet_children.h", ANY_HIT=int(any_hit), ROW_SIZE=row_size, LINES=lines, **LAYOUT))
    def children(nodes: wp.array(dtype=wp.float32), primitives: wp.array(dtype=wp.float32), first: int, mask: int,
                 packet: wp.array(dtype=wp.float32), base: int, stacks: wp.array(dtype=wp.uint32), size: int) -> int:
        """Put the children of a node that rays of the mask meet on a stack of `size` entries, the nearest last or, for any hit, as
        they are in the node; the size it then has. Only with a beam."""

    return children


@wp.func_native(source("wide/packet_meets.h", **LAYOUT))
def meets(nodes: wp.array(dtype=wp.float32), first: int, mask: int, packet: wp.array(dtype=wp.float32), base: int) -> int:
    """The rays of the mask that meet a child of a node, the root; and ROOT_ENTRIES."""


@wp.func_native(source("wide/packet_reaching.h", **LAYOUT))
def reaching(t_entry: float, packet: wp.array(dtype=wp.float32), base: int) -> int:
    """The rays that reach so far."""


@wp.func_native(source("wide/packet_triangles.h", **LAYOUT))
def triangles(rows: wp.array(dtype=wp.float32), first: int, count: int, mask: int, any_hit: bool,
              packet: wp.array(dtype=wp.float32), base: int) -> int:
    """The first `count` triangles of a row against the rays of the mask; those that hit one. After any hit t is -inf."""


@wp.func_native(source("wide/packet_write_hits.h", **LAYOUT))
def write_hits(hits: HitArrays, first: int, count: int, packet: wp.array(dtype=wp.float32), base: int) -> None: ...


@wp.func_native(source("wide/packet_write_occluded.h", **LAYOUT))
def write_occluded(occluded: wp.array(dtype=wp.bool), first: int, count: int, packet: wp.array(dtype=wp.float32),
                   base: int) -> None: ...


@wp.func_native(f"wp::uint64 key; __builtin_memcpy(&key, stacks.data + {ENTRY} * i, sizeof(key)); return key;")
def key_at(stacks: wp.array(dtype=wp.uint32), i: int) -> wp.uint64:
    """The key of entry i of a packet's stack."""


@wp.func_native(f"return (int)stacks.data[{ENTRY} * i + {ENTRY_RAYS}];")
def rays_at(stacks: wp.array(dtype=wp.uint32), i: int) -> int:
    """The mask of the rays of entry i."""


# --- one ray of a packet, and its slot --------------------------------------------------------------------------------


class Steps(NamedTuple):
    """begin: put a ray into a slot, at the root's children; its stack begins at `bottom`. step: from a node to the next child, its
    own or one on the stack; pop: to one on the stack; of those that begin at or before `reach`, the ray's t. All give the reference
    that is next, or EMPTY where the ray is done."""

    begin: Any
    step: Any
    pop: Any


@cache
def make_steps(any_hit: bool) -> Steps:
    """The nearest child is next, or for any hit the last one."""

    @wp.func_native(source("wide/ray_begin.h", ANY_HIT=int(any_hit), **LAYOUT))
    def begin(nodes: wp.array(dtype=wp.float32), packet: wp.array(dtype=wp.float32), ray: int, stacks: wp.array(dtype=wp.uint32),
              bottom: int, slots: wp.array(dtype=wp.int32), slot: int) -> int: ...

    @wp.func_native(source("wide/ray_step.h", ANY_HIT=int(any_hit), **LAYOUT))
    def step(nodes: wp.array(dtype=wp.float32), packet: wp.array(dtype=wp.float32), stacks: wp.array(dtype=wp.uint32), bottom: int,
             slots: wp.array(dtype=wp.int32), slot: int) -> int: ...

    @wp.func_native(source("wide/ray_pop.h", ANY_HIT=int(any_hit), **LAYOUT))
    def pop(nodes: wp.array(dtype=wp.float32), reach: float, stacks: wp.array(dtype=wp.uint32), bottom: int,
            slots: wp.array(dtype=wp.int32), slot: int) -> int: ...

    return Steps(begin, step, pop)


@wp.func_native(source("wide/row_spheres.h", **LAYOUT))
def spheres_of(rows: wp.array(dtype=wp.float32), first: int, mask: int, n_triangles: int) -> int:
    """Those of a row's primitives in the mask that are no triangles."""


@cache
def make_ray_triangles(any_hit: bool, inlined: bool) -> Any:
    called = "" if inlined else "__attribute__((noinline))"

    @wp.func_native(source("wide/ray_triangles.h", ANY_HIT=int(any_hit), CALLED=called, **LAYOUT))
    def ray_triangles(rows: wp.array(dtype=wp.float32), first: int, mask: int, packet: wp.array(dtype=wp.float32),
                      ray: int) -> int:
        """The nearest of a row's triangles in the mask that one ray of a packet hits, in its column: its lane, or -1. For any hit
        0, whichever it is, and no u and v."""

    return ray_triangles


@wp.func_native("return __builtin_ctzll(mask);")
def lowest_of_all(mask: wp.uint64) -> int: ...


@wp.func_native("return __builtin_popcount(mask);")
def count_of(mask: int) -> int: ...


@wp.func_native("__builtin_memcpy(packet.data + (long long)i, &value, sizeof(value));")
def put_bits(packet: wp.array(dtype=wp.float32), i: int, value: int) -> None: ...


@wp.func_native("return slots.data[(long long)i];")
def slot_at(slots: wp.array(dtype=wp.int32), i: int) -> int: ...


@wp.func_native("slots.data[(long long)i] = value;")
def put_slot(slots: wp.array(dtype=wp.int32), i: int, value: int) -> None: ...
