"""Numbers, vectors, colors and transforms of a scene, checked when they are given."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from wrt.core.checks import LARGEST, as_array
from wrt.core.errors import InputError

Color = tuple[float, float, float]
BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec. 709
SMALLEST = 1e-30  # of a length that must not be 0
MAX_OBJECTS = 1 << 20  # and spheres, and lights: a few bytes of a file must not make any number of them
MAX_REACH = 1e18  # of a shape from the origin, in scene units: the square of a distance must be a float32


def as_vector(value: Any, what: str, *, low: float = -math.inf, high: float = math.inf) -> Color:
    """Three finite floats in [low, high]; a single number is taken three times. Raises InputError that names `what`."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be three numbers, got {value!r}") from error
    if array.ndim == 0:
        array = np.repeat(array, 3)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(f"{what} must be three finite numbers, got {value!r}")
    low, high = max(low, -LARGEST), min(high, LARGEST)
    if (array < low).any() or (array > high).any():
        raise InputError(f"{what} must lie in [{low:g}, {high:g}], got {array.tolist()}")
    return (float(array[0]), float(array[1]), float(array[2]))


def as_number(value: Any, what: str, *, low: float = -math.inf, high: float = math.inf) -> float:
    """One finite float in [low, high]. Raises InputError that names `what`."""
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be a number, got {value!r}") from error
    low, high = max(low, -LARGEST), min(high, LARGEST)
    if not math.isfinite(number) or not low <= number <= high:
        raise InputError(f"{what} must be finite and in [{low:g}, {high:g}], got {value!r}")
    return number


def as_transform(value: Any, what: str) -> np.ndarray:
    """A (4, 4) float64 affine matrix that acts on column vectors.

    Raises InputError where it is not finite, not (4, 4) or not affine. A singular one is taken: it flattens what it moves,
    and glTF files hide nodes by a scale of 0. Who cannot do with one asks himself (`Camera`, TOML scenes).
    """
    matrix = as_array(value, np.float64, what)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{what} must be a finite 4x4 matrix, got shape {matrix.shape}")
    if max(map(abs, (matrix[3] - (0.0, 0.0, 0.0, 1.0)).tolist())) > 1e-6:
        raise InputError(f"{what} must be affine (last row 0 0 0 1), got {matrix[3].tolist()}")
    return matrix


def require_count(count: int, what: str) -> None:
    """Raise InputError where a scene would hold too many of something."""
    if count > MAX_OBJECTS:
        raise InputError(f"{count} {what}; a scene holds at most {MAX_OBJECTS}")


def _unit(vector: Color, what: str) -> Color:
    length = math.hypot(*vector)
    if length == 0.0:
        raise InputError(f"{what} must not be zero")
    return (vector[0] / length, vector[1] / length, vector[2] / length)
