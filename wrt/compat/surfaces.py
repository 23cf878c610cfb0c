"""Queries of the adapters, whose rays a kernel of kernels.placed_rays has checked.

All hits are counted as in other libraries: a ray through an edge or a corner of a surface hits the surface once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from wrt.accel.points.contains import open_edges_of
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import ALL, ListQuery, first_hits
from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES
from wrt.accel.queries.batches import Query, trace_query
from wrt.accel.queries.rays import Rays, constant


class GivenRays(NamedTuple):
    """Valid rays: origins and directions (N, 3), t_max (N,), float32. A ray with t_max = -inf hits nothing."""

    origins: np.ndarray
    directions: np.ndarray
    t_max: np.ndarray

    def __getitem__(self, rows: Any) -> GivenRays:  # type: ignore[override]
        return GivenRays(*(array[rows] for array in self))


def empty_rays(n: int) -> GivenRays:
    """Return arrays for n rays."""
    return GivenRays(np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.float32))


def closest_hits(accel: Accelerator, rays: GivenRays, threads: int) -> list[np.ndarray]:
    """Return t, u, v and prim_id of each ray's closest hit."""
    return _traced(accel, rays, threads, HIT_TYPES)


def any_hits(accel: Accelerator, rays: GivenRays, threads: int) -> np.ndarray:
    """Return whether each ray hits anything, (N,) bool."""
    return _traced(accel, rays, threads, ANY_HIT_TYPES)[0]


def _traced(accel: Accelerator, rays: GivenRays, threads: int, types: dict[str, type]) -> list[np.ndarray]:
    """Trace without the checks of closest_hit and any_hit, which take longer than a ray."""
    n = len(rays.t_max)
    out: list[Any] = [np.empty(n, dtype) for dtype in types.values()]
    trace_query(accel.snapshot, Query(Rays(rays.origins, rays.directions, constant(0.0, n), rays.t_max), out, threads))
    return out


def every_hit(accel: Accelerator, rays: GivenRays, threads: int, limit: int = ALL) -> tuple[np.ndarray, ...]:
    """Return ray, face, t, u and v of each hit, ray by ray in order of distance, at most `limit` per ray.

    A ray hits the faces that it crosses (`all_hits` with crossings). A ray that only touches faces hits the first touched face. If
    the mesh is closed, that ray hits up to two touched faces, the nearest ones, as entry and exit.
    """
    crossed = ListQuery(accel, threads, crossings=True).of(rays.origins, rays.directions, t_max=rays.t_max).all(limit)
    found = [crossed.ray_id, crossed.prim_id, crossed.t, crossed.u, crossed.v]
    rest = np.flatnonzero(crossed.counts == 0)
    if len(rest):
        rest = rest[any_hits(accel, rays[rest], threads)]
    if len(rest):
        origins, directions, t_max = rays[rest]
        touched = first_hits(accel, 1 if open_edges_of(accel.snapshot) else 2, origins, directions, t_max=t_max, threads=threads)
        row, column = np.nonzero(touched.prim_id >= 0)
        more = rest[row], *(array[row, column] for array in (touched.prim_id, touched.t, touched.u, touched.v))
        found = [np.concatenate(pair) for pair in zip(found, more, strict=True)]
        order = np.argsort(found[0], kind="stable")
        found = [array[order] for array in found]
    return tuple(found)


def scatter(found: np.ndarray, valid: np.ndarray | None, missing: object) -> np.ndarray:
    """Return an array with the rows of `found` where `valid`, and with `missing` elsewhere. valid None: all rows."""
    if valid is None:
        return found
    out = np.full((len(valid), *found.shape[1:]), missing, found.dtype)
    out[valid] = found
    return out
