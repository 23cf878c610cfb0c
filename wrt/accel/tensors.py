"""Closest hits for PyTorch and JAX: shared code of wrt.torch and wrt.jax."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any, Generic, NamedTuple

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.queries.accelerator import snapshot_of
from wrt.accel.queries.answers import Hits
from wrt.core.arrays import float32, to_numpy
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, ArrayT


class HitTensors(NamedTuple, Generic[ArrayT]):
    """Closest hits of N rays as tensors of PyTorch or JAX.

    Attributes
    ----------
    t, u, v : (N,) float32
        As in `Hits`.
    point : (N, 3) float32
        As in `Hits`; NaN on a miss.
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
        if not np.array_equal(float32(to_numpy(vertices)), accel.geometry.vertices):
            accel.refit(vertices, rebuild_at)
    return accel.closest_hit(*rays)


def library(name: str, module: str = "") -> ModuleType:
    """Import an optional library. If it is missing, raise InputError that says how to install it."""
    try:
        return importlib.import_module(module or name)
    except ImportError as error:
        raise InputError(f"wrt.{name} needs {name} ({error})", hint=f'pip install "wrt[{name}]"') from error
