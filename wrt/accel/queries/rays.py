"""Rays of a query: checks of their values, and their conversion for kernels."""

from collections.abc import Iterable
from ctypes import c_float
from functools import lru_cache
from math import copysign
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.core.arrays import check_no_gradients, contiguous, float32, real_numbers
from wrt.core.device import launch_on, to_device, upload
from wrt.core.errors import InputError
from wrt.core.types import Array, ArrayLike, Device, Kernel, WarpArray, WarpStruct, WarpType
from wrt.core.warp_private import captures_on_cpu, keep
from wrt.kernels.query import FARTHEST, RayArrays, add_origin, subtract_origin
from wrt.kernels.warp_private import fields_of

MISS = 'with invalid="miss", closest_hit and any_hit let such rays miss'
LOWEST = {"t_min": 0.0, "t_max": -np.inf}


class Rays(NamedTuple):
    """Rays whose shapes are checked and whose values are not.

    Either NumPy arrays (N, 3) and (N,) of real numbers, or Warp arrays of vec3 and float32. A NumPy array t_min or t_max has stride
    0 if one value holds for all rays.
    """

    origins: Array
    directions: Array
    t_min: Array
    t_max: Array

    @property
    def as_warp(self) -> bool:
        return isinstance(self.origins, wp.array)

    def on(self, device: Device) -> "Rays":
        """Copy Warp arrays of other devices to `device`."""
        return Rays(*[to_device(array, device) if isinstance(array, wp.array) else array for array in self])

    def of(self, rows: np.ndarray) -> "Rays":
        """Return some of the rays. rows: indices (M,)."""
        return Rays(*(wp.array(array.numpy()[rows], dtype=array.dtype, device=array.device) if isinstance(array, wp.array)
                      else constant(array[0], len(rows)) if array.strides == (0,) and len(array) else array[rows] for array in self))

    def checked(self) -> "Rays":
        """Convert the rays to contiguous float32. Raises InputError for the first value that is not valid.

        If the rays are Warp arrays, only t_min and t_max are checked, and only on the CPU outside of captures.
        """
        if self.as_warp:
            origins, directions = map(contiguous, self[:2])
        else:
            origins = vectors(self.origins, "origins", FARTHEST, MISS)
            directions = vectors(self.directions, "directions", hint=MISS)
            _check_not_zero(directions)
        return Rays(origins, directions, _checked_ends(self.t_min, "t_min"), _checked_ends(self.t_max, "t_max"))


def from_origin(points: Any, origin: np.ndarray | None) -> Any:
    """Return points minus `origin`, subtracted in float64 before they are rounded: NumPy's (N, 3), or Warp's (N,) of vec3 or vec3d."""
    if isinstance(points, wp.array) and (origin is not None or points.dtype == wp.vec3d):
        check_no_gradients("a query of float64 or far from 0", origins=points)
        return _converted(subtract_origin, contiguous(points), origin, wp.vec3)
    return points if origin is None else points - origin


def to_origin(points: Any, origin: np.ndarray | None) -> Any:
    """Return points plus `origin` in float64: NumPy's (N, 3), or Warp's (N,) of vec3d. Without an origin, the points themselves."""
    if isinstance(points, wp.array) and origin is not None:
        return _converted(add_origin, points, origin, wp.vec3d)
    return points if origin is None else points + origin


def _converted(kernel: Kernel, points: WarpArray, origin: np.ndarray | None, kind: WarpType) -> WarpArray:
    out = wp.empty(points.shape, dtype=kind, device=points.device)
    flat = [array.reshape((array.size,)) for array in (points, out)] if points.ndim > 1 else [points, out]
    launch_on(points.device, kernel[points.dtype] if isinstance(kernel, dict) else kernel, out.size, flat[0],
              wp.vec3d(*(np.zeros(3) if origin is None else origin)), flat[1], captured=True)
    return out


def is_valid(origins: np.ndarray, directions: np.ndarray, t_min: np.ndarray, t_max: np.ndarray) -> np.ndarray:
    """Return whether each of some rays is valid, (N,) bool."""
    origins, directions = float32(origins), float32(directions)
    near, finite = (np.abs(origins) <= FARTHEST).all(axis=1), np.isfinite(directions).all(axis=1)
    return near & finite & directions.any(axis=1) & (t_min >= LOWEST["t_min"]) & (t_max >= LOWEST["t_max"])


def rays_on(device: Device, rays: Rays) -> WarpStruct:
    """Check the rays and return them as Warp arrays on a device."""
    return filled(RayArrays, arrays_on(device, rays))


