"""Top-down builders, which split ranges of primitives in place (kernels: kernels/build/bvh2.py)."""

from functools import partial
from typing import Any

import numpy as np

from wrt.accel.bvh.builders import BinaryTree, BvhOptions, small_tree, squeeze
from wrt.accel.geometry import Geometry
from wrt.accel.queries.raw_launches import launch_raw
from wrt.core.device import load_kernel, record_dtype, records, start
from wrt.core.threads import run_growing
from wrt.core.types import Kernel, WarpStruct
from wrt.core.warp_private import Record, struct_record
from wrt.kernels.build import bvh2 as build_bvh2
from wrt.kernels.build import records as build_records
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.warp_private import fields_of


def build_binned(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build by binned SAH (Wald 2007): fast, with an SAH cost within a few per cent of the full sweep."""
    return split_ranges("binned", primitive_records(geometry, threads), options, threads)


def build_median(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build by object medians along the longest axis, without the surface area heuristic."""
    return split_ranges("median", primitive_records(geometry, threads), options, threads)


def build_sweep(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build by full-sweep SAH: try every split of a range by centroid, along all three axes."""
    build = in_order(*geometry.bounds(threads))
    return split_ranges("sweep", build, options, threads, **sweep_arrays(build, np.zeros(len(build), np.int32)))


def sweep_arrays(build: np.ndarray, tree: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of BuildData that only the full sweep reads. build: BuildRecords; tree: ascending index of each record's tree."""
    n = len(build)
    with np.errstate(invalid="ignore"):  # NaN, and boxes of all space
        center = 0.5 * build["lo"] + 0.5 * build["hi"]
    order = np.concatenate([np.lexsort((center[:, axis], tree)) for axis in range(3)]).astype(np.int32)
    return {"boxes": build.copy(), "order": order, "area": np.empty(n, np.float32), "left": np.empty(n, np.uint8),
            "scratch": np.empty(n, np.int32)}


def primitive_records(geometry: Geometry, threads: int) -> np.ndarray:
    """Make kernels.build.records.BuildRecord records of all primitives."""
    build = records(build_records.BuildRecord, len(geometry))
    build["prim_id"] = np.arange(len(geometry))
    geometry.bounds(threads, out=(build["lo"], build["hi"]))
    return build


def in_order(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Make BuildRecords of boxes lo, hi (N, 3) float32, in the order of prim_id."""
    build = records(build_records.BuildRecord, len(lo))
    build["prim_id"], build["lo"], build["hi"] = np.arange(len(lo)), lo, hi
    return build


def build_data(**fields: np.ndarray | float) -> Record:
    """Make a record of kernels.build.records.BuildData with these fields. The caller keeps the arrays."""
    return struct_record(build_records.BuildData, [fields.get(name) for name in fields_of(build_records.BuildData)])


def split_ranges(builder: str, build: np.ndarray, options: BvhOptions, threads: int, **arrays: np.ndarray) -> BinaryTree:
    """Build over the BuildRecords `build`. builder: key of kernels.build.bvh2.SPLIT. arrays: other fields of BuildData that it reads."""
    n = len(build)
    if n <= 1:
        return small_tree(build["lo"], build["hi"])
    nodes, used = records(Bvh2Node, n - 1), np.zeros(n - 1, np.uint8)
    data = build_data(records=build, nodes=nodes, used=used, **arrays)
    depth = run_tasks(build_bvh2.make_build_ranges(build_bvh2.SPLIT[builder]), data, build_options(options), n, threads)
    return BinaryTree(squeeze(nodes, used != 0), build["prim_id"].copy(), depth)


def build_sbvh(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build by binned SAH, with spatial splits where the sides of an object split overlap (Stich et al. 2009).

    A primitive may be in several leaves.
    """
    from wrt.kernels.build.sbvh import share_space, split_references  # not at the top, because a start does not need it

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
    depth = run_tasks(build_bvh2.make_build_ranges(split_references, share_space), data, build_options(options), n, threads, capacity)
    return compact(squeeze(nodes, used != 0), build["prim_id"], left != 0, depth)


def compact(nodes: np.ndarray, prim_id: np.ndarray, used: np.ndarray, depth: int) -> BinaryTree:
    """Return the finished tree, without the gaps between the primitives of its leaves. used: mask of the leaves' primitives."""
    index = np.cumsum(used, dtype=np.int32) - 1
    for side in ("0", "1"):
        leaf = nodes["count_" + side] > 0
        nodes["first_" + side][leaf] = index[nodes["first_" + side][leaf]]
    return BinaryTree(nodes, prim_id[used], depth)


def build_forest(builder: str, low: np.ndarray, high: np.ndarray, first: np.ndarray, options: BvhOptions) -> tuple[BinaryTree, np.ndarray]:
    """Build a tree over each range of boxes first[i] .. first[i + 1] - 1, all of them in one launch.

    Return the trees one after another, of which BinaryTree.depth is the largest depth, and the index of each root, (T,) int32.
    """
    count = np.diff(first)
    # A tree has as many slots for nodes as it has boxes, at least one.
    slot = np.cumsum([0, *np.maximum(count, 1)])
    nodes = records(Bvh2Node, int(slot[-1]))
    used = np.zeros(len(nodes), np.uint8)
    for side in "01":
        nodes["lo_" + side], nodes["hi_" + side] = np.inf, -np.inf
    used[slot[:-1][count < 2]] = 1
    alone, many = np.flatnonzero(count == 1), np.flatnonzero(count > 1)
    for name, value in (("lo_0", low[first[alone]]), ("hi_0", high[first[alone]]), ("first_0", first[alone]), ("count_0", 1)):
        nodes[name][slot[alone]] = value
    tasks = records(build_records.BuildTask, len(many))
    tasks["begin"], tasks["end"], tasks["slot"], tasks["parent"] = first[many], first[many + 1], slot[many], -1
    build, (depth, none) = in_order(low, high), np.zeros((2, 1), np.int32)
    arrays = sweep_arrays(build, np.repeat(np.arange(len(count)), count)) if builder == "sweep" else {}
    data, kernel = build_data(records=build, nodes=nodes, used=used, **arrays), build_bvh2.make_build_ranges(build_bvh2.SPLIT[builder])
    launch_raw(kernel, len(tasks), data, tasks, build_options(options), 0, records(build_records.BuildTask, 1), none, depth)
    roots = (np.cumsum(used != 0) - 1)[slot[:-1]].astype(np.int32)
    return BinaryTree(squeeze(nodes, used != 0), build["prim_id"].copy(), int(depth[0]) + 1), roots


def build_few(boxes: list[tuple[np.ndarray, np.ndarray]], options: BvhOptions) -> list[BinaryTree]:
    """Build a tree by full-sweep SAH over each pair of boxes lo, hi (n, 3) float32, with two boxes or more."""
    if not boxes:
        return []
    first = np.cumsum([0, *(len(lo) for lo, _ in boxes)])
    low, high = (np.concatenate(ends) for ends in zip(*boxes, strict=True))
    forest, roots = build_forest("sweep", low, high, first, options)
    nodes, begin = forest.nodes, np.append(roots, len(forest.nodes))
    for side in "01":
        leaf = nodes["count_" + side] > 0
        nodes["first_" + side] -= np.where(leaf, np.repeat(first[:-1], np.diff(begin)), np.repeat(roots, np.diff(begin))).astype(np.int32)
    return [BinaryTree(nodes[begin[i]:begin[i + 1]].copy(), forest.order[first[i]:first[i + 1]] - np.int32(first[i]), forest.depth)
            for i in range(len(boxes))]


def build_options(options: BvhOptions) -> WarpStruct:
    """Convert the options to kernels.build.records.BuildOptions."""
    out = build_records.BuildOptions()
    out.max_leaf, out.row = options.max_leaf, options.row
    out.cost_traversal, out.cost_intersection = options.cost_traversal, options.cost_intersection
    return out


def run_tasks(kernel: Kernel, data: Record, options: WarpStruct, n: int, threads: int, capacity: int = 0) -> int:
    """Build the tree over n records on all threads, and return its depth. The tree does not depend on `threads`.

    A task with a large range of records splits it into parts of about half its size or less. Each part becomes a new task.
    capacity: number of records that the arrays can hold, for builders that duplicate references.
    """
    load_kernel(kernel, start("cpu"))
    least = max(n // 64, 4096)
    depths = []

    def begin(task: np.ndarray) -> tuple[Any, Any]:
        size = int(task["end"][0] - task["begin"][0])
        stop = max(size // 2, least) if threads > 1 and size > least else 0
        # New tasks are disjoint ranges of at least two records, which bounds their number.
        most = (max(int(task["limit"][0]), int(task["end"][0])) - int(task["begin"][0])) // 2 if stop else 1
        deferred = np.empty(most, record_dtype(build_records.BuildTask))
        count, depth = np.zeros((2, 1), np.int32)

        def parts() -> list[np.ndarray]:
            depths.append(int(depth[0]))
            return [deferred[i : i + 1] for i in range(int(count[0]))]

        return partial(launch_raw, kernel, 1, data, task, options, stop, deferred, count, depth), parts

    root = records(build_records.BuildTask, 1)
    root["end"], root["parent"], root["limit"] = n, -1, capacity
    run_growing(begin, [root], threads if n > least else 1)
    return max(depths) + 1
