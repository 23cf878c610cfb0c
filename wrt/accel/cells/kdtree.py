"""The k-d tree: axis-aligned planes split space, and every leaf lists the primitives that overlap it."""

from __future__ import annotations

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.cells.kdtree_build import KdOptions, build_tree
from wrt.accel.snapshot import Built
from wrt.accel.store import check_tree
from wrt.core.errors import InputError
from wrt.kernels.traverse import kdtree as kernels


class KdTree(OneMesh):
    """A k-d tree. Options: KdOptions."""

    name = "kdtree"
    kernels = kernels
    options = KdOptions

    def _build(self, options: KdOptions) -> Built:
        return build_tree(self.geometry, options, self.threads)

    def _check(self, built: Built) -> None:
        nodes = built.arrays["nodes"]
        if any(built.arrays[name].size != size for name, size in (("lo", 3), ("hi", 3), ("reach", 1))):
            raise InputError("is damaged: lo, hi or reach has a wrong size")
        leaf, first = (nodes["word"] & 3) == kernels.LEAF, (nodes["word"] >> 2).astype(np.int64)
        check_tree(len(nodes), np.tile(np.flatnonzero(~leaf), 2), np.concatenate([first[~leaf], first[~leaf] + 1]),
                   kernels.STACK_SIZE)
        first, count = first[leaf], nodes["split"][leaf].astype(np.float64)
        if not ((first >= 0) & (count >= 0.0) & (first + count <= len(built.order))).all():
            raise InputError("is damaged: a leaf leads out of the primitives")
