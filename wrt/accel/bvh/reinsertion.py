"""The optimiser of finished trees by reinsertion (the loops are Warp kernels, kernels/build/reinsertion.py)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.bvh.top_down import build_binned, build_options
from wrt.accel.bvh.tree import BinaryTree, BvhOptions
from wrt.accel.geometry import Geometry
from wrt.core.device import launch, records, start, upload
from wrt.kernels.build import reinsertion as kernels
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node

MAX_ROUNDS = 12
# A round whose moves take off less than this share of the areas is the last one.
LEAST_GAIN = 2e-3
NODES_PER_LAUNCH = 4096


def build_reinsertion(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Binned SAH down to single primitives, optimised by reinsertion (Meister and Bittner 2018), then collapsed into leaves.

    The optimiser knows nothing of depth: a round that would make the tree deeper than the stack is undone, and is the last.
    """
    tree = build_binned(geometry, replace(options, max_leaf=1), threads)
    return tree if len(tree.order) <= 2 else optimize(tree, options, threads)


def links_of(tree: BinaryTree) -> np.ndarray:
    """The nodes of a tree with one record a leaf as links: inner ones first, then the leaves in the order of their records."""
    nodes, n_inner = tree.nodes, len(tree.nodes)
    links = records(kernels.Link, n_inner + len(tree.order))
    links["left"], links["right"], links["parent"] = -1, -1, -1
    for side, child in (("0", "left"), ("1", "right")):
        index = np.where(nodes["count_" + side] > 0, n_inner + nodes["first_" + side], nodes["first_" + side])
        links[child][:n_inner] = index
        links["parent"][index] = np.arange(n_inner)
        links["lo"][index], links["hi"][index] = nodes["lo_" + side], nodes["hi_" + side]
    links["lo"][0] = np.minimum(nodes["lo_0"][0], nodes["lo_1"][0])
    links["hi"][0] = np.maximum(nodes["hi_0"][0], nodes["hi_1"][0])
    return links


def half_areas(links: np.ndarray, scale: np.float32) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        e = (np.float32(0.5) * links["hi"] - np.float32(0.5) * links["lo"]) * scale
        return e[:, 0] * e[:, 1] + e[:, 1] * e[:, 2] + e[:, 2] * e[:, 0]


def optimize(tree: BinaryTree, options: BvhOptions, threads: int) -> BinaryTree:
    """The tree (one record a leaf, three or more of them) with less area in its boxes, and leaves as the options want them."""
    cpu = start("cpu")
    links = upload(links_of(tree), kernels.Link, cpu)
    view = links.numpy()
    with np.errstate(over="ignore"):
        extent = (np.float32(0.5) * view["hi"][0] - np.float32(0.5) * view["lo"][0]).max()
    scale = np.float32(1.0) / max(extent, np.float32(2.0**-126)) if np.isfinite(extent) else np.float32(0.0)
    area = float(half_areas(view, scale).sum(dtype=np.float64))
    for _ in range(MAX_ROUNDS if scale > 0.0 else 0):
        before = view.copy()
        move_once(links, view, scale, threads)
        if int(walk_down(links).depth.numpy()[0]) > STACK_SIZE:
            view[:] = before
            break
        last, area = area, float(half_areas(view, scale).sum(dtype=np.float64))
        if not area < last * (1.0 - LEAST_GAIN):
            break
    return collapse(tree, links, options, scale)


def move_once(links: Any, view: np.ndarray, scale: np.float32, threads: int) -> None:
    """One round: the best place of every node is searched for, then the moves are made, the best first."""
    cpu = start("cpu")
    # The root stays, and its children: their parent is the root.
    nodes = np.flatnonzero(view["parent"] > 0).astype(np.int32)
    moves = records(kernels.Move, len(nodes))
    moves["node"] = nodes
    device_moves = upload(moves, kernels.Move, cpu)
    launch(kernels.find_moves, len(nodes), links, device_moves, None, scale, threads=threads, step=NODES_PER_LAUNCH)
    moves = device_moves.numpy()
    moves = moves[moves["gain"] > 0.0]
    if not len(moves):
        return
    moves = moves[np.argsort(-moves["gain"], kind="stable")]
    touched = wp.zeros(len(view), dtype=wp.uint8, device=cpu)
    launch(kernels.make_moves, 1, links, upload(moves, kernels.Move, cpu), touched)


def walk_down(links: Any) -> Any:
    cpu = start("cpu")
    walk = kernels.Walk()
    for name in ("order", "level", "index", "count"):
        setattr(walk, name, wp.empty(len(links), dtype=wp.int32, device=cpu))
    walk.cost = wp.empty(len(links), dtype=wp.float32, device=cpu)
    walk.depth = wp.zeros(1, dtype=wp.int32, device=cpu)
    launch(kernels.walk_down, 1, links, walk)
    return walk


def collapse(tree: BinaryTree, links: Any, options: BvhOptions, scale: np.float32) -> BinaryTree:
    """Subtrees become leaves wherever that costs no more; the depth is that of what is left."""
    cpu = start("cpu")
    n_inner = len(tree.nodes)
    walk = walk_down(links)
    launch(kernels.weigh, 1, links, walk, build_options(options), scale)
    order = wp.empty(len(tree.order), dtype=wp.int32, device=cpu)
    nodes = wp.empty(n_inner, dtype=Bvh2Node, device=cpu)
    count = wp.zeros(1, dtype=wp.int32, device=cpu)
    launch(kernels.write_nodes, 1, links, walk, n_inner, upload(tree.order, wp.int32, cpu), order, nodes, count)
    inner = (walk.index.numpy()[:n_inner] >= 0) & (links.numpy()["left"][:n_inner] >= 0)
    depth = int(walk.level.numpy()[:n_inner][inner].max())
    return BinaryTree(nodes.numpy()[: int(count.numpy()[0])].copy(), order.numpy(), depth)
