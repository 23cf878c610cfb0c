"""Top-down builders, which split ranges of primitives in place (kernels: kernels/build/bvh2.py)."""

from functools import partial
from typing import Any

import numpy as np

from wrt.accel.bvh.tree import BinaryTree, BvhOptions, small_tree, squeeze
from wrt.accel.geometry import Geometry
from wrt.accel.queries.raw_kernel import launch_raw
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
    lo, hi = geometry.bounds(threads)
    center = 0.5 * lo + 0.5 * hi
    n = len(lo)
    build = in_order(lo, hi)
    order = np.concatenate([np.argsort(center[:, axis], kind="stable") for axis in range(3)]).astype(np.int32)
    return split_ranges("sweep", build, options, threads, boxes=build.copy(), order=order, area=np.empty(n, np.float32),
                        left=np.empty(n, np.uint8), scratch=np.empty(n, np.int32))


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
