"""Builders from the top down, which split ranges of primitives in place (the loops are Warp kernels, kernels/build_bvh2.py)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.base import Geometry
from wrt.accel.bvh_tree import BinaryTree, BvhOptions, small_tree, squeeze
from wrt.device import records, run_all, start, upload
from wrt.kernels import build_bvh2
from wrt.kernels.traverse_bvh2 import Bvh2Node


def build_binned(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Binned SAH: fast, and within a few per cent of the full sweep."""
    cpu = start("cpu")
    bounds = geometry.bounds()
    n = len(bounds[0])
    if n <= 1:
        return small_tree(*bounds)
    settings = build_bvh2.BuildOptions()
    settings.max_leaf = options.max_leaf
    settings.cost_traversal, settings.cost_intersection = options.cost_traversal, options.cost_intersection
    build = records(build_bvh2.BuildRecord, n)
    build["lo"], build["hi"], build["prim_id"] = bounds[0], bounds[1], np.arange(n)
    nodes = records(Bvh2Node, n - 1)
    used = np.zeros(len(nodes), np.uint8)
    root = records(build_bvh2.BuildTask, 1)
    root["end"] = n
    device_records, device_nodes, device_used = (
        upload(array, dtype, cpu) for array, dtype in
        ((build, build_bvh2.BuildRecord), (nodes, Bvh2Node), (used, wp.uint8)))
    stop_size = max(n // 64, 4096) if threads > 1 else 0
    # Ranges of two or more records that do not overlap: there can be no more of them than this.
    left_over = upload(records(build_bvh2.BuildTask, n // 2 if stop_size else 1), build_bvh2.BuildTask, cpu)
    count = wp.zeros(1, dtype=wp.int32, device=cpu)

    def launch(tasks: Any, depth: Any, task: int, stop: int) -> None:
        wp.launch(build_bvh2.build_ranges, dim=1, device=cpu, inputs=[
            device_records, device_nodes, device_used, tasks, task, settings, stop, left_over, count, depth])

    depth = wp.zeros(1, dtype=wp.int32, device=cpu)
    launch(upload(root, build_bvh2.BuildTask, cpu), depth, 0, stop_size)
    max_depth = int(depth.numpy()[0])
    tasks = left_over.numpy()[: int(count.numpy()[0])]
    if len(tasks):
        # Largest first, so that no thread is left with a big one at the end.
        tasks = tasks[np.argsort(tasks["begin"] - tasks["end"], kind="stable")].copy()
        depth = wp.zeros(len(tasks), dtype=wp.int32, device=cpu)
        device_tasks = upload(tasks, build_bvh2.BuildTask, cpu)
        run_all([partial(launch, device_tasks, depth, i, 0) for i in range(len(tasks))], threads)
        max_depth = max(max_depth, int(depth.numpy().max()))
    return BinaryTree(squeeze(device_nodes.numpy(), device_used.numpy() != 0), device_records.numpy()["prim_id"].copy(),
                      max_depth + 1)
