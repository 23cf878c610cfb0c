"""Wide BVHs: a binary one collapsed into nodes of 4 or 8 children."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from wrt.accel.base import Accelerator, Built
from wrt.accel.bvh_build import BvhOptions, build_binary
from wrt.accel.wide_tree import WideTree, check_wide, collapse, lanes_of, refit, small_tree
from wrt.errors import InputError
from wrt.kernels.lanes import EMPTY
from wrt.kernels.traverse_wide import LEAF_RANGE, NODE_ROWS, WideTraversal


def aligned(array: np.ndarray) -> np.ndarray:
    """The same numbers in memory that begins where a cache line does."""
    memory = np.empty(array.nbytes + 64, np.uint8)
    first = -memory.ctypes.data % 64
    out = memory[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
    out[...] = array
    return out


class WideBvh(Accelerator):
    """Options: builder (of the binary tree, a name in wrt.accel.bvh_build.BVH_BUILDERS), max_leaf (1 to 64 primitives; by default
    as many as a row has lanes), cost_traversal and cost_intersection (of one node visited and of one row of primitives tested),
    split_alpha and split_budget (of builder "sbvh"): see BvhOptions."""

    width: ClassVar[int]

    def _build(self, builder: str = "binned", max_leaf: int | None = None, cost_traversal: float = 1.0,
               cost_intersection: float = 1.0, split_alpha: float = 1e-5, split_budget: float = 0.5) -> Built:
        max_leaf = self.width if max_leaf is None else max_leaf
        BvhOptions(builder, max_leaf, cost_traversal, cost_intersection)  # refuses what is out of range
        options = BvhOptions(builder, 1, split_alpha=split_alpha, split_budget=split_budget)
        binary = build_binary(self.geometry, options, self.threads)
        tree = (collapse(binary, self.width, max_leaf, cost_traversal, cost_intersection) if len(binary.order) > 1
                else small_tree(binary, self.width))
        return Built(self._arrays(tree), tree.order[tree.order >= 0], len(tree.children), tree.leaves, tree.depth, tree.sah_cost())

    def _arrays(self, tree: WideTree) -> dict[str, np.ndarray]:
        """The node rows of kernels.traverse_wide."""
        n = len(tree.children)
        nodes = np.zeros((n, NODE_ROWS, self.width), np.float32)
        nodes[:, 0:6:2], nodes[:, 1:6:2] = tree.lo.transpose(0, 2, 1), tree.hi.transpose(0, 2, 1)
        nodes[:, 6] = tree.children.view(np.float32)
        return {"nodes": nodes.reshape(-1)}

    def _tree(self, built: Built) -> WideTree:
        """The tree that _arrays laid out."""
        nodes = built.arrays["nodes"].reshape(-1, NODE_ROWS, self.width)
        lo, hi = (np.ascontiguousarray(nodes[:, first:6:2].transpose(0, 2, 1)) for first in range(2))
        children = np.ascontiguousarray(nodes[:, 6]).view(np.int32)
        return WideTree(lo, hi, children, lanes_of(children, built.order, self.width), built.leaves, built.depth, 0)

    def _primitives(self, built: Built) -> np.ndarray:
        """What the triangle test reads, number by number in rows; lanes without a primitive hold the first one, untested."""
        order = self._tree(built).order
        if not order.size:
            return np.zeros(0, np.float32)
        records = self.geometry.primitives(self.structure.units, np.maximum(order, 0).reshape(-1))
        numbers = records.view(np.float32).reshape(len(order), self.width, -1)
        return aligned(numbers.transpose(0, 2, 1).reshape(-1))

    def _upload(self, built: Built) -> Any:
        return super()._upload(replace(built, arrays={name: aligned(array) for name, array in built.arrays.items()}))

    def _check(self, built: Built) -> None:
        nodes = built.arrays["nodes"]
        if len(nodes) % (NODE_ROWS * self.width):
            raise InputError("is damaged: its nodes are no whole ones")
        check_wide(nodes.reshape(-1, NODE_ROWS, self.width)[:, 6].view(np.int32), len(built.order), self.width)

    def _refit(self, built: Built) -> Built:
        tree = refit(self._tree(built), self.geometry)
        return replace(built, arrays=self._arrays(tree), sah_cost=tree.sah_cost())

    def _children(self, built: Built) -> Any:
        from wrt.accel.epo import children

        tree = self._tree(built)
        leaf = tree.children < 0
        code = -1 - tree.children.astype(np.int64)
        first = np.where(leaf, code // LEAF_RANGE * self.width, tree.children)
        count = np.where(leaf, code % LEAF_RANGE + 1, np.where(tree.children == EMPTY, -1, 0))
        return children(tree.lo, tree.hi, first, count, tree.order)


class Bvh4(WideBvh):
    __doc__ = WideBvh.__doc__

    name = "bvh4"
    width = 4
    kernels = WideTraversal(4)


class Bvh8(WideBvh):
    __doc__ = WideBvh.__doc__

    name = "bvh8"
    width = 8
    kernels = WideTraversal(8)
