"""Refits in place: kernels write the nodes and the records of a BVH anew, on its device."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace

import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.bvh.builders import expected_cost, half_areas
from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.geometry import NumberedGeometry
from wrt.accel.queries.rays import vectors
from wrt.accel.snapshot import Built
from wrt.accel.store import save
from wrt.core.device import aligned, upload
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, PathLike, WarpArray, WarpStruct
from wrt.kernels.warp_private import fields_of


class InPlaceBvh(OneMesh):
    """A BVH that can be refitted in place."""

    @abstractmethod
    def _in_place(self, built: Built, shape: WarpStruct) -> tuple[WarpStruct, Callable[[], None]]:
        """Return a Tree of kernels.build, and the function that fits it and self.data, the arrays of `built`, to the points of `shape`."""

    def _shape(self) -> WarpStruct:
        """Upload the geometry. Its faces are cached on the device."""
        shape = self.geometry.on(self.device, self._cache.get("faces"))
        self._cache["faces"] = shape.faces
        return shape

    def _points(self, vertices: ArrayLike) -> WarpArray:
        points = DeviceGeometry.checked_points(vertices, "vertices")
        if len(points) != self.geometry.n_vertices:
            raise InputError(f"must be ({self.geometry.n_vertices},), got ({len(points)},)", argument="vertices")
        if points.device.is_cpu and not points.device.is_capturing:
            vectors(points.numpy(), "vertices")
        return points

    def _refit_in_place(self, points: ArrayLike) -> None:
        points = self._points(points)
        if (points.device != self.device or self.structure.units.triangle_test.layout != "corners"
                or isinstance(self.geometry, NumberedGeometry)):
            raise InputError(f"a refit in place needs a Warp array on {self.device}, the watertight triangle test, and no joined objects",
                             argument="vertices")
        data, own, run = self._cache.get("in place", (None, None, None))
        if data is not self.data:
            if self.device.is_capturing:
                raise InputError("a graph cannot capture the first refit in place, which allocates memory",
                                 hint="refit in place once before the capture")
            self._cache["in place"] = _, own, run = self._begin_in_place(points)
        wp.copy(own, points)
        run()

    def _begin_in_place(self, points: WarpArray) -> tuple[WarpStruct, WarpArray, Callable[[], None]]:
        """Give the structure arrays that no snapshot shares; return the arrays, the points that `run` fits them to, and `run`."""
        before = self._snapshot
        built, kind = before.arrays.on_host(), fields_of(self.data)["nodes"].dtype
        nodes, order = (aligned(each.copy()) for each in (built.arrays["nodes"], built.order))
        built = replace(built, arrays={"nodes": upload(nodes, kind, self.device)}, order=upload(order, wp.int32, self.device),
                        sah_cost=float("nan"))
        moved = DeviceGeometry.unchecked(wp.clone(points), self._shape().faces, self.geometry.spheres)
        beside = self._over(self.geometry, built, before.built_cost)
        self._snapshot = replace(beside.snapshot, geometry=moved, followed=None, changes=True)
        self.fitted, run = self._in_place(built, self._shape())
        return self.data, moved.points, run

    def save(self, path: PathLike, mesh: bool = False) -> None:
        """Write the structure to a file, as OneMesh.save does. After a refit in place, first compute the SAH cost."""
        snapshot, built = self.snapshot, self.snapshot.arrays
        if math.isnan(built.sah_cost):
            tree = self._box_tree(built.on_host())
            root = float(half_areas(tree.lo[0].min(axis=0), tree.hi[0].max(axis=0)))
            snapshot = replace(snapshot, built=replace(built, sah_cost=expected_cost(root, half_areas(tree.lo, tree.hi), tree.count)))
        save(snapshot, path, mesh)
