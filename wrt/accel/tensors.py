"""Closest hits for libraries of tensors: what wrt.torch and wrt.jax share."""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.queries.accelerator import snapshot_of
from wrt.core.arrays import float32, to_numpy
from wrt.core.errors import InputError


class HitTensors(NamedTuple):
    """Of the closest hits: t, u, v (N,) float32 and prim_id (N,) int32 as Accelerator.closest_hit gives them, and point (N, 3)
    float32, as Hits.point (NaN on a miss)."""

    t: Any
    u: Any
    v: Any
    point: Any
    prim_id: Any


def hits_of(accel: OneMesh, vertices: Any, rays: tuple[Any, ...], rebuild_at: float) -> Any:
    """Hits of closest_hit, once the structure has followed the vertices (None, or as they are: it stays). rays: its arguments.

    Raises InputError that names the argument.
    """
    snapshot_of(accel)
    if vertices is not None:
        now, followed = to_numpy(vertices), accel.geometry.vertices
        if np.may_share_memory(now, followed) or not np.array_equal(float32(now), followed):  # shared: perhaps written to
            accel.refit(vertices, rebuild_at)
    return accel.closest_hit(*rays)


def library(name: str, module: str = "") -> Any:
    """A library that wrt does not need. Raises InputError that says how to get it, where it is not there."""
    try:
        return importlib.import_module(module or name)
    except ImportError as error:
        raise InputError(f"wrt.{name} needs {name} ({error})", hint=f'pip install "wrt[{name}]"') from error
