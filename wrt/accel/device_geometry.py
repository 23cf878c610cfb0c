"""Triangles in Warp arrays, over which bvh2 is built and refitted without a copy to the host."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.arrays import contiguous, to_numpy
from wrt.core.checks import shown
from wrt.core.device import launch_on
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, Device, WarpArray, WarpStruct
from wrt.core.warp_private import refuse_capture
from wrt.kernels.build.shape import Shape, count_outside


class DeviceGeometry(Geometry):
    """A mesh in Warp arrays, an argument of `wrt.build` in place of a `Mesh`. `vertices` and `faces` are copies on the host.

    Both arrays are copied, so that the caller may modify them for a `refit`. Points are not checked: no ray hits a triangle with a
    point that is not finite.

    Parameters
    ----------
    points : Warp array (V,) of vec3
        Vertices on any device.
    indices : Warp array (3 F,) of int32 or (F,) of vec3i
        Vertex indices of the faces, as in `wp.Mesh`, on the device of the points.

    Raises
    ------
    InputError
        For other arrays, and for indices out of range.
    """

    points: WarpArray
    indices: WarpArray

    def __init__(self, points: WarpArray, indices: WarpArray) -> None:
        refuse_capture(points.device if isinstance(points, wp.array) else None)
        points = self.checked_points(points, "points")
        flat = isinstance(indices, wp.array) and indices.dtype == wp.int32 and indices.ndim == 1 and len(indices) % 3 == 0
        if not (flat or (isinstance(indices, wp.array) and indices.dtype == wp.vec3i and indices.ndim == 1)):
            raise InputError(f"must be a Warp array (3 F,) of int32 or (F,) of vec3i, got {shown(indices)}", argument="indices")
        if indices.device != points.device:
            raise InputError(f"must be on {points.device}, as points are, not on {indices.device}", argument="indices")
        indices = wp.clone(indices if indices.is_contiguous else indices.contiguous())
        if flat:
            indices = indices.reshape((len(indices) // 3, 3)).view(wp.vec3i)
        self._set(wp.clone(points), indices, np.zeros((0, 4), np.float32))
        outside = wp.zeros(1, dtype=wp.int32, device=points.device)
        launch_on(points.device, count_outside, len(self), self.indices, len(points), outside, None)
        if n := int(outside.numpy()[0]):
            raise InputError(f"must be 0 to {len(points) - 1}; {n} triangles have other indices", argument="indices")

    def _set(self, points: WarpArray, indices: WarpArray, spheres: np.ndarray) -> DeviceGeometry:
        self.__dict__.update(points=points, indices=indices, spheres=spheres)
        return self

    @staticmethod
    def checked_points(array: ArrayLike, name: str) -> WarpArray:
        """Return a Warp array (V,) of vec3 as a contiguous array. Raises InputError, which names the argument, for anything else."""
        if not (isinstance(array, wp.array) and array.dtype == wp.vec3 and array.ndim == 1):
            raise InputError(f"must be a Warp array (V,) of vec3, got {shown(array)}", argument=name)
        return contiguous(array)

    @staticmethod
    def unchecked(points: WarpArray, indices: WarpArray, spheres: np.ndarray) -> DeviceGeometry:
        """Make a geometry from arrays that are known to be valid. indices: (F,) of vec3i; spheres: as in Geometry."""
        return DeviceGeometry.__new__(DeviceGeometry)._set(points, indices, spheres)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle and deep-copy as a Geometry on the host, because Warp arrays support neither."""
        return Geometry, (self.vertices, self.faces, self.spheres)

    def __len__(self) -> int:
        return len(self.indices) + len(self.spheres)

    @property
    def n_triangles(self) -> int:
        """Number of triangles."""
        return len(self.indices)

    @property
    def n_vertices(self) -> int:
        """Number of points."""
        return len(self.points)

    @property
    def vertices(self) -> np.ndarray:
        """Copy of the points on the host."""
        return to_numpy(self.points)

    @cached_property
    def faces(self) -> np.ndarray:
        """Copy of the indices on the host, (F, 3)."""
        return to_numpy(self.indices)

    def on(self, device: Device, faces: WarpArray | None = None) -> WarpStruct:
        """Convert to kernels.build.shape.Shape on `device`; arrays of another device are copied."""
        shape = Shape()
        shape.vertices, shape.faces = self.points.to(device), self.indices.to(device) if faces is None else faces
        shape.spheres = wp.array(self.spheres, dtype=wp.vec4, device=device)
        return shape
