"""References: what a place for a child in a wide node leads to, in one int32.

EMPTY; or the index of an inner node, above 0; or a leaf, below 0: where its primitives begin and how many they are. The functions
for leaves are for kernels; the host calls `leaf_first.func(...)` and so on, with numbers or NumPy arrays of int64.
"""

import warp as wp

EMPTY = wp.constant(0)  # a child that does not exist: the root is nobody's child
LEAF_BITS = 6
MAX_LEAF = 1 << LEAF_BITS  # primitives of a leaf
MAX_FIRST = 1 << (31 - LEAF_BITS)  # leaves begin below this


@wp.func
def leaf_reference(first: int, count: int) -> int:
    """count: 1 .. MAX_LEAF; first: 0 .. MAX_FIRST - 1, in whatever unit the nodes' layout counts."""
    return -1 - (MAX_LEAF * first + count - 1)


@wp.func
def leaf_first(reference: int) -> int:
    return (-1 - reference) >> LEAF_BITS


@wp.func
def leaf_count(reference: int) -> int:
    return ((-1 - reference) & (MAX_LEAF - 1)) + 1
