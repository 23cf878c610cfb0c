"""Memory layouts of nodes, packets, stacks and slots, as constants for Python and C++; LAYOUT_H is the text of layout.h."""

import math
from typing import NamedTuple

from wrt.kernels.headers import constants
from wrt.kernels.query import FARTHEST, LARGEST, LENGTHEN, LONGEST, SHORTEN, SHORTEST
from wrt.kernels.structs import NO_HIT, Primitive, size_of
from wrt.kernels.units.box import FAR_PAD, PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST
from wrt.kernels.units.triangle import CLAMP_ROUNDING, CLAMP_STEP, SLOWEST
from wrt.kernels.wide.references import LEAF_BITS

CACHE_LINE = 16  # In floats.

# --- nodes (wide/nodes.py describes their layouts) --------------------------------------------------------------------

# Names of a node's planes, in order. The indices of the low and the high plane of an axis differ in the last bit.
PLANES = ("lo_x", "hi_x", "lo_y", "hi_y", "lo_z", "hi_z")
LO_X, HI_X, LO_Y, HI_Y, LO_Z, HI_Z = range(len(PLANES))

# A compressed node: the index of its word and of its first bytes, in floats; the bit fields of the word; mantissa bits of a float32.
WORD, FIRST_BYTES = 3, 4
EXPONENT_BITS = 8
EXIST_SHIFT = 3 * EXPONENT_BITS
MANTISSA_BITS = 23

# Entries of the stack in a traversal for one ray. The builder makes no tree that needs more (kernels.build.wide.collapse).
STACK_SIZE = 64


def first_reference(width: int, compressed: bool) -> int:
    """Return the index, in floats, of the first child's reference within a node."""
    return FIRST_BYTES + len(PLANES) * width // 4 if compressed else len(PLANES) * width


def node_size(width: int, compressed: bool) -> int:
    """Return the number of floats in a node."""
    return first_reference(width, compressed) + (1 if compressed else 2) * width


class NodeLayout(NamedTuple):
    """The layout of nodes with `width` children, plain or compressed."""

    width: int
    compressed: bool

    @property
    def references(self) -> int:
        return first_reference(self.width, self.compressed)

    @property
    def size(self) -> int:
        return node_size(self.width, self.compressed)

    @property
    def unit(self) -> int:
        """Number of primitives in the unit of a leaf's reference: a row of `width`, or 1 with compressed nodes, whose leaves share rows."""
        return 1 if self.compressed else self.width


# --- many rays at a time ----------------------------------------------------------------------------------------------

WIDTH = 8  # Number of children of a node, and of triangles in a row.
LANES = 16  # Number of rays in a packet.
PRIM_ID_ROW = size_of(Primitive) // 4 - 1  # Index of prim_id among the 4-byte values of a primitive.
ROW_SIZE = size_of(Primitive) // 4 * WIDTH  # Number of floats in a row of primitives.
# Bits that set_up adds to the mask of active rays: COHERENT if they have a beam, MIXED if it has no bounds on some axes.
COHERENT, MIXED = 1 << LANES, 2 << LANES
LINES = 5  # Number of cache lines to prefetch: a row of triangles has 5, a node 4. Prefetching 5 is faster than a branch.

# A packet is a block of floats. It begins with a vector of sixteen lanes for each field of a ray. The fields `turned` are the origin in
# the axis order kx, ky, kz. The field `axes` has kx, ky, kz, with AXIS_BITS each. The fields `near` are indices of near planes in a node.
# The field `margin` is only for any-hit rays and counts (packet.h: sure_hits). The field `root` is only for rays of several worlds
# (wide/instances.py) and for lists, where it has the indices of the rays.
FIELDS = ("origin_x", "origin_y", "origin_z", "inverse_x", "inverse_y", "inverse_z", "far_x", "far_y", "far_z", "t_min", "t",
          "direction_x", "direction_y", "direction_z", "turned_x", "turned_y", "turned_z", "shear_x", "shear_y", "shear_z",
          "axes", "u", "v", "prim_id", "scale", "near_x", "near_y", "near_z", "exclude", "margin", "root")
FIELD = {name: LANES * i for i, name in enumerate(FIELDS)}  # Index in a packet of each field's first lane.
AXIS_BITS = 2

# The goal of a traversal: find each ray's closest hit, find any hit, or list all hits (kernels.hit_lists). In place of u and v, a packet
# then has the number of listed hits, and a number that is not 0 if the ray touches triangles without crossing them.
FIND_CLOSEST, FIND_ANY, LIST_ALL = range(3)
LISTED, TOUCHED = FIELD["u"], FIELD["v"]

# After the fields comes the beam: intervals that contain the origins and the reciprocal directions of all rays. Each entry has three
# values, for x, y and z. Of all origins, near_origin is closest to the near planes, and far_origin to the far planes. Of all reciprocals,
# `largest` and `smallest` have the largest and the smallest magnitude. Multiplied by the far pad, they are far_largest and far_smallest.
# The index of the near plane in PLANES, as a float, is near_row. On an axis along which directions differ in sign, the beam's values are
# NaN, which narrow no interval. The lowest t_min of all rays is a single value. Two more words follow: REFUSED, the mask of invalid rays,
# which a query rejects (wrt.accel.queries.rays); and ACTIVE, the result of set_up.
BEAM_WORDS = ("near_origin", "far_origin", "largest", "smallest", "far_largest", "far_smallest", "near_row", "t_min")
BEAM = {name: LANES * len(FIELDS) + 3 * i for i, name in enumerate(BEAM_WORDS)}
REFUSED = BEAM["t_min"] + 1
ACTIVE = REFUSED + 1

