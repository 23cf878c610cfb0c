"""Refit: the boxes of a binary BVH around primitives that have moved, from the leaves up, on the CPU backend."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import Bvh2Node


@kernel
def refit(
    nodes: wp.array(dtype=Bvh2Node), order: wp.array(dtype=wp.int32), lo: wp.array(dtype=wp.vec3), hi: wp.array(dtype=wp.vec3)
):
    """Launched with dim = 1. lo, hi: a box for each prim_id.

    Children stand behind their parents, so that one pass from the last node to the first finds the boxes of all children done.
    Empty children stay empty.
    """
    n = nodes.shape[0]
    for k in range(n):
        i = n - 1 - k
        node = nodes[i]
        for side in range(2):
            first = wp.where(side == 0, node.first_0, node.first_1)
            count = wp.where(side == 0, node.count_0, node.count_1)
            was = wp.where(side == 0, node.lo_0, node.lo_1)
            low = wp.vec3(wp.inf, wp.inf, wp.inf)
            high = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            if count > 0:
                for j in range(first, first + count):
                    low = wp.min(low, lo[order[j]])
                    high = wp.max(high, hi[order[j]])
            elif was[0] < wp.inf:
                child = nodes[first]
                low = wp.min(child.lo_0, child.lo_1)
                high = wp.max(child.hi_0, child.hi_1)
            if side == 0:
                node.lo_0 = low
                node.hi_0 = high
            else:
                node.lo_1 = low
                node.hi_1 = high
        nodes[i] = node
