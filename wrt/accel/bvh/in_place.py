"""Refits in place: kernels write the nodes and the records of a BVH anew, on its device."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.device_geometry import DeviceGeometry
from wrt.accel.geometry import NumberedGeometry
from wrt.accel.queries.rays import vectors
from wrt.accel.snapshot import Built
from wrt.accel.store import save
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, PathLike, WarpArray, WarpStruct


class InPlace(NamedTuple):
    """What refits in place need. data: the structure's arrays; shape: kernels.build.shape.Shape, which receives the new points."""

    data: WarpStruct
    shape: WarpStruct
    run: Callable[[], None]  # Fits `data` to `shape`.


class InPlaceBvh(OneMesh):
    """A BVH that can be refitted in place."""

    @abstractmethod
    def _copied(self, built: Built) -> Built:
        """Return `built` with copies of its arrays on the device."""

    @abstractmethod
    def _in_place(self, built: Built, shape: WarpStruct) -> Callable[[], None]:
        """Return the function that fits self.data to the points of `shape`. built: from `_copied`, with the arrays of self.data."""

    @abstractmethod
    def _cost(self, built: Built) -> float:
        """Return the SAH cost of arrays on the host."""

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
        cached: InPlace | None = self._cache.get("in place")
        if cached is None or cached.data is not self.data:
            if self.device.is_capturing:
                raise InputError("a graph cannot capture the first refit in place, which allocates memory",
                                 hint="refit in place once before the capture")
            cached = self._cache["in place"] = self._begin_in_place(points)
        wp.copy(cached.shape.vertices, points)
        cached.run()

    def _begin_in_place(self, points: WarpArray) -> InPlace:
        """Give the structure arrays that no snapshot shares; return what refits in place need."""
        before = self._snapshot
        built = replace(self._copied(before.arrays), sah_cost=float("nan"))
        moved = DeviceGeometry.unchecked(wp.clone(points), self._shape().faces, self.geometry.spheres)
        beside = self._over(self.geometry, built, before.built_cost)
        self._snapshot = replace(beside.snapshot, geometry=moved, followed=None, changes=True)
        shape = self._shape()
        return InPlace(self.data, shape, self._in_place(built, shape))

    def save(self, path: PathLike, mesh: bool = False) -> None:
        """Write the structure to a file, as OneMesh.save does. After a refit in place, first compute the SAH cost."""
        snapshot = self.snapshot
        built = snapshot.arrays
        if math.isnan(built.sah_cost):
            snapshot = replace(snapshot, built=replace(built, sah_cost=self._cost(built.on_host())))
        save(snapshot, path, mesh)
