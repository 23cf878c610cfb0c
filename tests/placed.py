"""Build an InstancedGeometry from geometries and transforms, without a scene."""

from __future__ import annotations

import numpy as np

from wrt.accel.geometry import Geometry, InstancedGeometry


def place(*meshes: tuple[Geometry, np.ndarray]) -> InstancedGeometry:
    """Return instances of geometries without spheres: pairs of a geometry and its (4, 4) or (3, 4) object-to-world transform.
    Pairs with the same geometry object share it."""
    parts = {id(geometry): geometry for geometry, _ in meshes}
    index = {key: i for i, key in enumerate(parts)}
    counts = np.array([len(geometry.faces) for geometry, _ in meshes], np.int64)
    return InstancedGeometry(tuple(parts.values()), np.array([index[id(geometry)] for geometry, _ in meshes], np.int32),
                             np.array([matrix[:3] for _, matrix in meshes], np.float64).reshape(-1, 3, 4),
                             np.concatenate([[0], np.cumsum(counts)[:-1]]), int(counts.sum()))
