"""LBVH builder, along a Morton curve, for the CPU and CUDA (kernels: kernels/build/lbvh.py)."""

import warp as wp

from wrt.accel.bvh.builders import BinaryTree, BvhOptions, small_tree
from wrt.accel.bvh.refit import Fitting, Root, tree_of
from wrt.accel.bvh.top_down import build_options
from wrt.accel.geometry import Geometry
from wrt.core.device import launch_on, on_host, start
from wrt.core.errors import InputError
from wrt.core.types import Device, WarpArray, WarpStruct
from wrt.kernels.build import lbvh as kernels
from wrt.kernels.traverse.bvh2 import Bvh2Node

MOST = 1 << 30  # primitives: the sort needs two entries for each


def build_lbvh(geometry: Geometry, options: BvhOptions, threads: int) -> BinaryTree:
    """Build in the least time of all builders. Only the median builder makes worse trees."""
    if len(geometry) <= 1:
        return small_tree(*geometry.bounds())
    cpu = start("cpu")
    nodes, _, order, root = build_on(cpu, geometry.on(cpu), options, threads)
    return BinaryTree(on_host(nodes).copy(), order.numpy().copy(), root.height)


def build_on(device: Device, shape: WarpStruct, options: BvhOptions,
             threads: int = 1) -> tuple[WarpArray, WarpArray, WarpArray, Root]:
    """Build over at least two primitives; return Bvh2Node records, the nodes' parents, prim_ids of the leaves, and a Root.

    shape: kernels.build.shape.Shape. All arrays stay on the device.
    """
    n = len(shape.faces) + len(shape.spheres)
    if n >= MOST:
        raise InputError(f"must not be lbvh for {MOST} primitives or more, got {n}", argument="builder")
    index_bits, bits = kernels.bits_of(n)
    fitting = Fitting(device, n, n - 1)
    fitting.find_bounds(shape, threads)
    ends = wp.full(2, wp.vec3(wp.inf), dtype=wp.vec3, device=device)
    ends[1:].fill_(wp.vec3(-wp.inf))
    launch_on(device, kernels.measure, min(kernels.PARTS, n), fitting.low, fitting.high, ends)
    keys, order = wp.empty(2 * n, dtype=wp.uint64, device=device), wp.empty(2 * n, dtype=wp.int32, device=device)
    launch_on(device, kernels.write_keys, n, fitting.low, fitting.high, ends, wp.vec2i(index_bits, bits), keys, order, None)
    with device.context_guard:  # radix_sort_pairs uses the current CUDA context
        wp.utils.radix_sort_pairs(keys, order, n, index_bits, index_bits + 3 * bits)
    nodes, parents = (wp.empty(n - 1, dtype=kind, device=device) for kind in (Bvh2Node, wp.int32))
    launch_on(device, kernels.link, n - 1, keys, nodes, parents, None)
    order = wp.clone(order[:n])
    linked = tree_of(fitting, nodes, parents, order)
    fitting.fit(linked, build_options(options))
    out, out_parents = (wp.empty(n - 1, dtype=kind, device=device) for kind in (Bvh2Node, wp.int32))
    launch_on(device, kernels.write_nodes, n - 1, linked, out, out_parents, None)
    root = fitting.root()
    return wp.clone(out[: root.inner_nodes]), wp.clone(out_parents[: root.inner_nodes]), order, root

