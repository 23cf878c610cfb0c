"""Instances of geometries, put together by hand."""

from __future__ import annotations

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry


def place(*meshes: tuple[Geometry, np.ndarray]) -> InstancedGeometry:
    """Instances of geometries without spheres, each a pair of a geometry and its (4, 4) or (3, 4) transform to the world.
    The same geometry given twice is one part."""
    parts = {id(geometry): geometry for geometry, _ in meshes}
    index = {key: i for i, key in enumerate(parts)}
    counts = np.array([len(geometry.faces) for geometry, _ in meshes], np.int64)
    return InstancedGeometry(tuple(parts.values()), np.array([index[id(geometry)] for geometry, _ in meshes], np.int32),
                             np.array([matrix[:3] for _, matrix in meshes], np.float64).reshape(-1, 3, 4),
                             np.concatenate([[0], np.cumsum(counts)[:-1]]), int(counts.sum()))
