"""All hits of rays as other libraries count them: a surface is hit once where a ray meets an edge or a corner of it."""

from __future__ import annotations

import numpy as np

from wrt.accel.all_hits import all_hits, first_hits
from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry

FEW = 4  # hits that most rays have fewer of: one walk finds each, where all_hits takes two
CLOSE_TO_1 = 2.0**-23  # by which u + v in float32 may miss 1 at the edge opposite of corner 0


def every_hit(accel: Accelerator, origins: np.ndarray, directions: np.ndarray, threads: int | None) -> tuple[np.ndarray, ...]:
    """ray, face, t, u, v of each hit, those of a ray together and in order."""
    few = first_hits(accel, FEW, origins, directions, threads=threads)
    many = np.flatnonzero(few.prim_id[:, -1] >= 0)
    few.prim_id[many] = -1
    ray, column = np.nonzero(few.prim_id >= 0)
    found = [ray, *(array[ray, column] for array in (few.prim_id, few.t, few.u, few.v))]
    if len(many):
        more = all_hits(accel, origins[many], directions[many], threads=threads)
        of_many = many[more.ray_id], more.prim_id, more.t, more.u, more.v
        found = [np.concatenate(pair) for pair in zip(found, of_many, strict=True)]
        order = np.argsort(found[0], kind="stable")
        found = [array[order] for array in found]
    ray, face, _, u, v = found
    kept = _each_surface_once(accel.geometry, ray, face, u, v)
    return tuple(array[kept] for array in found)


def _each_surface_once(geometry: Geometry, rays: np.ndarray, faces: np.ndarray, u: np.ndarray,
                       v: np.ndarray) -> np.ndarray | slice:
    """Which hits to keep of those through an edge or a corner, where each face around it is hit.

    Faces of one surface differ in where the edge begins, or, around a corner, in the corner that comes next. Where several
    agree in that, there are as many surfaces. Corners with the same coordinates are one.
    """
    aside = np.stack([1.0 - u - v <= CLOSE_TO_1, u == 0.0, v == 0.0], axis=1)  # of corner 0, 1, 2
    rows = np.flatnonzero(aside.any(axis=1))
    ray, aside = rays[rows], aside[rows]
    shared = np.isin(ray, ray[1:][ray[1:] == ray[:-1]])
    rows, ray, aside = rows[shared], ray[shared], aside[shared]
    if not len(rows):
        return slice(None)
    corners = geometry.vertices[geometry.faces[faces[rows]]] + np.float32(0.0)  # -0 is 0
    place = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
    at_corner, row = aside.sum(axis=1) > 1, np.arange(len(rows))
    k = np.where(at_corner, np.argmin(aside, axis=1), np.argmax(aside, axis=1))  # what is hit, or opposite of the edge that is
    corner, start, end = (place[row, (k + i) % 3] for i in range(3))
    ends = [np.where(at_corner, corner, end_of(start, end)) for end_of in (np.minimum, np.maximum)]
    surface = ranks(np.unique(np.stack([ray, *ends, start], axis=1), axis=0, return_inverse=True)[1].reshape(-1))
    first = np.unique(np.stack([ray, *ends, surface], axis=1), axis=0, return_index=True)[1]
    kept = np.ones(len(rays), bool)
    kept[rows] = False
    kept[rows[first]] = True
    return np.flatnonzero(kept)


def ranks(groups: np.ndarray) -> np.ndarray:
    """How many before each are of its group: (M,) integers."""
    order = np.argsort(groups, kind="stable")
    sizes = np.unique(groups, return_counts=True)[1]
    out = np.empty(len(groups), np.int64)
    out[order] = np.arange(len(groups)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return out
