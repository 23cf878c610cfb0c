"""Constants of nodes, packets, stacks and slots, for Python and for C++ (`LAYOUT_H` is the text of layout.h)."""

from typing import NamedTuple

from wrt.kernels.headers import constants
from wrt.kernels.query import FARTHEST, LARGEST, LENGTHEN, LONGEST, SHORTEN, SHORTEST
from wrt.kernels.structs import NO_HIT, Primitive, size_of
from wrt.kernels.units.box import FAR_PAD, PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST
from wrt.kernels.units.triangle import CLAMP_ROUNDING, CLAMP_STEP, SLOWEST
from wrt.kernels.wide.references import LEAF_BITS

CACHE_LINE = 16  # In floats.

# --- nodes (their layouts are described in wide/nodes.py) -------------------------------------------------------------

# The planes' rows. The indices of an axis's low and high plane differ in the last bit.
PLANES = ("lo_x", "hi_x", "lo_y", "hi_y", "lo_z", "hi_z")
LO_X, HI_X, LO_Y, HI_Y, LO_Z, HI_Z = range(len(PLANES))

# A compressed node: the places of its word and its bytes, the parts of the word, and the fraction's bits in a float32.
WORD, FIRST_BYTES = 3, 4
EXPONENT_BITS = 8
EXIST_SHIFT = 3 * EXPONENT_BITS
MANTISSA_BITS = 23

# The builder limits the stack of a single ray's walk to so many entries (kernels.build.wide.collapse).
STACK_SIZE = 64


def first_reference(width: int, compressed: bool) -> int:
    """Return the place of the children's references in a node."""
    return FIRST_BYTES + len(PLANES) * width // 4 if compressed else len(PLANES) * width


def node_size(width: int, compressed: bool) -> int:
    """Return the number of floats in a node."""
    return first_reference(width, compressed) + (1 if compressed else 2) * width


class NodeLayout(NamedTuple):
    """Nodes of `width` children, plain or compressed."""

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
        """Number of primitives that a leaf's reference counts in: a row, or 1 if leaves follow each other without a gap."""
        return 1 if self.compressed else self.width


# --- many rays at a time ----------------------------------------------------------------------------------------------

WIDTH = 8  # Children of a node, and triangles of a row.
LANES = 16  # Rays of a packet.
PRIM_ID_ROW = size_of(Primitive) // 4 - 1  # Among the values of a row of primitives.
ROW_SIZE = size_of(Primitive) // 4 * WIDTH  # Floats in a row of primitives.
COHERENT = 1 << LANES  # set_up adds it to the mask of active rays if they have a beam.
LINES = 5  # Prefetched cache lines. A row of triangles has 5, a node 4, and a branch would cost more.

# A packet is a block of floats. It begins with a vector of sixteen lanes for each field of a ray. The field `turned` is the origin in the
# order kx, ky, kz. The field `axes` has kx, ky, kz in AXIS_BITS each, and `near` the place of the near planes in a node.
FIELDS = ("origin_x", "origin_y", "origin_z", "inverse_x", "inverse_y", "inverse_z", "far_x", "far_y", "far_z", "t_min", "t",
          "direction_x", "direction_y", "direction_z", "turned_x", "turned_y", "turned_z", "shear_x", "shear_y", "shear_z",
          "axes", "u", "v", "prim_id", "scale", "near_x", "near_y", "near_z", "exclude")
FIELD = {name: LANES * i for i, name in enumerate(FIELDS)}  # Places of the fields in a packet.
AXIS_BITS = 2

# Then follows the beam: intervals that hold the origins and reciprocals of all its rays. Each word has values for x, y and z. The
# first two are the origins closest to the near and to the far planes. The next are the reciprocals of the largest and the smallest
# magnitude, and the same two for far planes. The next tells which plane of a node is near, as a float. The last is the lowest t_min
# of all rays. Two words more are not the beam's. REFUSED is the mask of rays that a query refuses (wrt.accel.queries.rays).
# ACTIVE is the result of set_up.
BEAM_WORDS = ("near_origin", "far_origin", "largest", "smallest", "far_largest", "far_smallest", "near_row", "t_min")
BEAM = {name: LANES * len(FIELDS) + 3 * i for i, name in enumerate(BEAM_WORDS)}
REFUSED = BEAM["t_min"] + 1
ACTIVE = REFUSED + 1

