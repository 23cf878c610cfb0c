"""The box test of CUDA in the form of the CPU's: all entry distances of a node, and the mask of the entered children."""

from functools import cache

import warp as wp

from wrt.kernels.wide.lanes import LaneRay, row_type
from wrt.kernels.wide.nodes import make_plain


@cache
def make_plain_rows(width, compressed):
    row = row_type(width)
    entered, entry = make_plain(width, compressed)

    @wp.func
    def children(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float):
        entries = row()
        for j in range(width):
            entries[j] = entry(nodes, first, j, ray)
        return entries, entered(nodes, first, ray, t_max)

    return children
