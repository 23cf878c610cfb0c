"""Triangles that are on a device already: Warp's arrays, which need not travel to the host to be built over."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.checks import shown
from wrt.core.device import launch_on
from wrt.core.errors import InputError
from wrt.kernels.build.shape import Shape, count_outside


class DeviceGeometry(Geometry):
    """What wrt.build takes in place of a mesh. points: a Warp array (V,) of vec3; indices: of int32, three a triangle one after
    another, as wp.Mesh has them, or (F,) of vec3i. Both are used where they are; `vertices` and `faces` copy them to the host.

    A structure over it copies the points: they may be written to afterwards (OneMesh.refit follows them). Of their values
    nothing is looked at; a triangle with a point that is not finite is hit by no ray. Raises InputError for other arrays, and for
    indices that lead to no point.
    """

    points: Any
    indices: Any

    def __init__(self, points: Any, indices: Any) -> None:
        points = self.points_of(points, "points")
        flat = isinstance(indices, wp.array) and indices.dtype == wp.int32 and indices.ndim == 1 and len(indices) % 3 == 0
        if not (flat or (isinstance(indices, wp.array) and indices.dtype == wp.vec3i and indices.ndim == 1)):
            raise InputError(f"must be a Warp array (3 F,) of int32 or (F,) of vec3i, got {shown(indices)}", argument="indices")
        if indices.device != points.device:
            raise InputError(f"must be on {points.device}, as points are, not on {indices.device}", argument="indices")
        indices = indices if indices.is_contiguous else indices.contiguous()
        if flat:
            indices = indices.reshape((len(indices) // 3, 3)).view(wp.vec3i)
        self._set(points, indices, np.zeros((0, 4), np.float32))
        outside = wp.zeros(1, dtype=wp.int32, device=points.device)
        launch_on(points.device, count_outside, len(self), self.indices, len(points), outside, None)
        if n := int(outside.numpy()[0]):
            raise InputError(f"must be 0 to {len(points) - 1}; {n} triangles have others", argument="indices")

    def _set(self, points: Any, indices: Any, spheres: np.ndarray) -> DeviceGeometry:
        self.__dict__.update(points=points, indices=indices, spheres=spheres)
        return self

    @staticmethod
    def points_of(array: Any, name: str) -> Any:
        """The array, without gaps. Raises InputError for what is none of points."""
        if not (isinstance(array, wp.array) and array.dtype == wp.vec3 and array.ndim == 1):
            raise InputError(f"must be a Warp array (V,) of vec3, got {shown(array)}", argument=name)
        return array if array.is_contiguous else array.contiguous()

    @staticmethod
    def moved(points: Any, indices: Any, spheres: np.ndarray) -> DeviceGeometry:
        """Of arrays that were looked at before, with spheres; indices: (F,) of vec3i."""
        return DeviceGeometry.__new__(DeviceGeometry)._set(points, indices, spheres)

    def kept(self) -> DeviceGeometry:
        """With points that nobody else writes to."""
        return DeviceGeometry.moved(wp.clone(self.points), self.indices, self.spheres)

    def __reduce__(self) -> Any:
        """For pickle and deepcopy: a Geometry, on the host; Warp's arrays go through neither."""
        return Geometry, (self.vertices, self.faces, self.spheres)

    def __len__(self) -> int:
        return len(self.indices) + len(self.spheres)

    @property
    def n_triangles(self) -> int:
        """How many of the primitives are triangles."""
        return len(self.indices)

    @property
    def n_vertices(self) -> int:
        """How many points there are."""
        return len(self.points)

    @property
    def vertices(self) -> np.ndarray:
        """A copy of the points as they are now."""
        return np.asarray(self.points.numpy())

    @cached_property
    def faces(self) -> np.ndarray:
        """A copy of the indices, (F, 3)."""
        return np.asarray(self.indices.numpy())

    def on(self, device: Any, faces: Any = None) -> Any:
        """As Geometry.on; a copy only of what is on another device."""
        shape = Shape()
        shape.vertices, shape.faces = self.points.to(device), self.indices.to(device) if faces is None else faces
        shape.spheres = wp.array(self.spheres, dtype=wp.vec4, device=device)
        return shape
