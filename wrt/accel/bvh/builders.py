"""Builders of binary BVHs: their table, options and results, and the surface area heuristic."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wrt.accel.box_tree import BoxTree
from wrt.accel.geometry import Geometry
from wrt.accel.structures import require_between
from wrt.core.device import records
from wrt.core.errors import InputError
from wrt.core.registry import Registry
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.units.box import half_area

MAX_LEAF = 64
MAX_BUDGET = 8.0  # of spatial splits


@dataclass(frozen=True)
class BinaryOptions:
    """Options of binary structures.

    builder: a name in BVH_BUILDERS. max_leaf: largest number of primitives in a leaf, 1 to 64. cost_traversal, cost_intersection: SAH
    cost of visiting a node and of testing a primitive. Builder "sbvh" tries a spatial split if the overlap area of the best object
    split, divided by the root's area, exceeds split_alpha (Stich et al. 2009). It adds up to split_budget references per primitive.
    """

    builder: str = "binned"
    max_leaf: int = 4
    cost_traversal: float = 1.0
    cost_intersection: float = 1.0
    split_alpha: float = 4e-5
    split_budget: float = 0.5


@dataclass(frozen=True)
class BvhOptions(BinaryOptions):
    """Options of builders. row: number of primitives that are tested at once, which lowers the SAH cost of a leaf.

    Raises InputError for values out of range.
    """

    row: int = 1

    def __post_init__(self) -> None:
        require_between(max_leaf=(self.max_leaf, 1, MAX_LEAF), split_budget=(self.split_budget, 0.0, MAX_BUDGET),
                        **{name: (getattr(self, name), 0.0, 1e30) for name in ("cost_traversal", "cost_intersection", "split_alpha")})


@dataclass(frozen=True, eq=False)
class BinaryTree:
    """A binary tree."""

    nodes: np.ndarray  # (N,) Bvh2Node records, each parent before its children.
    order: np.ndarray  # (R,) int32, prim_ids of the leaves one after another; a prim_id may occur several times.
    depth: int  # Inner nodes on the longest path from the root.

    @property
    def leaves(self) -> int:
        return int((self.nodes["count_0"] > 0).sum() + (self.nodes["count_1"] > 0).sum())


BVH_BUILDERS: Registry[Callable[[Geometry, BvhOptions, int], BinaryTree]] = Registry("builder", {
    "binned": "wrt.accel.bvh.top_down:build_binned",
    "sweep": "wrt.accel.bvh.top_down:build_sweep",
    "sbvh": "wrt.accel.bvh.top_down:build_sbvh",
    "refined": "wrt.accel.bvh.reinsertion:build_refined",
    "reinsertion": "wrt.accel.bvh.reinsertion:build_reinsertion",
    "median": "wrt.accel.bvh.top_down:build_median",
    "lbvh": "wrt.accel.bvh.lbvh:build_lbvh",
})


def build_binary(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build a binary tree over the padded boxes of the geometry. Raises InputError for an unknown builder."""
    BVH_BUILDERS.check(options.builder, "builder")
    return BVH_BUILDERS[options.builder](geometry, options, threads)


def small_tree(lo: np.ndarray, hi: np.ndarray) -> BinaryTree:
    """Return the tree over zero boxes or one box. lo, hi: (0 or 1, 3) float32."""
    nodes = records(Bvh2Node, 1)
    nodes["lo_0"], nodes["hi_0"], nodes["lo_1"], nodes["hi_1"] = np.inf, -np.inf, np.inf, -np.inf
    if len(lo):
        nodes["lo_0"], nodes["hi_0"], nodes["count_0"] = lo, hi, 1
    return BinaryTree(nodes, np.arange(len(lo), dtype=np.int32), 1)


def squeeze(nodes: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the nodes in the mask `used`, (N,) bool, with new indices, in the same order: parents before children."""
    index = np.cumsum(used, dtype=np.int32) - 1
    out = nodes[used]
    for side in ("0", "1"):
        inner = out["count_" + side] == 0
        out["first_" + side] = np.where(inner, index[np.minimum(out["first_" + side], len(index) - 1)], out["first_" + side])
    return out


def binary_tree_of(tree: BoxTree) -> BinaryTree:
    """Convert a BoxTree of at most two children per node, in depth-first order."""
    if tree.width > 2:
        raise InputError(f"must have at most 2 children per node, got {tree.width}", place="tree: child", hint="use bvh4 or bvh8")
    nodes = records(Bvh2Node, len(tree.child))
    for side in range(2):
        absent = tree.count[:, side] < 0 if side < tree.width else np.ones(len(nodes), bool)
        k = min(side, tree.width - 1)
        nodes[f"lo_{side}"] = np.where(absent[:, None], np.float32(np.inf), tree.lo[:, k])
        nodes[f"hi_{side}"] = np.where(absent[:, None], np.float32(-np.inf), tree.hi[:, k])
        nodes[f"first_{side}"], nodes[f"count_{side}"] = np.where(absent, 0, tree.child[:, k]), np.where(absent, 0, tree.count[:, k])
    return BinaryTree(nodes, tree.primitives.astype(np.int32), len(tree.levels()))


def half_areas(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Return half the surface area of each box lo, hi (..., 3), in float64; 0 for empty boxes."""
    e = np.subtract(hi, lo, dtype=np.float64)
    np.minimum(np.maximum(e, 0.0, out=e), 1e39, out=e)
    return np.asarray(half_area.func((e[..., 0], e[..., 1], e[..., 2])))


def root_area(nodes: np.ndarray) -> float:
    """Return half the surface area of the box around the whole tree."""
    return float(half_areas(np.minimum(nodes["lo_0"][0], nodes["lo_1"][0]), np.maximum(nodes["hi_0"][0], nodes["hi_1"][0])))


def expected_cost(root: float, areas: np.ndarray, counts: np.ndarray) -> float:
    """Return the expected number of visited nodes, root included, plus tested primitives, for a random line through the root's box.

    root: area of the root's box. areas, counts: area and number of primitives of every child; 0 primitives mark an inner node.
    """
    return 1.0 + float((areas * np.maximum(counts, 1)).sum() / root) if root > 0.0 else float(counts.sum())


def sah_cost(nodes: np.ndarray) -> float:
    """Return the SAH cost of Bvh2Node records."""
    areas = np.stack([half_areas(nodes["lo_" + side], nodes["hi_" + side]) for side in "01"])
    return expected_cost(root_area(nodes), areas, np.stack([nodes["count_0"], nodes["count_1"]]))
