"""Numbers of nodes, packets, stacks and slots, for Python and for C++ (`LAYOUT_H` is the text of layout.h)."""

from typing import NamedTuple

from wrt.kernels.headers import constants
from wrt.kernels.query import FARTHEST, LARGEST, LENGTHEN, LONGEST, SHORTEN, SHORTEST
from wrt.kernels.structs import NO_HIT, Primitive, size_of
from wrt.kernels.units.box import FAR_PAD, PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST
from wrt.kernels.units.triangle import CLAMP_ROUNDING, CLAMP_STEP, SLOWEST
from wrt.kernels.wide.references import LEAF_BITS

CACHE_LINE = 16  # float32

# --- nodes (their layouts are described in wide/nodes.py) -------------------------------------------------------------

# The rows of planes. A low plane and the high plane of the same axis differ in the last bit of their numbers.
PLANES = ("lo_x", "hi_x", "lo_y", "hi_y", "lo_z", "hi_z")
LO_X, HI_X, LO_Y, HI_Y, LO_Z, HI_Z = range(len(PLANES))

# A compressed node: where its word and its bytes begin; what is in the word; and the fraction's bits in a float32.
WORD, FIRST_BYTES = 3, 4
EXPONENT_BITS = 8
EXIST_SHIFT = 3 * EXPONENT_BITS
MANTISSA_BITS = 23

# The builder lets no walk of one ray have more entries on its stack than this (kernels.build.wide.collapse).
STACK_SIZE = 64


def first_reference(width: int, compressed: bool) -> int:
    """Return where in a node the references of its children begin."""
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
        """Number of primitives in which references to leaves count: a row, or one where leaves follow each other without a gap."""
        return 1 if self.compressed else self.width


# --- many rays at a time ----------------------------------------------------------------------------------------------

WIDTH = 8  # children of a node, and triangles of a row
LANES = 16  # rays of a packet
PRIM_ID_ROW = size_of(Primitive) // 4 - 1  # of the rows of a leaf that make a row of primitives
ROW_SIZE = size_of(Primitive) // 4 * WIDTH  # floats in a row of primitives
COHERENT = 1 << LANES  # what set_up adds to the mask of active rays if they have a beam
LINES = 5  # cache lines that are prefetched: a row of triangles has 5, a node 4, and a branch would cost more

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
# beam's. REFUSED: the mask of rays whose numbers a query refuses (wrt.accel.queries.rays); ACTIVE: what set_up returns.
BEAM_WORDS = ("near_origin", "far_origin", "largest", "smallest", "far_largest", "far_smallest", "near_row", "t_min")
BEAM = {name: LANES * len(ROWS) + 3 * i for i, name in enumerate(BEAM_WORDS)}
REFUSED = BEAM["t_min"] + 1
ACTIVE = REFUSED + 1

# Then what `meets` finds: for each child of the root a row of where the rays enter it, inf where they do not.
ROOT_ENTRIES = LANES * (ACTIVE // LANES + 1)
PACKET_SIZE = ROOT_ENTRIES + WIDTH * LANES  # a multiple of 16: where the first row begins at a cache line, all rows do

# An entry of a packet's stack: its key (traverse.stack.key_of), of two words; then the mask of the rays that go there (ENTRY_RAYS);
# then nothing, so that an entry is moved at once. A packet's stack needs one entry more than a ray's: it holds the nearest child
# too.
# The stack is where those of slots begin, which are not yet in use.
ENTRY, ENTRY_RAYS = 4, 2

# A ray's stack is a list of levels, one for each node on the way to the ray's place that has children still to come. A level
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

_NUMBERS = {
    "WIDTH": WIDTH, "LANES": LANES, "COHERENT": COHERENT, "AXIS_BITS": AXIS_BITS, "AXIS_MASK": (1 << AXIS_BITS) - 1,
    "REFUSED": REFUSED, "ROOT_ENTRIES": ROOT_ENTRIES, "PACKET_SIZE": PACKET_SIZE, "ENTRY": ENTRY, "ENTRY_RAYS": ENTRY_RAYS,
    "LEAF_BITS": LEAF_BITS, "CACHE_LINE": CACHE_LINE, "LINES": LINES, "LEVEL": LEVEL, "LEVEL_REFERENCES": LEVEL_REFERENCES,
    "LEVEL_LEFT": LEVEL_LEFT, "KEY_MASK": KEY_MASK, "STACK_WORDS": STACK_WORDS, "SLOT_SIZE": SLOT_SIZE,
    "NODE_SIZE": node_size(WIDTH, False), "REFERENCES": first_reference(WIDTH, False),
    "PRIM_ID_ROW": PRIM_ID_ROW, "ROW_SIZE": ROW_SIZE, "NO_HIT": NO_HIT,
    "LARGEST": LARGEST, "FARTHEST": FARTHEST, "SHORTEST": SHORTEST, "LONGEST": LONGEST, "LENGTHEN": LENGTHEN, "SHORTEN": SHORTEN,
    **{name.upper(): first for name, first in ROW.items()},
    **{name.upper(): i for i, name in enumerate(PLANES)},
    **{f"BEAM_{name.upper()}": first for name, first in BEAM.items()},
    **{f"SLOT_{name.upper()}": i for name, i in SLOT.items()},
}
_BOUNDS = {"FAR_PAD": FAR_PAD, "PAD_EXTENT": PAD_EXTENT, "PAD_COORDINATE": PAD_COORDINATE, "PAD_SMALLEST": PAD_SMALLEST,
           "CLAMP_ROUNDING": CLAMP_ROUNDING, "CLAMP_STEP": CLAMP_STEP, "SLOWEST": SLOWEST}
LAYOUT_H = constants(_NUMBERS) + constants(_BOUNDS, "Bounds")
