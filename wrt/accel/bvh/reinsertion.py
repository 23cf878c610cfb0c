"""Optimisation of built trees by reinsertion of subtrees (kernels: kernels/build/reinsertion.py)."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from wrt.accel.bvh.builders import BinaryTree, BvhOptions
from wrt.accel.bvh.top_down import build_binned, build_options
from wrt.accel.geometry import Geometry
from wrt.accel.queries.raw_launches import launch_raw
from wrt.core.device import preloading, records
from wrt.core.warp_private import struct_record
from wrt.kernels.build import reinsertion as kernels
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node
from wrt.kernels.units.box import half_area

NODES_PER_LAUNCH = 256
SMALL_LEAF = 3  # primitives per leaf at most while build_refined moves subtrees; wide BVHs merge leaves afterwards


class Effort(NamedTuple):
    """Extent of the optimisation."""

    share: float  # Fraction of the nodes, the largest ones, that a round tries to move.
    rounds: int  # Maximum number of rounds.
    least_gain: float  # A round that reduces the sum of all boxes' areas by a smaller fraction is the last.


@dataclass(frozen=True)
class Walk:
    """Arrays of kernels.build.reinsertion.Walk."""

    order: np.ndarray
    level: np.ndarray
    count: np.ndarray
    cost: np.ndarray
    depth: np.ndarray


EVERY_NODE = Effort(1.0, 12, 2e-3)
LARGEST_NODES = Effort(0.03, 8, 1e-2)


def build_reinsertion(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build by binned SAH down to single primitives, optimise by reinsertion, and collapse into leaves (Meister, Bittner 2018)."""
    tree = build_binned(geometry, replace(options, max_leaf=1), threads)
    if len(tree.nodes) < 2:
        return tree
    links, walk, _ = optimized(tree, EVERY_NODE, threads)
    return collapse(tree, links, walk, options)


