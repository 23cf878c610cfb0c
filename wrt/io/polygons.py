"""Polygons of mesh files become triangles: a fan where that is right, ear clipping where the polygon is concave."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np

from wrt.core.errors import InputError

MAX_CORNERS = 1 << 12  # of a concave polygon: the time grows with their square
AT_ONCE = 1 << 16  # triangles
LOOKS = 2  # at all corners of a polygon that seems to have no ear


def triangulate(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons into triangles, in the order of the polygons and with their winding.

    corners: (C,) integers, the vertex indices of all polygons in a row; counts: (P,) corners of each polygon;
    vertices: (V, 3) positions. Returns (T, 3) integers, indices into `corners`, and (T,), the polygon each triangle
    is of. A polygon of n corners gives n - 2 triangles, one with fewer than three gives none. Convex polygons become
    the fan about their first corner. A polygon is concave where a triangle of that fan faces against the polygon's
    own area vector; it is projected along that vector and cut by ear clipping (Meisters 1975). Self-intersecting
    polygons have no right answer: they get triangles all the same. Raises InputError for a concave polygon of more than
    MAX_CORNERS corners.
    """
    counts, corners = np.asarray(counts, dtype=np.int64), np.asarray(corners)
    fan = np.maximum(counts - 2, 0)
    small = np.int32 if max(len(corners), len(counts)) < 1 << 31 else np.int64
    if (counts == 3).all():
        return np.arange(3 * len(counts), dtype=small).reshape(-1, 3), np.arange(len(counts), dtype=small)
    start = np.cumsum(counts) - counts
    polygon = np.repeat(np.arange(len(counts), dtype=small), fan)
    step = np.arange(len(polygon), dtype=small) - np.repeat((np.cumsum(fan) - fan).astype(small), fan)
    triangles = np.empty((len(polygon), 3), small)
    triangles[:, 0] = start[polygon]
    for i in (1, 2):
        np.add(triangles[:, 0], step, out=triangles[:, i])
        triangles[:, i] += i
    del step
    if len(polygon) == 0 or counts.max() == 3:
        return triangles, polygon

    area, against = _areas(corners, counts, np.asarray(vertices, dtype=np.float64), triangles, polygon)
    for concave in against:
        begin, n = int(start[concave]), int(counts[concave])
        if n > MAX_CORNERS:
            raise InputError(f"is concave and has {n} corners; at most {MAX_CORNERS} can be cut into triangles", None,
                             f"polygon {concave}")
        outline = np.asarray(vertices, dtype=np.float64)[np.asarray(corners)[begin:begin + n]]
        row = int(np.searchsorted(polygon, concave))
        triangles[row:row + n - 2] = begin + _clip_ears(outline, area[concave])
    return triangles, polygon


def _areas(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray, triangles: np.ndarray,
           polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The area vectors (P, 3) of the polygons of more than three corners (twice the area long), and the numbers of those that have
    a triangle which faces against theirs."""
    area, against = np.zeros((len(counts), 3)), np.zeros(len(counts), dtype=bool)

    def normals() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for begin in range(0, len(polygon), AT_ONCE):
            part = slice(begin, begin + AT_ONCE)
            several = counts[polygon[part]] > 3  # triangles need no second look
            points = vertices[corners[triangles[part][several]]]
            yield polygon[part][several], np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])

    with np.errstate(invalid="ignore", over="ignore"):
        for of, normal in normals():
            np.add.at(area, of, normal)
        for of, normal in normals():
            against[of[(normal * area[of]).sum(axis=1) < 0.0]] = True
    return area, np.flatnonzero(against)


def _clip_ears(outline: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n - 2, 3) indices into the (n, 3) outline of one polygon, seen along `normal`: always the first ear that is left.

    A corner is looked at again only when a neighbour went, and where no ear is found a few times all of them: what is left then has
    no ears, and becomes a fan.
    """
    drop = int(np.argmax(np.abs(normal)))
    keep = [(1, 2), (2, 0), (0, 1)][drop]
    flat = outline[:, keep] * np.array([1.0, 1.0 if normal[drop] > 0.0 else -1.0])
    n = len(flat)
    before, after, left = [*range(-1, n - 1)], [*range(1, n), 0], np.ones(n, dtype=bool)
    before[0] = n - 1
    to_see, looks_at_all = list(range(n)), 1  # a heap
    triangles = []
    for _ in range(n - 3):
        ear = -1
        while ear < 0:
            if not to_see:
                if looks_at_all == LOOKS:
                    ear = int(np.argmax(left))
                    break
                to_see, looks_at_all = np.flatnonzero(left).tolist(), looks_at_all + 1
            i = heapq.heappop(to_see)
            if left[i] and _is_ear(flat, left, [before[i], i, after[i]]):
                ear = i
        a, b = before[ear], after[ear]
        triangles.append((a, ear, b))
        left[ear], after[a], before[b] = False, b, a
        if looks_at_all < LOOKS or to_see:
            heapq.heappush(to_see, a)
            heapq.heappush(to_see, b)
    return np.array([*triangles, np.flatnonzero(left).tolist()])


def _is_ear(flat: np.ndarray, left: np.ndarray, corner: list[int]) -> bool:
    """Whether the middle one of three corners is convex and their triangle holds no other corner that is left."""
    a, b, c = flat[corner]
    if _turn(a, b, c) <= 0.0:
        return False
    there = left.copy()
    there[corner] = False
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    others = flat[there]
    others = others[((others >= low) & (others <= high)).all(axis=1)]
    for p, q in ((c, a), (a, b), (b, c)):
        others = others[_turn(p, q, others) >= 0.0]
    # A corner at the place of one of the three (a seam of a polygon with a hole) does not block the ear.
    return bool((others[:, None, :] == flat[corner][None]).all(axis=2).any(axis=1).all())


def _turn(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Twice the signed area of a, b, p: positive for a left turn. p may be (n, 2)."""
    return (b[0] - a[0]) * (p[..., 1] - a[1]) - (b[1] - a[1]) * (p[..., 0] - a[0])
