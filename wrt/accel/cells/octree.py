"""Octree: a cell with many primitives is split into eight octants. An empty octant takes no memory."""

from __future__ import annotations

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.cells.common import check_numbers, check_references, one_row
from wrt.accel.cells.octree_build import OctreeOptions, build_tree
from wrt.accel.snapshot import Built
from wrt.accel.store import check_tree
from wrt.core.errors import InputError
from wrt.kernels.traverse import octree as kernels


class Octree(OneMesh):
    """An octree. Options: OctreeOptions.

    Every cell that overlaps a sphere's box lists the sphere. The option `box` has no effect.
    """

    name = "octree"
    kernels = kernels
    options = OctreeOptions

    def _build(self, options: OctreeOptions) -> Built:
        return build_tree(self.geometry, options, self.threads)

    def _check(self, built: Built) -> None:
        arrays = one_row(self, built)
        check_numbers(arrays)
        levels, lo, hi = int(arrays["levels"]), arrays["lo"], arrays["hi"]
        if not 0 <= levels <= kernels.MAX_LEVELS or (levels and not (lo + np.float32(1 << levels) * arrays["size"] >= hi).all()):
            raise InputError("is damaged: its cells are not in order")
        if (arrays["nodes"]["count"] < -0xFF).any():
            raise InputError("is damaged: the count of a node is out of range")
        nodes = arrays["nodes"]
        inner = np.flatnonzero(nodes["count"] < 0)
        octants = np.bitwise_count(-nodes["count"][inner].astype(np.int64)).astype(np.int64)
        child = np.repeat(nodes["first"][inner] - (np.cumsum(octants) - octants), octants) + np.arange(octants.sum())
        check_tree(len(nodes), np.repeat(inner, octants), child, levels)
        check_references(nodes[nodes["count"] >= 0], arrays["references"], len(built.order))