# Then come the results of rays_meeting_root: for each child of the root, a vector of the rays' entry distances, inf for a miss.
ROOT_ENTRIES = LANES * (ACTIVE // LANES + 1)
PACKET_SIZE = ROOT_ENTRIES + WIDTH * LANES  # A multiple of 16, which keeps all vectors aligned to cache lines.

# An entry of a packet's stack has a key of two words (traverse.stack.key_of), the mask of the rays (ENTRY_RAYS), and a word of padding. It
# needs one entry more than the stack of one ray, because it also holds the nearest child. Packets and interleaved rays run one after the
# other, so their stacks share memory.
ENTRY, ENTRY_RAYS = 4, 2

# The stack of an interleaved ray is a list of levels: one for each ancestor of the present node that has pending children. A level holds
# eight keys, the index of the node's references (LEVEL_REFERENCES), and the mask of pending children (LEVEL_LEFT). A key is the entry
# distance, with its last four bits replaced by the child's index + 8; the order of children does not need these bits. If a child is not
# pending, all bits of its key are 1, which is a NaN. Any-hit rays need no order and have no keys. The first level ends the stack.
LEVEL = 16
LEVEL_REFERENCES = WIDTH
LEVEL_LEFT = WIDTH + 1
KEY_MASK = 2 * WIDTH - 1
# A level remains on the stack only for a node with two or more entered children. The traversal for one ray pushes an entry there, too.
STACK_WORDS = LEVEL * (STACK_SIZE + 2)

# A slot describes an interleaved ray: its column in `packets`, the next reference, the index of the last level of its stack, and the
# placement whose structure it walks (wide/instances.py).
SLOT_WORDS = ("ray", "next", "place", "placement")
SLOT = {name: i for i, name in enumerate(SLOT_WORDS)}
SLOT_SIZE = 4

# Numbers of sure_hits (packet.h): the factor of its margin; the least `margin` of a ray. If a component of the direction is not 0, and
# smaller than this fraction of the largest, the field `margin` is infinite.
MARGIN_FACTOR, LEAST_MARGIN, SMALLEST_COMPONENT = 2.0**-18, 2.0**-60, 2.0**-40

_NUMBERS = {
    "MARGIN_FACTOR": MARGIN_FACTOR, "LEAST_MARGIN": LEAST_MARGIN, "SMALLEST_COMPONENT": SMALLEST_COMPONENT,
    "WIDTH": WIDTH, "LANES": LANES, "COHERENT": COHERENT, "MIXED": MIXED, "AXIS_BITS": AXIS_BITS, "AXIS_MASK": (1 << AXIS_BITS) - 1,
    "REFUSED": REFUSED, "ROOT_ENTRIES": ROOT_ENTRIES, "PACKET_SIZE": PACKET_SIZE, "ENTRY": ENTRY, "ENTRY_RAYS": ENTRY_RAYS,
    "LEAF_BITS": LEAF_BITS, "CACHE_LINE": CACHE_LINE, "LINES": LINES, "LEVEL": LEVEL, "LEVEL_REFERENCES": LEVEL_REFERENCES,
    "LEVEL_LEFT": LEVEL_LEFT, "KEY_MASK": KEY_MASK, "STACK_WORDS": STACK_WORDS, "SLOT_SIZE": SLOT_SIZE,
    "NODE_SIZE": node_size(WIDTH, False), "REFERENCES": first_reference(WIDTH, False),
    "LISTED": LISTED, "TOUCHED": TOUCHED, "FIND_CLOSEST": FIND_CLOSEST, "FIND_ANY": FIND_ANY, "LIST_ALL": LIST_ALL,
    "PRIM_ID_ROW": PRIM_ID_ROW, "ROW_SIZE": ROW_SIZE, "NO_HIT": NO_HIT,
    "LARGEST": LARGEST, "FARTHEST": FARTHEST, "SHORTEST": SHORTEST, "LONGEST": LONGEST, "LENGTHEN": LENGTHEN, "SHORTEN": SHORTEN,
    "LENGTHEN_EXPONENT": math.frexp(LENGTHEN)[1] - 1,
    **{name.upper(): first for name, first in FIELD.items()},
    **{name.upper(): i for i, name in enumerate(PLANES)},
    **{f"BEAM_{name.upper()}": first for name, first in BEAM.items()},
    **{f"SLOT_{name.upper()}": i for name, i in SLOT.items()},
}
_BOUNDS = {"FAR_PAD": FAR_PAD, "PAD_EXTENT": PAD_EXTENT, "PAD_COORDINATE": PAD_COORDINATE, "PAD_SMALLEST": PAD_SMALLEST,
           "CLAMP_ROUNDING": CLAMP_ROUNDING, "CLAMP_STEP": CLAMP_STEP, "SLOWEST": SLOWEST}
LAYOUT_H = constants(_NUMBERS) + constants(_BOUNDS, "Bounds")
