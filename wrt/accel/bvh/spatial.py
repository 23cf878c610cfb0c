"""Builder with spatial splits (kernel: kernels/build/sbvh.py)."""

import numpy as np

from wrt.accel.bvh.top_down import build_data, build_options, in_order, run_tasks
from wrt.accel.bvh.tree import BinaryTree, BvhOptions, small_tree, squeeze
from wrt.accel.geometry import Geometry
from wrt.core.device import records
from wrt.core.errors import InputError
from wrt.kernels.build import records as build_records
from wrt.kernels.build.bvh2 import make_build_ranges
from wrt.kernels.build.sbvh import share_space, split_references
from wrt.kernels.traverse.bvh2 import Bvh2Node

MAX_BUDGET = 8.0


def build_sbvh(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build by binned SAH, with spatial splits where the sides of an object split overlap (Stich et al. 2009).

    A primitive may be in several leaves. Raises InputError for a split_budget above MAX_BUDGET.
    """
    if options.split_budget > MAX_BUDGET:
        raise InputError(f"must be at most {MAX_BUDGET:g}, got {options.split_budget}", argument="split_budget")
    lo, hi = geometry.bounds(threads)
    n = len(lo)
    if n <= 1:
        return small_tree(lo, hi)
    capacity = n + int(options.split_budget * n)
    build = records(build_records.BuildRecord, capacity)
    build[:n] = in_order(lo, hi)
    nodes, boxes = records(Bvh2Node, capacity - 1), records(build_records.BuildRecord, capacity)
    used, left = np.zeros(capacity - 1, np.uint8), np.zeros(capacity, np.uint8)
    corners = geometry.vertices[geometry.faces].reshape(-1, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        half = 0.5 * (hi.max(axis=0).astype(np.float64) - lo.min(axis=0))
        scale = 1.0 / max(half.max(), 2.0**-126)
        x, y, z = half * scale
        area = options.split_alpha * (x * y + y * z + z * x)
    least = min(area, 3e38) if np.isfinite(area) else 3e38  # no spatial splits in an infinite scene
    data = build_data(records=build, boxes=boxes, nodes=nodes, used=used, left=left, corners=corners, scale=scale, min_overlap=least)
    depth = run_tasks(make_build_ranges(split_references, share_space), data, build_options(options), n, threads, capacity)
    return compact(squeeze(nodes, used != 0), build["prim_id"], left != 0, depth)


def compact(nodes: np.ndarray, prim_id: np.ndarray, used: np.ndarray, depth: int) -> BinaryTree:
    """Return the finished tree, without the gaps between the primitives of its leaves. used: mask of the leaves' primitives."""
    index = np.cumsum(used, dtype=np.int32) - 1
    for side in ("0", "1"):
        leaf = nodes["count_" + side] > 0
        nodes["first_" + side][leaf] = index[nodes["first_" + side][leaf]]
    return BinaryTree(nodes, prim_id[used], depth)
