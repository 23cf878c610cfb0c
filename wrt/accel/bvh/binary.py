"""Binary BVH with boxes, and the base class of binary BVHs with other bounding volumes."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import asdict, replace
from typing import NamedTuple

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.box_tree import ABSENT, BoxTree
from wrt.accel.bvh.builders import BinaryOptions, BvhOptions, binary_tree_of, build_binary, sah_cost
from wrt.accel.bvh.lbvh import build_on
from wrt.accel.bvh.refit import Fitting, parents_of, tree_of
from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.geometry import Geometry, NumberedGeometry
from wrt.accel.queries.rays import vectors
from wrt.accel.snapshot import Built
from wrt.accel.store import check_binary, save
from wrt.core.device import launch_on, upload
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, PathLike, WarpArray, WarpStruct
from wrt.kernels.build.shape import write_corners
from wrt.kernels.structs import Primitive
from wrt.kernels.traverse import bvh2 as kernels

RECORDS_PER_JOB = 32768


class InPlace(NamedTuple):
    """Arrays for refits in place. tree: kernels.build.fit.Tree; shape: kernels.build.shape.Shape, which receives the new points."""

    fitting: Fitting
    tree: WarpStruct
    shape: WarpStruct


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


class Bvh2(BinaryBvh):
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

    def _shape(self) -> WarpStruct:
        """Upload the geometry. Its faces are cached on the device."""
        shape = self.geometry.on(self.device, self._cache.get("faces"))
        self._cache["faces"] = shape.faces
        return shape

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

    def _points(self, vertices: ArrayLike) -> WarpArray:
        points = DeviceGeometry.checked_points(vertices, "vertices")
        if len(points) != self.geometry.n_vertices:
            raise InputError(f"must be ({self.geometry.n_vertices},), got ({len(points)},)", argument="vertices")
        if points.device.is_cpu:
            vectors(points.numpy(), "vertices")
        return points

    def _refit(self, built: Built) -> Built:
        """Refit on the device. Only the summary of the root, with the SAH cost, is copied to the host."""
        built = self._on_device(built)
        nodes = wp.clone(built.arrays["nodes"])
        fitting = Fitting(self.device, len(self.geometry), len(nodes))
        fitting.refit(tree_of(fitting, nodes, built.parents, built.order), self._shape(), self.threads)
        return replace(built, arrays={"nodes": nodes}, sah_cost=fitting.root().sah_cost)

    def _refit_in_place(self, points: ArrayLike) -> None:
        points = self._points(points)
        if points.device != self.device or self.structure.units.triangle_test.layout != "corners":
            raise InputError(f"a refit in place needs a Warp array on {self.device}, and the watertight triangle test",
                             argument="vertices")
        cached: InPlace | None = self._cache.get("in place")
        if cached is None or cached.tree.nodes is not self.data.nodes:
            if self.device.is_capturing:
                raise InputError("a graph cannot capture the first refit in place, which allocates memory",
                                 hint="refit in place once before the capture")
            cached = self._cache["in place"] = self._begin_in_place(points)
        wp.copy(cached.shape.vertices, points)
        cached.fitting.refit(cached.tree, cached.shape, self.threads)
        self._write_corners(cached.shape, cached.tree.order, self.data.primitives)

    def save(self, path: PathLike, mesh: bool = False) -> None:
        """Write the structure to a file, as OneMesh.save does. After a refit in place, first compute the SAH cost."""
        snapshot = self.snapshot
        built = snapshot.arrays
        if math.isnan(built.sah_cost):
            snapshot = replace(snapshot, built=replace(built, sah_cost=sah_cost(built.on_host().arrays["nodes"])))
        save(snapshot, path, mesh)

    def _begin_in_place(self, points: WarpArray) -> InPlace:
        """Give the structure arrays that no snapshot shares; return the arrays that refits in place need."""
        built, spheres = self._on_device(self._snapshot.arrays), self.geometry.spheres
        built = replace(built, arrays={"nodes": wp.clone(built.arrays["nodes"])}, sah_cost=float("nan"))
        moved = DeviceGeometry.unchecked(wp.clone(points), self._shape().faces, spheres)
        beside = self._over(moved, built, self._snapshot.built_cost)
        fitting, shape = Fitting(self.device, len(self.geometry), built.nodes), beside._shape()
        self._snapshot = replace(beside.snapshot, changes=True)
        return InPlace(fitting, tree_of(fitting, self.data.nodes, built.parents, built.order), shape)

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
        launch_on(self.device, write_corners, len(order), shape, order, out, None, threads=self.threads, step=RECORDS_PER_JOB)
