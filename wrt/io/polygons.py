"""Polygons of mesh files become triangles: a fan where that is right, ear clipping where the polygon is concave."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from wrt.core.packages import needed_by

AT_ONCE = 1 << 16  # triangles


def triangulate(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons into triangles, in the order of the polygons and with their winding.

    corners: (C,) integers, the vertex indices of all polygons in a row; counts: (P,) corners of each polygon;
    vertices: (V, 3) positions. Returns (T, 3) integers, indices into `corners`, and (T,), the polygon each triangle
    is of. A polygon of n corners gives n - 2 triangles, one with fewer than three gives none. Convex polygons become
    the fan about their first corner. A polygon is concave where a triangle of that fan faces against the polygon's
    own area vector; it is projected along that vector and cut by ear clipping (mapbox-earcut). Self-intersecting
    polygons have no right answer: they get triangles all the same.
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
        outline = np.asarray(vertices, dtype=np.float64)[np.asarray(corners)[begin:begin + n]]
        row = int(np.searchsorted(polygon, concave))
        triangles[row:row + n - 2] = begin + _ears(outline, area[concave])
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


def _ears(outline: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n - 2, 3) indices into the (n, 3) outline of one polygon, seen along `normal`; a fan where it has fewer ears, as
    self-intersecting ones have."""
    with needed_by("a concave polygon"):
        from mapbox_earcut import triangulate_float64

    drop, n = int(np.argmax(np.abs(normal))), len(outline)
    keep = [(1, 2), (2, 0), (0, 1)][drop]
    flat = outline[:, keep] * np.array([1.0, 1.0 if normal[drop] > 0.0 else -1.0])
    ears = triangulate_float64(flat, np.array([n], dtype=np.uint32)).reshape(-1, 3)
    i = np.arange(1, n - 1)
    return ears if len(ears) == n - 2 else np.stack([np.zeros_like(i), i, i + 1], axis=1)
