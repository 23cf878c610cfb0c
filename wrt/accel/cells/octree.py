"""The octree, an adaptive grid: a cell with much in it is cut into eight, and an octant with nothing in it takes no memory."""

from __future__ import annotations

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.built import Built
from wrt.accel.cells.common import check_numbers, check_references, one_row, triangle_reach
from wrt.accel.cells.octree_build import OctreeOptions, build_tree
from wrt.core.errors import InputError
from wrt.kernels.traverse import octree as kernels


class Octree(Accelerator):
    """Options: max_leaf (cells with so many primitives are not split), max_depth (splits from the root down, 0 to MAX_LEVELS),
    by_cost (stop also where the octants cost a ray as much as the cell), max_growth (in every part of the tree, at most so many
    references for each primitive), mailbox (whether a primitive that spans several cells is tested once where it can be).

    Spheres are listed wherever their box is. The `box` test is not used.
    """

    name = "octree"
    kernels = kernels
    bytes_to_build = 450.0

    def _build(self, max_leaf: int = 8, max_depth: int = kernels.MAX_LEVELS, by_cost: bool = True, max_growth: float = 16.0,
               mailbox: bool = True) -> Built:
        tree = build_tree(self.geometry, OctreeOptions(max_leaf, max_depth, by_cost, max_growth), self.threads)
        layout, nodes = tree.layout, tree.nodes
        pad, extent = triangle_reach(self.geometry, *self.geometry.bounds())
        return Built({"lo": np.array(layout.lo), "hi": np.array(layout.hi), "size": np.array(layout.size, np.float32),
                      "levels": np.array(layout.levels, np.int32), "pad": pad, "extent": extent,
                      "mailbox": np.array(mailbox, np.int32), "nodes": nodes, "references": tree.references},
                     np.arange(len(self.geometry), dtype=np.int32), len(nodes), int((nodes["count"] >= 0).sum()), tree.depth,
                     tree.cost)

    def _check(self, built: Built) -> None:
        arrays = one_row(self, built)
        check_numbers(arrays)
        levels, lo, hi = int(arrays["levels"]), arrays["lo"], arrays["hi"]
        if not 0 <= levels <= kernels.MAX_LEVELS or (levels and not (lo + np.float32(1 << levels) * arrays["size"] >= hi).all()):
            raise InputError("is damaged: its cells are not in order")
        if arrays["mailbox"] not in (0, 1):
            raise InputError("is damaged: its numbers are out of range")
        nodes = arrays["nodes"]
        if not is_tree(nodes, levels):
            raise InputError(f"is damaged: its nodes are no tree of at most {levels} levels below the root")
        check_references(nodes[nodes["count"] >= 0], arrays["references"], len(built.order))


def is_tree(nodes: np.ndarray, max_depth: int) -> bool:
    """Whether each node but the root is the octant of one that stands before it, and none is deeper than max_depth."""
    inner = np.nonzero(nodes["count"] < 0)[0]
    mask, first = -nodes["count"][inner].astype(np.int64), nodes["first"][inner].astype(np.int64)
    if not len(nodes) or (mask > 0xFF).any() or (first <= inner).any():
        return False
    n = np.bitwise_count(mask).astype(np.int64)
    child = np.repeat(first - (np.cumsum(n) - n), n) + np.arange(n.sum())
    if not np.array_equal(np.sort(child), np.arange(1, len(nodes))):
        return False
    parent = np.zeros(len(nodes), np.int64)
    parent[child] = np.repeat(inner, n)
    at = np.arange(len(nodes))
    for _ in range(max_depth):
        at = parent[at]
    return not at.any()
