"""Triangulation of the polygons of mesh files: a fan for convex polygons, ear clipping for concave ones."""

import numpy as np

from wrt.core.packages import needed_by


def triangulate(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons into triangles, in the order of the polygons and with their winding.

    corners: (C,) integers, the vertex indices of all polygons in sequence; counts: (P,), the number of corners of each polygon;
    vertices: (V, 3). Returns (T, 3) integers, indices into `corners`, and (T,), the index of each triangle's polygon. A polygon of n
    corners gives n - 2 triangles, or none for n < 3. Convex polygons become the fan about their first corner. A polygon is concave if
    a triangle of its fan faces against its area vector. It is then projected along that vector and cut by ear clipping (mapbox-earcut).
    Self-intersecting polygons have no right answer; they also give n - 2 triangles."""
    counts, corners = np.asarray(counts, dtype=np.int64), np.asarray(corners)
    fan = np.maximum(counts - 2, 0)
    small = np.int32 if max(len(corners), len(counts)) < 1 << 31 else np.int64
    if len(counts) and counts.min() == counts.max() == 3:  # as in most large files
        return np.arange(len(corners), dtype=small).reshape(-1, 3), np.arange(len(counts), dtype=small)
    start = (np.cumsum(counts) - counts).astype(small)
    polygon = np.repeat(np.arange(len(counts), dtype=small), fan)
    step = np.arange(len(polygon), dtype=small) - np.repeat((np.cumsum(fan) - fan).astype(small), fan)
    first = start[polygon]
    triangles = np.stack([first, first + step + 1, first + step + 2], axis=1)
    if len(polygon) == 0 or counts.max() == 3:
        return triangles, polygon

    area, against = _areas(corners, counts, np.asarray(vertices, dtype=np.float64), triangles, polygon)
    for concave in against:
        begin, n = int(start[concave]), int(counts[concave])
        outline = np.asarray(vertices, dtype=np.float64)[np.asarray(corners)[begin:begin + n]]
        row = int(np.searchsorted(polygon, concave))
        triangles[row:row + n - 2] = begin + _ears(outline, area[concave])
    return triangles, polygon


def strip(indices: np.ndarray) -> np.ndarray:
    """Return the triangles (N - 2, 3) of a triangle strip of N vertex indices: each vertex with the two before it."""
    i = np.arange(max(len(indices) - 2, 0), dtype=indices.dtype)
    odd = i & 1  # every second triangle swaps two corners, so that all triangles face the same side
    return indices[np.stack([i, i + 1 + odd, i + 2 - odd], axis=1)]


def _areas(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray, triangles: np.ndarray,
           polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return area vectors (P, 3), of length 2 * area (0 for polygons of up to three corners), and the indices of the concave polygons."""
    area, against = np.zeros((len(counts), 3)), np.zeros(len(counts), dtype=bool)
    large = counts > 3  # triangles are convex
    size, several = counts[large] - 2, large[polygon]
    a, b, c = (vertices.take(corners.take(triangles[several, i]), axis=0) for i in range(3))
    with np.errstate(invalid="ignore", over="ignore"):
        normal = np.cross(b - a, c - a)
        area[large] = np.add.reduceat(normal, np.cumsum(size) - size)
        against[polygon[several][np.einsum("ij,ij->i", normal, np.repeat(area[large], size, axis=0)) < 0.0]] = True
    return area, np.flatnonzero(against)


def _ears(outline: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return triangles (n - 2, 3) of one polygon's outline (n, 3), projected along `normal`.

    Self-intersecting polygons can have fewer than n - 2 ears; they become a fan."""
    with needed_by("a concave polygon"):
        from mapbox_earcut import triangulate_float64

    drop, n = int(np.argmax(np.abs(normal))), len(outline)
    keep = [(1, 2), (2, 0), (0, 1)][drop]
    flat = outline[:, keep] * np.array([1.0, 1.0 if normal[drop] > 0.0 else -1.0])
    ears = triangulate_float64(flat, np.array([n], dtype=np.uint32)).reshape(-1, 3)
    i = np.arange(1, n - 1)
    return ears if len(ears) == n - 2 else np.stack([np.zeros_like(i), i, i + 1], axis=1)