def build_refined(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build by binned SAH and reinsert the largest nodes: most of the gain of full reinsertion in a tenth of its time.

    Bittner, Hapala and Havran 2013, "Fast Insertion-Based Optimization of Bounding Volume Hierarchies".
    """
    leaf = min(options.max_leaf, SMALL_LEAF)
    with preloading(*([kernels.find_moves, kernels.make_moves, kernels.order_nodes] if len(geometry) > leaf else [])):
        tree = build_binned(geometry, replace(options, max_leaf=leaf), threads)
        if len(tree.nodes) < 2:
            return tree
        links, walk, fell = optimized(tree, LARGEST_NODES, threads)
    return tree if fell < LARGEST_NODES.least_gain else with_leaves(tree, links, walk)


def leaf_begins(tree: BinaryTree) -> np.ndarray:
    """Return a mask over tree.order, (R,) bool: True at the first primitive of each leaf."""
    begins = np.zeros(len(tree.order), bool)
    for side in ("0", "1"):
        begins[tree.nodes["first_" + side][tree.nodes["count_" + side] > 0]] = True
    return begins


def words(array: np.ndarray) -> np.ndarray:
    """Return a view of (N,) records of 32-bit fields, (N, K) int32: rows are moved much faster than fields."""
    return array.view(np.int32).reshape(len(array), -1)


def links_of(tree: BinaryTree) -> np.ndarray:
    """Convert a tree to kernels.build.reinsertion.Link records: inner nodes first, then leaves in the order of their primitives."""
    nodes, n_inner = tree.nodes, len(tree.nodes)
    links, leaf_index = records(kernels.Link, 2 * n_inner + 1), np.cumsum(leaf_begins(tree), dtype=np.int32) - 1
    links["left"], links["right"] = -1, -1
    place = np.empty(len(links), np.int32)  # 2 * parent + side of each link except the root
    for side, child in enumerate(("left", "right")):
        first, leaf = nodes[f"first_{side}"], nodes[f"count_{side}"] > 0
        index = links[child][:n_inner] = np.where(leaf, n_inner + leaf_index[np.where(leaf, first, 0)], first)
        place[index] = np.arange(side, 2 * n_inner, 2, dtype=np.int32)
    place[0] = 0
    links["parent"] = place >> 1
    words(links)[:, 3:] = words(nodes)[:, :12].reshape(-1, 6).take(place, axis=0)
    links["parent"][0] = -1
    links["lo"][0] = np.minimum(nodes["lo_0"][0], nodes["lo_1"][0])
    links["hi"][0] = np.maximum(nodes["hi_0"][0], nodes["hi_1"][0])
    return links


def half_areas(links: np.ndarray, scale: np.float32) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(half_area.func(((np.float32(0.5) * links["hi"] - np.float32(0.5) * links["lo"]) * scale).T))


def scale_of(links: np.ndarray) -> np.float32:
    """Return the factor that makes the root's longest edge 2; 0 for an infinite root."""
    with np.errstate(over="ignore"):
        extent = (np.float32(0.5) * links["hi"][0] - np.float32(0.5) * links["lo"][0]).max()
    return np.float32(1.0) / max(extent, np.float32(2.0**-126)) if np.isfinite(extent) else np.float32(0.0)


def optimized(tree: BinaryTree, effort: Effort, threads: int) -> tuple[np.ndarray, Walk, float]:
    """Return the optimised links, their kernels.build.reinsertion.Walk, and the fraction by which the sum of all boxes' areas fell.

    If the tree becomes deeper than the traversal stack, the optimisation begins again with half as many rounds.
    """
    before, rounds = links_of(tree), effort.rounds
    while True:
        links = before.copy()
        fell = move(links, effort, rounds, threads)
        walk = order_nodes(links)
        if rounds == 0 or int(walk.depth[0]) <= STACK_SIZE:
            return links, walk, fell
        rounds //= 2


def move(links: np.ndarray, effort: Effort, rounds: int, threads: int) -> float:
    """In each round, find the best new place of each large node; then make these moves, the move with the largest gain first.

    Return the fraction by which the sum of all boxes' areas fell.
    """
    scale = scale_of(links)
    areas = half_areas(links, scale)
    area = first = float(areas.sum(dtype=np.float64))
    for _ in range(rounds if scale > 0.0 else 0):
        nodes = largest(links, areas, effort.share)
        moves = records(kernels.Move, len(nodes))
        moves["node"] = nodes
        launch_raw(kernels.find_moves, len(nodes), links, moves, None, scale, threads=threads, step=NODES_PER_LAUNCH)
        moves = moves[moves["gain"] > 0.0]
        moves = moves[np.argsort(-moves["gain"], kind="stable")]
        touched = np.zeros(len(links), np.uint8)
        launch_raw(kernels.make_moves, 1, links, areas, moves, touched, scale)
        last, area = area, float(areas.sum(dtype=np.float64))
        if not area < last * (1.0 - effort.least_gain):
            break
    return 1.0 - area / first if first > 0.0 else 0.0


def largest(links: np.ndarray, areas: np.ndarray, share: float) -> np.ndarray:
    """Return the indices of the largest nodes (fraction `share`), (K,) int32, without the root and its children, which cannot move."""
    movable = links["parent"] > 0
    most = int(share * len(links))
    if share < 1.0 and 0 < most < len(links):
        movable &= areas >= np.partition(areas, len(areas) - most)[len(areas) - most]
    return np.flatnonzero(movable).astype(np.int32)


def order_nodes(links: np.ndarray) -> Walk:
    order, level, count = np.empty((3, len(links)), np.int32)
    walk = Walk(order, level, count, np.empty(len(links), np.float32), np.zeros(1, np.int32))
    launch_raw(kernels.order_nodes, 1, links, struct_record(kernels.Walk, vars(walk).values()))
    return walk


def with_leaves(tree: BinaryTree, links: np.ndarray, walk: Walk) -> BinaryTree:
    """Convert links to a tree with the leaves of the original tree. The primitives of a subtree become adjacent."""
    n_inner, order = len(tree.nodes), walk.order
    before, begins, counts = np.zeros((3, len(links)), np.int32)
    before[n_inner:] = np.flatnonzero(leaf_begins(tree))
    counts[n_inner:] = np.diff(before[n_inner:], append=len(tree.order))
    leaves = order[order >= n_inner]
    begins[leaves] = np.cumsum(counts[leaves]) - counts[leaves]
    at = np.arange(len(tree.order)) + np.repeat(before[leaves] - begins[leaves], counts[leaves])
    return BinaryTree(nodes_of(links, order[order < n_inner], begins, counts), tree.order[at], int(walk.depth[0]))


def nodes_of(links: np.ndarray, inner: np.ndarray, begins: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Convert a tree's inner nodes, links[inner], to Bvh2Node records in the order of `inner`.
    begins, counts: one entry per link. For a leaf: position of its first primitive in the tree's order, and number of primitives.
    For inner nodes, the function overwrites the entries."""
    nodes = records(Bvh2Node, len(inner))
    begins[inner], counts[inner] = np.arange(len(inner)), 0
    for side, name in enumerate(("left", "right")):
        child = links[name].take(inner)
        words(nodes)[:, 6 * side : 6 * side + 6] = words(links).take(child, axis=0)[:, 3:]
        nodes[f"first_{side}"], nodes[f"count_{side}"] = begins.take(child), counts.take(child)
    return nodes


def collapse(tree: BinaryTree, links: np.ndarray, walk: Walk, options: BvhOptions) -> BinaryTree:
    """Collapse subtrees of a tree with one primitive per leaf into larger leaves wherever that costs no more."""
    launch_raw(kernels.choose_leaves, 1, links, struct_record(kernels.Walk, vars(walk).values()), build_options(options), scale_of(links))
    order, counts = walk.order, walk.count.copy()
    # The 2 count - 2 links below a link come next in the walk: those below a leaf are inside it.
    leaf, after = links["left"][order] < 0, np.arange(1, len(order) + 1)
    change = np.bincount(after[leaf], minlength=len(order) + 1)
    inside = np.cumsum(change - np.bincount((after + 2 * counts[order] - 2)[leaf], minlength=len(order) + 1))[:-1] > 0
    inner, leaves = order[~leaf & ~inside], order[leaf & ~inside]
    begins = np.zeros(len(links), np.int32)
    begins[leaves] = np.cumsum(counts[leaves]) - counts[leaves]
    n_inner = len(tree.nodes)
    return BinaryTree(nodes_of(links, inner, begins, counts), tree.order[order[order >= n_inner] - n_inner],
                      int(walk.level[inner].max()))
