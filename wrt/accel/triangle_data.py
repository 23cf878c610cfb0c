"""Records of triangle tests, computed from corners. LAYOUTS has a function for each layout in kernels.units.triangle.RAY_TRIANGLE."""

from collections.abc import Callable

import numpy as np

from wrt.scene.clean import corners_have_area


def corners(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """Write the corners to the records. A triangle without area gets NaN for v0, so that no ray hits it.

    Collinearity is decided here in exact arithmetic, because a query in float64 could not decide it.
    """
    record["v0"], record["v1"], record["v2"] = v0, v1, v2
    record["v0"][~corners_have_area(v0, v1, v2)] = np.nan


def edges(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """Write the corner v0 and the edges v1 - v0 and v2 - v0, rounded to float32, to the records."""
    with np.errstate(over="ignore"):
        record["v0"], record["v1"], record["v2"] = v0, v1 - v0, v2 - v0


def transform(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """Write the affine map from world space to the unit triangle, computed in float64: row a gives u, row b gives v, row c the height.

    The third axis is the unit normal, so that c is the triangle's plane. A triangle without area gets zeros, so that no ray hits it.
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


Layout = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], None]
LAYOUTS: dict[str, Layout] = {"corners": corners, "edges": edges, "transform": transform}
