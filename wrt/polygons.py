"""Polygons of mesh files become triangles: a fan where that is right, ear clipping where the polygon is concave."""

from __future__ import annotations

import numpy as np


def triangulate(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons into triangles, in the order of the polygons and with their winding.

    corners: (C,) integers, the vertex indices of all polygons in a row; counts: (P,) corners of each polygon;
    vertices: (V, 3) positions. Returns (T, 3) int64 indices into `corners`, and (T,) int64, the polygon each triangle
    is of. A polygon of n corners gives n - 2 triangles, one with fewer than three gives none. Convex polygons become
    the fan about their first corner. A polygon is concave where a triangle of that fan faces against the polygon's
    own area vector; it is projected along that vector and cut by ear clipping (Meisters 1975). Self-intersecting
    polygons have no right answer: they get triangles all the same.
    """
    counts = np.asarray(counts, dtype=np.int64)
    start = np.cumsum(counts) - counts
    fan = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), fan)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(fan) - fan, fan)
    first = start[polygon]
    triangles = np.stack([first, first + step + 1, first + step + 2], axis=1)
    if len(polygon) == 0 or counts.max() == 3:
        return triangles, polygon

    several = np.nonzero(counts[polygon] > 3)[0]  # triangles need no second look
    points = np.asarray(vertices, dtype=np.float64)[np.asarray(corners)[triangles[several]]]
    with np.errstate(invalid="ignore", over="ignore"):
        normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        area = np.stack([np.bincount(polygon[several], normal[:, axis], len(counts)) for axis in range(3)], axis=1)
        against = (normal * area[polygon[several]]).sum(axis=1) < 0.0
    for concave in np.unique(polygon[several[against]]):
        begin, n = int(start[concave]), int(counts[concave])
        outline = np.asarray(vertices, dtype=np.float64)[np.asarray(corners)[begin:begin + n]]
        row = int(np.searchsorted(polygon, concave))
        triangles[row:row + n - 2] = begin + _clip_ears(outline, area[concave])
    return triangles, polygon


def _clip_ears(outline: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n - 2, 3) indices into the (n, 3) outline of one polygon, seen along `normal`."""
    drop = int(np.argmax(np.abs(normal)))
    keep = [(1, 2), (2, 0), (0, 1)][drop]
    flat = outline[:, keep] * np.array([1.0, 1.0 if normal[drop] > 0.0 else -1.0])
    left = list(range(len(flat)))
    triangles = []
    while len(left) > 3:
        ear = next((i for i in range(len(left)) if _is_ear(flat, left, i)), 0)
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return np.array([*triangles, left])


def _is_ear(flat: np.ndarray, left: list[int], i: int) -> bool:
    """Whether the corner `left[i]` is convex and its triangle holds no other corner that is left."""
    corner = [left[i - 1], left[i], left[(i + 1) % len(left)]]
    a, b, c = flat[corner]
    if _turn(a, b, c) <= 0.0:
        return False
    others = flat[[j for j in left if j not in corner]]
    # A corner at the place of one of the three (a seam of a polygon with a hole) does not block the ear.
    apart = ~(others[:, None, :] == flat[corner][None]).all(axis=2).any(axis=1)
    inside = (_turn(a, b, others) >= 0.0) & (_turn(b, c, others) >= 0.0) & (_turn(c, a, others) >= 0.0)
    return not bool((inside & apart).any())


def _turn(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Twice the signed area of a, b, p: positive for a left turn. p may be (n, 2)."""
    return (b[0] - a[0]) * (p[..., 1] - a[1]) - (b[1] - a[1]) * (p[..., 0] - a[0])
