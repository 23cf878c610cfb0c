"""Closest hits for PyTorch and JAX: shared code of wrt.torch and wrt.jax."""

from __future__ import annotations

from typing import Any, Generic, NamedTuple

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import snapshot_of
from wrt.accel.queries.answers import Hits
from wrt.core.arrays import to_numpy
from wrt.core.types import ArrayLike, ArrayT
from wrt.scene.values import near_zero, shift


class HitTensors(NamedTuple, Generic[ArrayT]):
    """Closest hits of N rays as tensors of PyTorch or JAX.

    Attributes
    ----------
    t, u, v : (N,) float32
        As in `Hits`.
    point : (N, 3) float32
        As in `Hits`, but float32 in JAX; NaN on a miss.
    prim_id : (N,) int32
        Index of the face; -1 on a miss.
    """

    t: ArrayT
    u: ArrayT
    v: ArrayT
    point: ArrayT
    prim_id: ArrayT


def hits_of(accel: OneMesh, vertices: ArrayLike | None, rays: tuple[Any, ...], rebuild_at: float) -> Hits[Any]:
    """Refit the structure if `vertices` differ from its own; return closest_hit(*rays). Raises InputError that names the argument."""
    snapshot_of(accel)
    if vertices is not None:
        new, old = at_vertices(accel.geometry, to_numpy(vertices)), accel.geometry
        if not np.array_equal(new.vertices, old.vertices) or not np.array_equal(shift(new.origin), shift(old.origin)):
            accel.refit(vertices, rebuild_at)
    return accel.closest_hit(*rays)


def at_vertices(geometry: Geometry, vertices: np.ndarray) -> Geometry:
    """Return the geometry with other vertices (V, 3)."""
    near, origin = near_zero(vertices)
    return Geometry(near, geometry.faces, geometry.spheres, origin)
