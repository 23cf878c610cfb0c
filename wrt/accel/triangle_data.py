"""How corners become what a triangle test reads: LAYOUTS, which rows of kernels.units.triangle.RAY_TRIANGLE name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wrt.scene.clean import corners_have_area


def corners(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """The corners as they are. A triangle without area gets NaN for v0, which no ray hits: whether corners are on a line
    is more than float32 or float64 can tell, and is the same for every ray."""
    record["v0"], record["v1"], record["v2"] = v0, v1, v2
    record["v0"][~corners_have_area(v0, v1, v2)] = np.nan


def edges(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """A corner and the two edges from it, each rounded to float32."""
    with np.errstate(over="ignore"):
        record["v0"], record["v1"], record["v2"] = v0, v1 - v0, v2 - v0


def transform(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """The affine map from world space to the unit triangle, in float64, rounded once: rows a (u), b (v), c (height).

    The third axis is the unit normal, so that c is the triangle's plane. A triangle without area gets zeros: its slope is 0,
    which no ray hits.
    """
    p = v0.astype(np.float64)
    e1, e2 = v1 - p, v2 - p
    normal = np.cross(e1, e2)
    area2 = (normal * normal).sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rows = {"a": np.cross(e2, normal) / area2, "b": np.cross(normal, e1) / area2, "c": normal / np.sqrt(area2)}
        for name, row in rows.items():
            row = np.concatenate([row, -(row * p).sum(axis=1, keepdims=True)], axis=1).astype(np.float32)
            record[name] = np.where(np.isfinite(row).all(axis=1, keepdims=True), row, np.float32(0.0))


LAYOUTS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], None]] = {
    "corners": corners,
    "edges": edges,
    "transform": transform,
}
