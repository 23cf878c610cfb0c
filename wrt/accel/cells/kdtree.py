"""The k-d tree: space is split by axis-aligned planes, and a primitive stands in every leaf that it reaches into."""

from __future__ import annotations

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.built import Built
from wrt.accel.cells.kdtree_build import KdOptions, build_tree
from wrt.accel.store import check_tree
from wrt.core.errors import InputError
from wrt.kernels.traverse import kdtree as kernels


class KdTree(OneMesh):
    """Options: max_leaf (cells with so many primitives are not split), max_depth (None: 8 + 1.3 log2 n), by_cost (stop where no
    split costs less than a leaf); cost_traversal, cost_intersection (of the SAH), empty_bonus (0 to 1: what a split that cuts
    off empty space is let off); perfect_below (larger cells are split between 64 bins, smaller ones at the best of all planes);
    clip (triangles are put into cells by what lies in them, not by their boxes); max_growth (how many references, and empty
    leaves, there may be for each primitive)."""

    name = "kdtree"
    kernels = kernels

    def _build(self, max_leaf: int = 1, max_depth: int | None = None, by_cost: bool = True, cost_traversal: float = 2.0,
               cost_intersection: float = 1.0, empty_bonus: float = 0.1, perfect_below: int = 65536, clip: bool = True,
               max_growth: float = 16.0) -> Built:
        options = KdOptions(max_leaf, max_depth, by_cost, cost_traversal, cost_intersection, empty_bonus, perfect_below, clip,
                            max_growth)
        return build_tree(self.geometry, options, self.threads)

    def _check(self, built: Built) -> None:
        nodes = built.arrays["nodes"]
        if any(built.arrays[name].size != size for name, size in (("lo", 3), ("hi", 3), ("reach", 1))):
            raise InputError("is damaged: a tree has one cell")
        leaf, first = (nodes["word"] & 3) == kernels.LEAF, (nodes["word"] >> 2).astype(np.int64)
        check_tree(len(nodes), np.tile(np.flatnonzero(~leaf), 2), np.concatenate([first[~leaf], first[~leaf] + 1]),
                   kernels.STACK_SIZE)
        first, count = first[leaf], nodes["split"][leaf].astype(np.float64)
        if not ((first >= 0) & (count >= 0.0) & (first + count <= len(built.order))).all():
            raise InputError("is damaged: a leaf has primitives that are not there")
