"""The binary BVH: a binary tree, as its builder made it, and nothing more."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.built import Built
from wrt.accel.bvh.builders import BvhOptions, build_binary, sah_cost
from wrt.accel.bvh.refit import refit_nodes
from wrt.accel.store import check_binary
from wrt.kernels.traverse import bvh2 as kernels


class Bvh2(Accelerator):
    """Options: builder (a name in wrt.accel.bvh.builders.BVH_BUILDERS), max_leaf (1 to 64 primitives), cost_traversal and
    cost_intersection (of the SAH), split_alpha and split_budget (of builder "sbvh"): see BvhOptions."""

    name = "bvh2"
    kernels = kernels

    def _build(self, builder: str = "binned", max_leaf: int = 4, cost_traversal: float = 1.0,
               cost_intersection: float = 1.0, split_alpha: float = 4e-5, split_budget: float = 0.5) -> Built:
        options = BvhOptions(builder, max_leaf, cost_traversal, cost_intersection, split_alpha, split_budget)
        tree = build_binary(self.geometry, options, self.threads)
        return self._around(tree.nodes, tree.order, tree.leaves, tree.depth)

    def _around(self, nodes: np.ndarray, order: np.ndarray, leaves: int, depth: int) -> Built:
        """The structure over a tree with boxes: Bvh2Node records."""
        return Built({"nodes": nodes}, order, len(nodes), leaves, depth, sah_cost(nodes))

    def _check(self, built: Built) -> None:
        check_binary(built.arrays["nodes"], len(built.order), kernels.STACK_SIZE)

    def _refit(self, built: Built) -> Built:
        nodes = refit_nodes(built.arrays["nodes"], built.order, self.geometry)
        return replace(built, arrays={"nodes": nodes}, sah_cost=sah_cost(nodes))

    def _children(self, built: Built) -> Any:
        from wrt.accel.bvh.epo import children

        nodes = built.arrays["nodes"]
        lo, hi, first, count = (np.stack([nodes[part + "_0"], nodes[part + "_1"]], axis=1)
                                for part in ("lo", "hi", "first", "count"))
        return children(lo, hi, first, np.where(lo[..., 0] > hi[..., 0], -1, count), built.order)
