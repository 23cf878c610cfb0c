"""Refits of binary trees on the CPU and CUDA (kernels: kernels/build/fit.py)."""

from typing import NamedTuple

import warp as wp

from wrt.accel.bvh.builders import half_areas
from wrt.core.device import launch_on, on_host
from wrt.core.types import Device, WarpArray, WarpStruct
from wrt.kernels.build import fit as kernels
from wrt.kernels.build.records import BuildOptions
from wrt.kernels.build.shape import bounds

PRIMITIVES_PER_JOB = 32768


class Root(NamedTuple):
    """Statistics of a whole tree. height: number of inner nodes on the longest path from the root; sah_cost: as in AccelStats."""

    inner_nodes: int
    height: int
    sah_cost: float


class Fitting:
    """Scratch arrays on a device for fitting the boxes of a tree. primitives, nodes: number of primitives, number of inner nodes."""

    def __init__(self, device: Device, primitives: int, nodes: int) -> None:
        self.device, self.primitives, self.nodes = device, primitives, nodes
        self.low, self.high = (wp.empty(primitives, dtype=wp.vec3, device=device) for _ in range(2))
        self.arrived = wp.zeros(nodes, dtype=wp.int32, device=device)
        self.summaries = wp.empty(nodes, dtype=kernels.SubtreeSummary, device=device)

    def find_bounds(self, shape: WarpStruct, threads: int = 1) -> None:
        """Compute the box of each primitive of a kernels.build.shape.Shape."""
        launch_on(self.device, bounds, self.primitives, shape, self.low, self.high, None, threads=threads,
                  step=PRIMITIVES_PER_JOB, captured=True)

    def fit(self, tree: WarpStruct, options: WarpStruct | None = None) -> None:
        """Fit the tree's boxes to the primitives' boxes. options: BuildOptions, to make leaves of subtrees where that costs no more."""
        if options is None:
            options = BuildOptions()
            options.row = 1
        launch_on(self.device, kernels.fit, self.nodes, tree, options, captured=True)

    def refit(self, tree: WarpStruct, shape: WarpStruct, threads: int = 1) -> None:
        """Fit the tree's boxes to the whole primitives of `shape`, even if spatial splits clipped them. A CUDA graph can capture this."""
        self.find_bounds(shape, threads)
        self.fit(tree)

    def root(self) -> Root:
        """Return the statistics of the tree that was fitted last."""
        root = on_host(self.summaries[:1])[0]
        area, unit_cost = float(half_areas(root["lo"], root["hi"])), float(root["unit_cost"])
        return Root(int(root["inner_nodes"]), int(root["height"]), unit_cost / area if area > 0.0 else float(root["size"]))


def tree_of(fitting: Fitting, nodes: WarpArray, parents: WarpArray | None, order: WarpArray) -> WarpStruct:
    """Make a kernels.build.fit.Tree that uses the arrays of `fitting`."""
    tree = kernels.Tree()
    tree.nodes, tree.parents, tree.order = nodes, parents, order
    for name in ("low", "high", "arrived", "summaries"):
        setattr(tree, name, getattr(fitting, name))
    return tree


def parents_of(nodes: WarpArray) -> WarpArray:
    """Return the index of the parent of each Bvh2Node record, on the nodes' device; kernels.build.fit.NO_PARENT for a root."""
    parents = wp.full(len(nodes), kernels.NO_PARENT, dtype=wp.int32, device=nodes.device)
    launch_on(nodes.device, kernels.find_parents, len(nodes), nodes, parents)
    return parents
