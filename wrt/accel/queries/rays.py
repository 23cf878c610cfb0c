"""Rays of a query: the arrays that a caller gives, checked, and as kernels take them."""

from __future__ import annotations

from ctypes import c_float
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.core.arrays import check_no_gradients, float32, real_numbers, taken
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.core.warp_private import keep
from wrt.kernels.query import FARTHEST, RayArrays
from wrt.kernels.warp_private import fields_of

LOWEST = {"t_min": 0.0, "t_max": -np.inf}


class Rays(NamedTuple):
    """What somebody gives as rays: NumPy arrays of any real numbers and with any gaps, (N, 3) and (N,) (a stride of 0: one number
    for all), or Warp's of vec3 and float32. Their shapes are right, their numbers anything."""

    origins: Any
    directions: Any
    t_min: Any
    t_max: Any

    @property
    def as_warp(self) -> bool:
        return isinstance(self.origins, wp.array)

    def on(self, device: Any) -> Rays:
        """The same, with Warp arrays of other devices copied to this one."""
        return Rays(*[array.to(device) if isinstance(array, wp.array) else array for array in self])

    def checked(self) -> Rays:
        """The same as float32 without gaps. Raises InputError that names the first that kernels must not get; of Warp arrays, only
        t_min and t_max on the CPU are looked at."""
        if self.as_warp:
            origins, directions = (a if a.is_contiguous else a.contiguous() for a in (self.origins, self.directions))
        else:
            origins, directions = vectors(self.origins, "origins", FARTHEST), vectors(self.directions, "directions")
            _check_not_zero(directions)
        return Rays(origins, directions, _checked_ends(self.t_min, "t_min"), _checked_ends(self.t_max, "t_max"))


def rays_of(origins: Any, directions: Any, t_min: Any, t_max: Any, gradients: bool = False) -> Rays:
    """The arguments of Accelerator.closest_hit, whose shapes and kinds are checked. gradients: whether origins and directions may
    require them. Raises InputError that names the argument."""
    check_no_gradients(t_min=t_min, t_max=t_max, **({} if gradients else {"origins": origins, "directions": directions}))
    origins, directions = taken(origins, "origins"), taken(directions, "directions")
    if isinstance(origins, wp.array) or isinstance(directions, wp.array):
        if any(not isinstance(array, wp.array) or array.dtype != wp.vec3 for array in (origins, directions)):
            raise InputError("and directions must both be Warp arrays of vec3, or both NumPy arrays", argument="origins")
    else:
        origins, directions = _rows(origins, "origins"), _rows(directions, "directions")
    n = len(origins)
    if len(directions) != n:
        raise InputError(f"must have as many rows as origins ({n}), got {len(directions)}", argument="directions")
    return Rays(origins, directions, _segment_ends(t_min, n, "t_min"), _segment_ends(t_max, n, "t_max"))


def rays_on(device: Any, rays: Rays) -> RayArrays:
    """Checked, as Warp arrays on a device; what is on another is copied."""
    out = RayArrays()
    for name, array, dtype in zip(fields_of(RayArrays), rays.checked().on(device), (wp.vec3, wp.vec3, wp.float32, wp.float32),
                                  strict=True):
        if not isinstance(array, wp.array):
            one = len(array) > 0 and array.strides == (0,)
            array = one_for_all(float(array[0]), len(array), device) if one else upload(array, dtype, device)
        setattr(out, name, array)
    return out


def one_for_all(value: float, n: int, device: Any) -> Any:
    """An array of n times the same number, which is there once: written by the device, so that a graph can capture it."""
    one = wp.full(1, value, dtype=wp.float32, device=device)
    out = wp.array(ptr=one.ptr, shape=(n,), strides=(0,), dtype=wp.float32, device=device)
    keep(out, one)
    return out


def _segment_ends(value: Any, n: int, name: str) -> Any:
    if type(value) is not float:  # most are
        value = taken(value, name, wp.float32)
    if isinstance(value, wp.array):
        if value.dtype != wp.float32 or value.shape != (n,):
            raise InputError(f"must be ({n},) float32, got {value.shape} {value.dtype.__name__}", argument=name)
        return value
    if type(value) is not float:
        array = real_numbers(value, name, f"a number or ({n},)")
        if array.ndim > 1 or (array.ndim == 1 and len(array) != n):
            raise InputError(f"must be a number or ({n},), got {array.shape}", argument=name)
        if array.ndim == 1:
            return array
        value = float(float32(array))
    number = c_float(value)
    _check_ends(number.value, name)
    return np.ndarray((n,), np.float32, number, strides=(0,))  # type: ignore[arg-type]


def _checked_ends(array: Any, name: str) -> Any:
    if isinstance(array, wp.array):
        array = array if array.is_contiguous else array.contiguous()
        if array.device.is_cuda:
            return array
    elif array.strides != (0,):
        array = float32(array)
    _check_ends(np.asarray(array).min(initial=np.inf), name)
    return array


def _check_ends(least: Any, name: str) -> None:
    """least: of all numbers; NaN where there is one."""
    if not least >= LOWEST[name]:
        raise InputError("must not be NaN" + (" or below 0" if name == "t_min" else ""), argument=name)


def _rows(value: Any, name: str) -> np.ndarray:
    array = real_numbers(value, name, "(N, 3)")
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"must be (N, 3), got {array.shape}", argument=name)
    return array


def vectors(value: Any, name: str, most: float = float(np.finfo(np.float32).max)) -> np.ndarray:
    """(N, 3) float32, no component beyond `most`."""
    array = float32(_rows(value, name))
    numbers = array.reshape(-1)
    if not (numbers.min(initial=0.0) >= -most and numbers.max(initial=0.0) <= most):  # False for NaN
        for good, what in ((np.isfinite(array), "finite"), (np.abs(array) <= most, f"within {most:g}")):
            if not good.all():
                row = int(np.argmin(good.all(axis=1)))
                raise InputError(f"must be {what}; row {row} is [{', '.join(map(str, array[row]))}]", argument=name)
    return array


def _check_not_zero(directions: np.ndarray) -> None:
    zero = directions[:, 0] == 0.0
    if zero.any():
        zero &= directions[:, 1] == 0.0
        zero &= directions[:, 2] == 0.0
        if zero.any():
            raise InputError(f"must not be zero; row {int(np.argmax(zero))} is", argument="directions")