def arrays_on(device: Device, rays: Rays) -> Rays:
    """Check the rays and return them as Warp arrays on a device."""
    out = []
    for array, dtype in zip(rays.checked().on(device), (wp.vec3, wp.vec3, wp.float32, wp.float32), strict=True):
        if not isinstance(array, wp.array):
            one = len(array) > 0 and array.strides == (0,)
            array = constant_array(float(array[0]), len(array), device) if one else upload(array, dtype, device)
        out.append(array)
    return Rays(*out)


def filled(kind: WarpType, arrays: Iterable[Array | None]) -> WarpStruct:
    """Return a Warp struct whose first fields are these arrays."""
    out: WarpStruct = kind()
    for name, array in zip(fields_of(kind), arrays, strict=False):
        setattr(out, name, array)
    return out


def host_arrays(rays: Rays) -> Rays:
    """Check the rays and return them as NumPy arrays of float32 without gaps, a stride of 0 meaning one number for all rays."""
    return Rays(*map(np.asarray, rays.on(wp.get_device("cpu")).checked()))


_ends: dict[tuple[float, str], WarpArray] = {}  # usual t_min and t_max, which all calls share: an array takes longer to make than a launch


def constant_array(value: float, n: int, device: Device) -> WarpArray:
    """Return an array (n,) of stride 0, all of whose elements are `value`. A CUDA graph can capture this call."""
    key = value + 0.0, device.alias  # 0.0 for -0.0
    if key not in _ends and key[0] in (0.0, np.inf) and device.is_cuda and not device.is_capturing:
        _ends[key] = wp.full(1, value, dtype=wp.float32, device=device)
        wp.synchronize_device(device)  # other streams read it, too
    one = _ends[key] if key in _ends else wp.full(1, value, dtype=wp.float32, device=device)
    out = wp.array(ptr=one.ptr, shape=(n,), strides=(0,), dtype=wp.float32, device=device)
    keep(out, one)
    return out


def constant(value: float, n: int) -> np.ndarray:
    """Return an array (n,) float32 of stride 0, all of whose elements are `value`. Values beyond float32 become infinite."""
    return _endless(value, copysign(1.0, value))[:n]


@lru_cache(64)
def _endless(value: float, sign: float) -> np.ndarray:  # the sign keeps 0.0 and -0.0 apart
    out: np.ndarray = np.ndarray((1 << 60,), np.float32, c_float(value), strides=(0,))  # type: ignore[arg-type]
    return out


def _checked_ends(array: Any, name: str) -> Array:
    if isinstance(array, wp.array):
        array = contiguous(array)
        if array.device.is_cuda or captures_on_cpu():
            return array
    elif array.strides != (0,):
        array = float32(array)
    numbers = np.asarray(array)
    check_ends((numbers[:1] if numbers.strides == (0,) else numbers).min(initial=np.inf), name)
    return array


def check_ends(least: float, name: str) -> None:
    """Raise InputError for an invalid t_min or t_max (`name`). least: its least value, or NaN if any of its values is NaN."""
    if not least >= LOWEST[name]:
        raise InputError("must not be NaN" + (" or below 0" if name == "t_min" else ""), argument=name)


def vectors(value: ArrayLike, name: str, most: float = float(np.finfo(np.float32).max), hint: str | None = None) -> np.ndarray:
    """Convert to (N, 3) float32. Raises InputError for other shapes, and for components that are NaN or beyond +-`most`."""
    array = value if type(value) is np.ndarray and value.dtype.kind == "f" else real_numbers(value, name, "(N, 3)")
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"must be (N, 3), got {array.shape}", argument=name)
    array = float32(array)
    numbers = array.reshape(-1)
    if not (numbers.min(initial=0.0) >= -most and numbers.max(initial=0.0) <= most):  # False for NaN
        for good, what in ((np.isfinite(array), "finite"), (np.abs(array) <= most, f"within {most:g}")):
            if not good.all():
                row = int(np.argmin(good.all(axis=1)))
                raise InputError(f"must be {what}; row {row} is [{', '.join(map(str, array[row]))}]", argument=name, hint=hint)
    return array


def _check_not_zero(directions: np.ndarray) -> None:
    zero = directions[:, 0] == 0.0
    if zero.any():
        zero &= directions[:, 1] == 0.0
        zero &= directions[:, 2] == 0.0
        if zero.any():
            raise InputError(f"must not be zero; row {int(np.argmax(zero))} is", argument="directions", hint=MISS)