# Then follows what rays_meeting_root finds: for each child of the root, a vector of the rays' entry distances, inf for a miss.
ROOT_ENTRIES = LANES * (ACTIVE // LANES + 1)
PACKET_SIZE = ROOT_ENTRIES + WIDTH * LANES  # A multiple of 16, which keeps all vectors aligned to cache lines.

# An entry of a packet's stack has its key (traverse.stack.key_of), of two words, then the mask of its rays (ENTRY_RAYS), and a word
# of padding. A packet's stack needs one entry more than a ray's: it also holds the nearest child. It shares the memory of the
# slots' stacks, which are used later.
ENTRY, ENTRY_RAYS = 4, 2

# A ray's stack is a list of levels, one for each node above the ray's place that has children left. A level holds eight keys, the
# place of the node's references (LEVEL_REFERENCES), and the mask of the children left (LEVEL_LEFT). A key is the distance with its
# last four bits replaced by the child's index + 8; an order does not need these bits. A child that was missed or taken has a key of
# all ones, which is a NaN. Any hit needs no order, and has no keys. The first level is empty.
LEVEL = 16
LEVEL_REFERENCES = WIDTH
LEVEL_LEFT = WIDTH + 1
KEY_MASK = 2 * WIDTH - 1
# A level is pushed for a node with two or more entered children. A single ray's walk pushes an entry there, too.
STACK_WORDS = LEVEL * (STACK_SIZE + 2)

# A slot holds an interleaved ray: its column in `packets`, the next reference, and the place of its last level.
SLOT_WORDS = ("ray", "next", "place")
SLOT = {name: i for i, name in enumerate(SLOT_WORDS)}
SLOT_SIZE = 4

_NUMBERS = {
    "WIDTH": WIDTH, "LANES": LANES, "COHERENT": COHERENT, "AXIS_BITS": AXIS_BITS, "AXIS_MASK": (1 << AXIS_BITS) - 1,
    "REFUSED": REFUSED, "ROOT_ENTRIES": ROOT_ENTRIES, "PACKET_SIZE": PACKET_SIZE, "ENTRY": ENTRY, "ENTRY_RAYS": ENTRY_RAYS,
    "LEAF_BITS": LEAF_BITS, "CACHE_LINE": CACHE_LINE, "LINES": LINES, "LEVEL": LEVEL, "LEVEL_REFERENCES": LEVEL_REFERENCES,
    "LEVEL_LEFT": LEVEL_LEFT, "KEY_MASK": KEY_MASK, "STACK_WORDS": STACK_WORDS, "SLOT_SIZE": SLOT_SIZE,
    "NODE_SIZE": node_size(WIDTH, False), "REFERENCES": first_reference(WIDTH, False),
    "PRIM_ID_ROW": PRIM_ID_ROW, "ROW_SIZE": ROW_SIZE, "NO_HIT": NO_HIT,
    "LARGEST": LARGEST, "FARTHEST": FARTHEST, "SHORTEST": SHORTEST, "LONGEST": LONGEST, "LENGTHEN": LENGTHEN, "SHORTEN": SHORTEN,
    **{name.upper(): first for name, first in FIELD.items()},
    **{name.upper(): i for i, name in enumerate(PLANES)},
    **{f"BEAM_{name.upper()}": first for name, first in BEAM.items()},
    **{f"SLOT_{name.upper()}": i for name, i in SLOT.items()},
}
_BOUNDS = {"FAR_PAD": FAR_PAD, "PAD_EXTENT": PAD_EXTENT, "PAD_COORDINATE": PAD_COORDINATE, "PAD_SMALLEST": PAD_SMALLEST,
           "CLAMP_ROUNDING": CLAMP_ROUNDING, "CLAMP_STEP": CLAMP_STEP, "SLOWEST": SLOWEST}
LAYOUT_H = constants(_NUMBERS) + constants(_BOUNDS, "Bounds")
