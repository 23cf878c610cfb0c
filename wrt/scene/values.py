"""Checks of the values of a scene: numbers, vectors, colours, transforms, and the forms of described fields (wrt.scene.kinds)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from wrt.core.checks import LARGEST, as_array, as_choice, as_integer, as_one, as_size, shown
from wrt.core.errors import InputError, warn, wrong

Color = tuple[float, float, float]
Limits = dict[str, Any]  # limits of a described field: the keywords of wrt.scene.kinds.given
BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
ROUNDING = 2.0**-22  # relative; of a value that float32 arithmetic took past a limit
SMALLEST = 1e-30  # smallest length
MAX_OBJECTS = 1 << 20  # largest number of objects, of spheres and of lights
FAR = 32.0  # coordinates of float64 that are larger than this multiple of half their extent lose 5 bits or more in float32
FAR_IN_FLOAT32 = 256.0  # float32 coordinates this far from 0 have lost 8 bits: a warning
FAR_IN_A_SCENE = 2.0**14  # an object farther from the scene's 0, in units and in half its size, loses too many digits: a warning
MAX_REACH = 1e18  # largest coordinate in world space: squared distances must not overflow float32


def far_origin(low: np.ndarray, high: np.ndarray, far: float = FAR) -> np.ndarray | None:
    """Return a point near the middle of a box that is far from 0, (3,) float64, or None for other boxes. low, high: (3,).

    Its coordinates have few bits: subtracting them from a coordinate in the box rounds nothing."""
    with np.errstate(all="ignore"):
        half = float((high / 2.0 - low / 2.0).max(initial=0.0))
        if not (0.0 < half < math.inf and float(np.maximum(-low, high).max()) > far * half):
            return None
    step = 2.0 ** (math.frexp(half)[1] - 11)
    return np.asarray(np.round((low / 2.0 + high / 2.0) / step) * step)


def near_zero(positions: np.ndarray, faces: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return positions (N, 3) as float32, and the origin (3,) that was subtracted from those of 8 bytes far from 0, or None.

    faces: indices of the positions that count; None: all. Raises IndexError for indices out of range."""
    origin = None
    if positions.dtype.itemsize > 4 and positions.ndim == 2 and len(positions):
        positions = positions.astype(np.float64, copy=False)
        used = np.full(len(positions), faces is None)
        if faces is not None:
            used[faces.reshape(-1)] = True
        chosen = positions if used.all() else positions[used]
        origin = far_origin(chosen.min(axis=0), chosen.max(axis=0)) if len(chosen) else None
    with np.errstate(over="ignore", invalid="ignore"):
        return (positions if origin is None else positions - origin).astype(np.float32, copy=False), origin


def warn_if_far(vertices: np.ndarray, name: str, origin: np.ndarray | None = None) -> None:
    """Warn if float32 vertices (V, 3) without `origin` are so far from 0 that their rounding shows. name: of the mesh."""
    if origin is None and vertices.dtype == np.float32 and len(vertices):
        _warn_of_box(vertices.min(axis=0), vertices.max(axis=0), f"{name or 'a mesh'}: its float32 vertices", FAR_IN_FLOAT32,
                     "give them as float64, or nearer to 0")


def warn_if_alone(low: np.ndarray, high: np.ndarray, name: str) -> None:
    """Warn if shapes in a box (low and high, (3,)) lose digits because others of their scene lie near 0."""
    if np.maximum(-low, high).max() > FAR_IN_A_SCENE:
        hint = "other shapes lie near 0: build what lies far from them by itself"
        _warn_of_box(low, high, f"{name}: its vertices", FAR_IN_A_SCENE, hint)


def _warn_of_box(low: np.ndarray, high: np.ndarray, name: str, far: float, hint: str) -> None:
    if far_origin(low, high, far) is not None:
        reach = np.float32(np.maximum(-low, high).max())
        warn(f"{name} lie up to {reach:.6g} units from 0, where float32 has steps of {np.spacing(reach):.2g} units; {hint}")


def type_of(places: np.ndarray) -> type:
    """Return np.float64 for places (..., 3) that float32 would round with steps above 1e-4, those beyond 1,024; else np.float32."""
    return np.float64 if (np.abs(places) > 1024.0).any() and (places.astype(np.float32) != places).any() else np.float32


def shift(origin: np.ndarray | None, sign: float = 1.0) -> np.ndarray:
    """Return the (4, 4) matrix that adds `origin`, or subtracts it with the sign -1."""
    matrix = np.eye(4)
    if origin is not None:
        matrix[:3, 3] = sign * origin
    return matrix


