"""References: the child of a wide node, in one int32.

A reference is EMPTY, the index of an inner node (above 0), or a leaf (below 0): its first primitive and their count. The functions for
leaves are for kernels. The host calls `leaf_first.func(...)` and so on, with ints or NumPy arrays of int64."""

import warp as wp

EMPTY = wp.constant(0)  # A child that does not exist: no node has the root as a child.
LEAF_BITS = 6
MAX_LEAF = 1 << LEAF_BITS  # Most primitives of a leaf.
MAX_FIRST = 1 << (31 - LEAF_BITS)  # Leaves begin below this.


@wp.func
def leaf_reference(first: int, count: int) -> int:
    """Return the reference of a leaf of `count` (1 .. MAX_LEAF) primitives; `first` (below MAX_FIRST) counts in the layout's unit."""
    return -1 - (MAX_LEAF * first + count - 1)


@wp.func
def leaf_first(reference: int) -> int:
    return (-1 - reference) >> LEAF_BITS


@wp.func
def leaf_count(reference: int) -> int:
    return ((-1 - reference) & (MAX_LEAF - 1)) + 1
