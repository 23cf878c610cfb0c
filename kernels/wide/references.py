"""References: an int32 that describes a child of a wide node.

A reference is EMPTY (0), the index of an inner node (positive), or a leaf (negative): the index of its first primitive, and their number.
The functions below are device code. The host calls `leaf_first.func(...)`, for example, with ints or NumPy arrays of int64."""

import warp as wp

EMPTY = wp.constant(0)  # A child that does not exist. (Index 0 is the root, which is no node's child.)
DONE = wp.constant(0x7FFFFFFF)  # No reference: a walk has no more children to visit.
LEAF_BITS = 6
MAX_LEAF = 1 << LEAF_BITS  # Largest number of primitives in a leaf.
MAX_FIRST = 1 << (31 - LEAF_BITS)  # Upper bound, exclusive, of a leaf's `first`.


@wp.func
def leaf_reference(first: int, count: int) -> int:
    """Return the reference of a leaf with `count` (1 .. MAX_LEAF) primitives. first: index below MAX_FIRST in units of NodeLayout.unit."""
    return -1 - (MAX_LEAF * first + count - 1)


@wp.func
def leaf_first(reference: int) -> int:
    return (-1 - reference) >> LEAF_BITS


@wp.func
def leaf_count(reference: int) -> int:
    return ((-1 - reference) & (MAX_LEAF - 1)) + 1
