"""The binary BVH, built with binned SAH (the loop itself is a Warp kernel, kernels/build_bvh2.py)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.base import Accelerator, Built
from wrt.device import records, run_all, start, upload
from wrt.errors import InputError
from wrt.kernels import build_bvh2
from wrt.kernels import traverse_bvh2 as kernels


class Bvh2(Accelerator):
    """Options: max_leaf (1 to 64 primitives), cost_traversal and cost_intersection (of the SAH)."""

    name = "bvh2"
    kernels = kernels

    def _build(self, max_leaf: int = 4, cost_traversal: float = 1.0,
               cost_intersection: float = 1.0) -> Built:
        if not 1 <= max_leaf <= 64:
            raise InputError(f"max_leaf must be 1 to 64, got {max_leaf}")
        options = build_bvh2.BuildOptions()
        options.max_leaf, options.cost_traversal, options.cost_intersection = max_leaf, cost_traversal, cost_intersection
        nodes, order, depth = build_nodes(self.geometry.bounds(), options, self.threads)
        leaves = int((nodes["count_0"] > 0).sum() + (nodes["count_1"] > 0).sum())
        return Built({"nodes": nodes}, order, len(nodes), leaves, depth, sah_cost(nodes))


def build_nodes(bounds: tuple[np.ndarray, np.ndarray], options: Any, threads: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Node records, the primitives' order in the leaves (N,) int32, and the depth, from boxes lo, hi (N, 3) float32."""
    cpu = start("cpu")
    n = len(bounds[0])
    build = records(build_bvh2.BuildRecord, n)
    build["lo"], build["hi"], build["prim_id"] = bounds[0], bounds[1], np.arange(n)
    nodes = records(kernels.Bvh2Node, max(n - 1, 1))
    used = np.zeros(len(nodes), np.uint8)
    if n <= 1:
        # The builder splits; a root that has nothing to split is written here.
        nodes["lo_0"], nodes["hi_0"], nodes["lo_1"], nodes["hi_1"] = np.inf, -np.inf, np.inf, -np.inf
        if n == 1:
            nodes["lo_0"], nodes["hi_0"], nodes["count_0"] = bounds[0], bounds[1], 1
        return nodes, np.arange(n, dtype=np.int32), 1

    root = records(build_bvh2.BuildTask, 1)
    root["end"] = n
    device_records, device_nodes, device_used = (
        upload(array, dtype, cpu) for array, dtype in
        ((build, build_bvh2.BuildRecord), (nodes, kernels.Bvh2Node), (used, wp.uint8)))
    stop_size = max(n // 64, 4096) if threads > 1 else 0
    # Ranges of two or more records that do not overlap: there can be no more of them than this.
    left_over = upload(records(build_bvh2.BuildTask, n // 2 if stop_size else 1), build_bvh2.BuildTask, cpu)
    count = wp.zeros(1, dtype=wp.int32, device=cpu)

    def launch(tasks: Any, depth: Any, task: int, stop: int) -> None:
        wp.launch(build_bvh2.build_ranges, dim=1, device=cpu, inputs=[
            device_records, device_nodes, device_used, tasks, task, options, stop, left_over, count, depth])

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
    return squeeze(device_nodes.numpy(), device_used.numpy() != 0), device_records.numpy()["prim_id"].copy(), max_depth + 1


def squeeze(nodes: np.ndarray, used: np.ndarray) -> np.ndarray:
    """The nodes in use, renumbered; their order (a parent before its children, left before right) stays."""
    index = np.cumsum(used, dtype=np.int32) - 1
    out = nodes[used]
    for side in ("0", "1"):
        inner = out["count_" + side] == 0
        out["first_" + side] = np.where(inner, index[np.minimum(out["first_" + side], len(index) - 1)], out["first_" + side])
    return out


def sah_cost(nodes: np.ndarray) -> float:
    """Expected node visits plus triangle tests of a random line that meets the root box (both costing 1)."""
    def area(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
        e = np.clip(hi.astype(np.float64) - lo.astype(np.float64), 0.0, 1e39)
        return e[:, 0] * e[:, 1] + e[:, 1] * e[:, 2] + e[:, 2] * e[:, 0]

    root = area(np.minimum(nodes["lo_0"][:1], nodes["lo_1"][:1]), np.maximum(nodes["hi_0"][:1], nodes["hi_1"][:1]))[0]
    if not root > 0.0:
        return float(nodes["count_0"].sum() + nodes["count_1"].sum())
    total = root  # the root itself is visited
    for side in ("0", "1"):
        areas = area(nodes["lo_" + side], nodes["hi_" + side])
        total += float((areas * np.where(nodes["count_" + side] > 0, nodes["count_" + side], 1.0)).sum())
    return total / root
