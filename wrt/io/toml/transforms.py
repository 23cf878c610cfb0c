"""Matrices of the transforms of a TOML scene file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.errors import InputError

if TYPE_CHECKING:
    from wrt.io.toml.schema import TransformTable


def transform(table: TransformTable | None) -> np.ndarray:
    """Return the matrix (4, 4) float64 of a table: scale, then rotate, then translate. None gives the identity.

    Raises InputError for a singular matrix."""
    matrix = np.eye(4)
    if table is None:
        return matrix
    if table.matrix is not None:
        matrix = np.array(table.matrix).reshape(4, 4)
        if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
            raise InputError("the transform's matrix must be invertible")
        return matrix
    if table.axis is not None and table.angle is not None:
        rotation = _about(np.array(table.axis), table.angle)
    else:
        x, y, z = (_about(axis, angle) for axis, angle in zip(np.eye(3), table.rotate, strict=True))
        rotation = z @ y @ x
    matrix[:3, :3] = rotation * table.scale
    matrix[:3, 3] = table.translate
    return matrix


def _about(axis: np.ndarray, degrees: float) -> np.ndarray:
    """Return the (3, 3) matrix of a rotation about an axis (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cosine, sine = cosine_sine(degrees)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)


def cosine_sine(degrees: float) -> tuple[float, float]:
    """Return cosine and sine of an angle. Multiples of 90 degrees are exact, so that axis-parallel edges stay axis-parallel."""
    quarters, rest = divmod(degrees, 90.0)
    if rest == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
