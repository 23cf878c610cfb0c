"""Binary BVH with boxes, and the base class of binary BVHs with other bounding volumes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.box_tree import ABSENT, BoxTree
from wrt.accel.bvh.builders import BinaryOptions, BvhOptions, binary_tree_of, build_binary, sah_cost
from wrt.accel.bvh.in_place import InPlaceBvh
from wrt.accel.bvh.lbvh import build_on
from wrt.accel.bvh.refit import Fitting, parents_of, tree_of
from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.geometry import Geometry, NumberedGeometry
from wrt.accel.snapshot import Built
from wrt.accel.store import check_binary
from wrt.core.device import launch_on, upload
from wrt.core.types import ArrayLike, WarpArray, WarpStruct
from wrt.kernels.build.shape import write_corners
from wrt.kernels.structs import Primitive
from wrt.kernels.traverse import bvh2 as kernels

RECORDS_PER_JOB = 32768


class BinaryBvh(OneMesh):
    """A binary tree of bounding volumes. Options: BinaryOptions."""

    options = BinaryOptions
    can_refit = True

    def _build(self, options: BinaryOptions) -> Built:
        return self._by(BvhOptions(**asdict(options)))

    def _by(self, options: BvhOptions) -> Built:
        tree = build_binary(self.geometry, options, self.threads)
        return self._around(tree.nodes, tree.order, tree.leaves, tree.depth)

    @abstractmethod
    def _around(self, nodes: np.ndarray, order: np.ndarray, leaves: int, depth: int) -> Built:
        """Make the builder's result from a binary tree. nodes: Bvh2Node records; other arguments as in Built."""

    def _box_tree(self, built: Built) -> BoxTree:
        return box_tree(self._boxes(built), built.order)

    def _boxes(self, built: Built) -> np.ndarray:
        """Return Bvh2Node records with the structure's links and boxes around its volumes."""
        return built.arrays["nodes"]

    def _built_of(self, tree: BoxTree) -> Built:
        binary = binary_tree_of(tree)
        return self._around(binary.nodes, binary.order, binary.leaves, binary.depth)

    def _check(self, built: Built) -> None:
        check_binary(built.arrays["nodes"], len(built.order), kernels.STACK_SIZE)


def box_tree(nodes: np.ndarray, order: np.ndarray) -> BoxTree:
    """Convert Bvh2Node records to a BoxTree."""
    lo, hi, first, count = (np.stack([nodes[part + "_0"], nodes[part + "_1"]], axis=1) for part in ("lo", "hi", "first", "count"))
    return BoxTree(lo, hi, first.astype(np.int32), np.where(lo[..., 0] > hi[..., 0], ABSENT, count).astype(np.int32), order)


class Bvh2(InPlaceBvh, BinaryBvh):
    __doc__ = BinaryBvh.__doc__

    name = "bvh2"
    kernels = kernels

    def _by(self, options: BvhOptions) -> Built:
        if options.builder != "lbvh" or len(self.geometry) < 2:
            return super()._by(options)
        nodes, parents, order, root = build_on(self.device, self._shape(), options, self.threads)
        return Built({"nodes": nodes}, order, root.inner_nodes, root.inner_nodes + 1, root.height, root.sah_cost, parents)

    def _around(self, nodes: np.ndarray, order: np.ndarray, leaves: int, depth: int) -> Built:
        return Built({"nodes": nodes}, order, len(nodes), leaves, depth, sah_cost(nodes))

    def _on_device(self, built: Built) -> Built:
        """Return `built` with its arrays copied to the device, and with the parents of the nodes."""
        nodes, order = built.arrays["nodes"], built.order
        if not isinstance(order, wp.array):
            nodes, order = upload(nodes.copy(), kernels.Bvh2Node, self.device), upload(order.copy(), wp.int32, self.device)
        return replace(built, arrays={"nodes": nodes}, order=order,
                       parents=parents_of(nodes) if built.parents is None else built.parents)

    def _moved(self, vertices: ArrayLike) -> Geometry:
        if not isinstance(vertices, wp.array):
            return super()._moved(vertices)
        points = wp.clone(self._points(vertices), device=self.device)
        return DeviceGeometry.unchecked(points, self._shape().faces, self.geometry.spheres)

    def _refit(self, built: Built) -> Built:
        """Refit on the device. Only the summary of the root, with the SAH cost, is copied to the host."""
        built = self._on_device(built)
        nodes = wp.clone(built.arrays["nodes"])
        fitting = Fitting(self.device, len(self.geometry), len(nodes))
        fitting.refit(tree_of(fitting, nodes, built.parents, built.order), self._shape(), self.threads)
        return replace(built, arrays={"nodes": nodes}, sah_cost=fitting.root().sah_cost)

    def _in_place(self, built: Built, shape: WarpStruct) -> tuple[WarpStruct, Callable[[], None]]:
        fitting, data = Fitting(self.device, len(self.geometry), built.nodes), self.data
        tree = tree_of(fitting, data.nodes, parents_of(data.nodes), built.order)

        def run() -> None:
            fitting.refit(tree, shape, self.threads)
            self._write_corners(shape, tree.order, data.primitives)

        return tree, run

    def _primitives(self, built: Built) -> np.ndarray | WarpArray:
        """Return the triangle test's records.

        The device makes them if `order` is a Warp array, a record holds three corners, and the geometry is no NumberedGeometry.
        """
        if (not isinstance(built.order, wp.array) or self.structure.units.triangle_test.layout != "corners"
                or isinstance(self.geometry, NumberedGeometry)):
            return super()._primitives(built.on_host())
        out = wp.empty(len(built.order), dtype=Primitive, device=self.device)
        self._write_corners(self._shape(), built.order, out)
        return out

    def _write_corners(self, shape: WarpStruct, order: WarpArray, out: WarpArray) -> None:
        launch_on(self.device, write_corners, len(order), shape, order, out, None, threads=self.threads, step=RECORDS_PER_JOB,
                  captured=True)