def rounded(value: float, low: float, high: float) -> float:
    """Return the value, or a limit that it exceeds by no more than a rounding to float32."""
    for limit in (low, high):
        if abs(value - limit) <= ROUNDING * abs(limit):
            value = min(max(value, low), high)
    return value


def as_vector(value: object, what: str, *, low: float = -math.inf, high: float = math.inf) -> Color:
    """Return three finite floats in [low, high], `rounded`; a single number is repeated. Raises InputError that names `what`."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise wrong(what, f"must be three numbers, got {shown(value)}") from error
    if array.ndim == 0:
        array = np.repeat(array, 3)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise wrong(what, f"must be three finite numbers, got {shown(value)}")
    low, high = max(low, -LARGEST), min(high, LARGEST)
    red, green, blue = (rounded(each, low, high) for each in array.tolist())
    if min(red, green, blue) < low or max(red, green, blue) > high:
        raise wrong(what, f"must lie in [{low:g}, {high:g}], got {array.tolist()}")
    return (red, green, blue)


def as_number(value: object, what: str, *, low: float = -math.inf, high: float = math.inf, unit: str = "") -> float:
    """Return one finite float in [low, high], `rounded`. Raises InputError that names `what` and the unit."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise wrong(what, f"must be a number, got {shown(value)}") from error
    low, high = max(low, -LARGEST), min(high, LARGEST)
    number = rounded(number, low, high)
    if not math.isfinite(number) or not low <= number <= high:
        raise wrong(what, f"must be finite and in [{low:g}, {high:g}]{unit and ' ' + unit}, got {shown(value)}")
    return number


def as_transform(value: object, what: str) -> np.ndarray:
    """Return a (4, 4) float64 affine matrix that acts on column vectors.

    Raises InputError unless the matrix is finite, (4, 4) and affine. It may be singular: glTF files hide nodes by a scale of 0."""
    matrix = as_array(value, np.float64, what)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise wrong(what, f"must be a finite 4x4 matrix, got shape {matrix.shape}")
    if max(map(abs, (matrix[3] - (0.0, 0.0, 0.0, 1.0)).tolist())) > 1e-6:
        raise wrong(what, f"must be affine (last row 0 0 0 1), got {matrix[3].tolist()}")
    return matrix


def require_count(count: int, what: str) -> None:
    """Raise InputError if `count` exceeds MAX_OBJECTS. what: the plural noun for what is counted, such as "lights"."""
    if count > MAX_OBJECTS:
        raise InputError(f"{count} {what}", hint=f"a scene holds at most {MAX_OBJECTS}")


def as_direction(value: object, what: str) -> Color:
    """Return a vector of any length scaled to length 1. A vector that has this length already keeps its bits, as `Scene.save` needs."""
    vector = as_vector(value, what)
    length = math.hypot(*vector)
    if length == 0.0:
        raise wrong(what, "must not be zero")
    return vector if abs(length - 1.0) <= 2.0**-51 else (vector[0] / length, vector[1] / length, vector[2] / length)


def _number(value: Any, what: str, limits: Limits, unit: float = 1.0) -> float:
    low = max(limits.get(each, -math.inf) for each in ("ge", "gt"))
    high = min(limits.get(each, math.inf) for each in ("le", "lt"))
    return as_number(value, what, low=low * unit, high=high * unit, unit="" if unit == 1.0 else "radians")


def _image(value: Any, what: str, limits: Limits) -> np.ndarray:
    image = as_array(value, np.float32, what)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise wrong(what, f"must be (H, W, 3), got {image.shape}")
    if not np.isfinite(image).all() or (image < 0.0).any():
        raise wrong(what, "must be finite and not negative")
    return image


# Forms of a field. The function of a form checks and converts a value. Its arguments: the value, its name in messages, the limits.
FORMS: dict[str, Callable[[Any, str, Limits], Any]] = {
    "point": lambda value, what, limits: as_vector(value, what),  # in world space; a transform moves it
    "direction": lambda value, what, limits: as_direction(value, what),  # of any length, stored at 1; a transform turns it
    "color": lambda value, what, limits: as_vector(value, what, low=0.0, high=limits.get("le", math.inf)),
    "number": _number,
    "angle": lambda value, what, limits: _number(value, what, limits, math.pi / 180.0),  # radians; degrees in files and limits
    "whole": lambda value, what, limits: as_integer(value, what, limits["ge"], limits["le"]),
    "flag": lambda value, what, limits: value,
    "choice": lambda value, what, limits: as_choice(value, limits["among"], what),
    "size": lambda value, what, limits: as_size(value, what),
    "image": _image,  # (H, W, 3) float32 linear radiance; a scene file names an image file
    "texture": lambda value, what, limits: as_one(value, limits["among"], what),
}
