"""bvh6: a wide BVH as in ray tracing units: six children in a node of 64 bytes, one primitive per leaf."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from wrt.accel.bvh.builders import BvhOptions
from wrt.accel.bvh.compress import compress, decompress
from wrt.accel.bvh.wide import CollapsedBvh
from wrt.accel.bvh.wide_tree import WideTree, check_wide
from wrt.accel.snapshot import Built
from wrt.core.device import records
from wrt.core.errors import InputError
from wrt.kernels.traverse import bvh6 as kernels
from wrt.kernels.traverse.bvh6 import LEAVES_SHIFT, WIDTH, Bvh6Node
from wrt.kernels.wide.layout import EXIST_SHIFT, FIRST_BYTES, WORD
from wrt.kernels.wide.references import EMPTY, leaf_first, leaf_reference


@dataclass(frozen=True)
class Bvh6Options:
    """Options of bvh6: those of BinaryOptions. A leaf has one primitive, so there is no max_leaf."""

    builder: str = "binned"
    cost_traversal: float = 1.0
    cost_intersection: float = 1.0
    split_alpha: float = 4e-5
    split_budget: float = 0.5


class Bvh6(CollapsedBvh):
    """A BVH of up to six children per node of 64 bytes, with 8 bits per plane, rounded outwards, and one primitive per leaf.

    Intel's GPUs and the simulator Vulkan-Sim have such nodes. Options: Bvh6Options.
    """

    name = "bvh6"
    options = Bvh6Options
    width = WIDTH
    kernels = kernels

    def _build(self, options: Bvh6Options) -> Built:
        tree = grouped(self._collapsed(BvhOptions(**asdict(options), max_leaf=1, row=WIDTH)))
        built = Built(self._arrays(tree), tree.order[:, 0].copy(), len(tree.children), tree.leaves, tree.depth)
        return replace(built, sah_cost=self._tree(built).sah_cost(tree.root_area))

    def _arranged(self, tree: WideTree) -> WideTree:
        tree = grouped(tree)
        if not np.array_equal(self._references(Built(self._arrays(tree), tree.order[:, 0])), tree.children):
            raise InputError("bvh6 takes binary trees with one primitive per leaf", argument="accel", hint="use bvh8")
        return tree

    def _arrays(self, tree: WideTree) -> dict[str, np.ndarray]:
        """Return the nodes of a tree that `grouped` made."""
        nodes, exists, inner = records(Bvh6Node, len(tree.children)), tree.children != EMPTY, tree.children > 0
        head = compress(tree.lo, tree.hi, exists)
        nodes["origin"] = head[:, :WORD]
        nodes["exponents"] = np.ascontiguousarray(head[:, WORD]).view(np.int32) & ((1 << EXIST_SHIFT) - 1)
        nodes["planes"] = np.ascontiguousarray(head[:, FIRST_BYTES:]).view(np.int32)
        leaves = exists.sum(axis=1) - inner.sum(axis=1)
        nodes["counts"] = inner.sum(axis=1) + (leaves << LEAVES_SHIFT)
        nodes["node"] = np.where(inner.any(axis=1), tree.children[:, 0], 0)
        first = np.take_along_axis(tree.children, np.minimum(inner.sum(axis=1), WIDTH - 1)[:, None], axis=1)[:, 0].astype(np.int64)
        nodes["primitive"] = np.where(leaves > 0, leaf_first.func(first), 0)
        return {"nodes": nodes}

    def _references(self, built: Built) -> np.ndarray:
        nodes, slot = built.arrays["nodes"], np.arange(WIDTH)
        inner, leaves = (count[:, None] for count in _counts(nodes))
        leaf = leaf_reference.func(nodes["primitive"].astype(np.int64)[:, None] + slot - inner, 1)
        out = np.where(slot < inner, nodes["node"][:, None] + slot, np.where(slot < inner + leaves, leaf, EMPTY))
        return out.astype(np.int32)

    def _tree(self, built: Built) -> WideTree:
        nodes, children = built.arrays["nodes"], self._references(built)
        head = np.empty((len(nodes), FIRST_BYTES + nodes["planes"].shape[1]), np.float32)
        mask = ((children != EMPTY) << np.arange(EXIST_SHIFT, EXIST_SHIFT + WIDTH)).sum(axis=1)
        head[:, :WORD] = nodes["origin"]
        head[:, WORD] = (nodes["exponents"] | mask).astype(np.int32).view(np.float32)
        head[:, FIRST_BYTES:] = np.ascontiguousarray(nodes["planes"]).view(np.float32)
        lanes = np.full((len(built.order), WIDTH), -1, np.int32)
        lanes[:, 0] = built.order
        return WideTree(*decompress(head, WIDTH), children, lanes, built.leaves, built.depth)

    def decoded(self) -> WideTree:
        """Return the tree with the boxes that rays are tested against; each leaf is a row with one primitive."""
        return self._tree(self.built)

    def _check(self, built: Built) -> None:
        nodes = built.arrays["nodes"]
        inner, leaves = _counts(nodes)
        if ((nodes["counts"] < 0) | (inner + leaves > WIDTH)).any() or (nodes["primitive"] < 0).any():
            raise InputError("is damaged: a node has an impossible number of children")
        if (nodes["node"] < (inner > 0)).any():  # 0 is the root, and EMPTY among references
            raise InputError("is damaged: a node leads out of the tree")
        if (nodes["primitive"] > len(built.order)).any():
            raise InputError("is damaged: a leaf leads to other primitives")
        check_wide(self._references(built), len(built.order), 1)


def _counts(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of inner children and of leaves of each node, (N,) each."""
    return nodes["counts"] & ((1 << LEAVES_SHIFT) - 1), nodes["counts"] >> LEAVES_SHIFT


def grouped(tree: WideTree) -> WideTree:
    """Return the tree with the slots of each node sorted: inner nodes by index, leaves by index, then empty slots."""
    children, none = tree.children.astype(np.int64), np.int64(1) << 40
    key = np.where(children > 0, children, np.where(children < 0, (none >> 1) + leaf_first.func(children), none))
    slots = np.argsort(key, axis=1, kind="stable")
    lo, hi = (np.take_along_axis(box, slots[..., None], axis=1) for box in (tree.lo, tree.hi))
    return replace(tree, lo=lo, hi=hi, children=np.take_along_axis(tree.children, slots, axis=1))
