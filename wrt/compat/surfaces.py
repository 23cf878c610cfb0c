"""All hits of rays, counted as in other libraries: a ray through an edge or a corner of a surface hits the surface once."""

import numpy as np

from wrt.accel.points.contains import open_edges_of
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import ALL, ListQuery, first_hits
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.rays import Rays


def every_hit(accel: Accelerator, rays: Rays, threads: int, limit: int = ALL) -> tuple[np.ndarray, ...]:
    """Return ray, face, t, u and v of each hit, ray by ray in order of distance, at most `limit` per ray. rays: see ListQuery.of_valid.

    A ray hits the faces that it crosses (`all_hits` with crossings). A ray that only touches faces hits the first touched face. If
    the mesh is closed, that ray hits up to two touched faces, the nearest ones, as entry and exit.
    """
    query = ListQuery(accel, threads, crossings=True).of_valid(rays)
    crossed = query.all(limit)
    found = [crossed.ray_id, crossed.prim_id, crossed.t, crossed.u, crossed.v]
    if len(rest := np.flatnonzero(query.touches)):
        touched = _touched(accel, rays.of(rest), threads)
        row, column = np.nonzero(touched.prim_id >= 0)
        more = rest[row], *(array[row, column] for array in (touched.prim_id, touched.t, touched.u, touched.v))
        found = [np.concatenate(pair) for pair in zip(found, more, strict=True)]
        order = np.argsort(found[0], kind="stable")
        found = [array[order] for array in found]
    return tuple(found)


def hit_counts(accel: Accelerator, rays: Rays, threads: int) -> np.ndarray:
    """Return the number of hits of each ray in `every_hit`, (N,) int64."""
    query = ListQuery(accel, threads, crossings=True).of_valid(rays)
    counts = query.counts()
    if len(rest := np.flatnonzero(query.touches)):
        counts[rest] = (_touched(accel, rays.of(rest), threads).prim_id >= 0).sum(axis=1)
    return counts


def _touched(accel: Accelerator, rays: Rays, threads: int) -> Hits[np.ndarray]:
    """Return the hits of rays that only touch faces, (N, 1) or (N, 2)."""
    return first_hits(accel, 1 if open_edges_of(accel.snapshot) else 2, *rays, threads=threads)


def scatter(found: np.ndarray, valid: np.ndarray | None, missing: object) -> np.ndarray:
    """Return an array with the rows of `found` where `valid`, and with `missing` elsewhere. valid None: all rows."""
    if valid is None:
        return found
    out = np.full((len(valid), *found.shape[1:]), missing, found.dtype)
    out[valid] = found
    return out
