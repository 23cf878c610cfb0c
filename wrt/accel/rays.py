"""Rays of a query: checked, on the device, in the form that kernels take."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from wrt.core.arrays import check_no_gradients, real_numbers, taken
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.kernels.query import RayArrays

FARTHEST = 1e37  # of an origin's coordinates: differences of such are finite


def rays_on(device: Any, origins: Any, directions: Any, t_min: Any, t_max: Any) -> tuple[RayArrays, bool]:
    """The arguments of Accelerator.closest_hit as arrays on a device, and whether they were Warp arrays. Raises InputError that
    names the argument."""
    check_no_gradients(origins=origins, directions=directions, t_min=t_min, t_max=t_max)
    origins, directions = taken(origins, "origins"), taken(directions, "directions")
    as_warp = isinstance(origins, wp.array) or isinstance(directions, wp.array)
    rays = RayArrays()
    if as_warp:
        if any(not isinstance(array, wp.array) or array.dtype != wp.vec3 for array in (origins, directions)):
            raise InputError("origins and directions must both be Warp arrays of vec3, or both NumPy arrays")
        n = len(origins)
        rays.origin, rays.direction = (a if a.is_contiguous else a.contiguous() for a in (origins, directions))
    else:
        origins, directions = vectors(origins, "origins", FARTHEST), vectors(directions, "directions")
        n = len(origins)
        _check_not_zero(directions)
        rays.origin = upload(origins, wp.vec3, device)
        rays.direction = upload(directions, wp.vec3, device)
    if len(directions) != n:
        raise InputError(f"directions must have as many rows as origins ({n}), got {len(directions)}")
    rays.t_min = _segment_end(device, t_min, n, "t_min", low=0.0)
    rays.t_max = _segment_end(device, t_max, n, "t_max", low=-np.inf)
    return rays, as_warp


def _segment_end(device: Any, value: Any, n: int, name: str, low: float) -> Any:
    if isinstance(value, wp.array):
        if value.dtype != wp.float32 or value.shape != (n,):
            raise InputError(f"{name} must be ({n},) float32, got {value.shape} {value.dtype.__name__}")
        if value.device.is_cpu:
            _check_ends(value.numpy(), name, low)
        return value if value.is_contiguous else value.contiguous()
    array = real_numbers(value, name, f"a number or ({n},)")
    if array.ndim > 1 or (array.ndim == 1 and len(array) != n):
        raise InputError(f"{name} must be a number or ({n},), got {array.shape}")
    _check_ends(array, name, low)
    return upload(np.broadcast_to(array, (n,)).copy(), wp.float32, device)


def _check_ends(array: np.ndarray, name: str, low: float) -> None:
    if not array.min(initial=np.inf) >= low:  # the least of what has a NaN is NaN
        raise InputError(f"{name} must not be NaN" + (f" or below {low:g}" if low > -np.inf else ""))


def vectors(value: Any, name: str, most: float = float(np.finfo(np.float32).max)) -> np.ndarray:
    """(N, 3) float32, no component beyond `most`."""
    array = real_numbers(value, name, "(N, 3)")
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} must be (N, 3), got {array.shape}")
    numbers = array.reshape(-1)
    if not (numbers.min(initial=0.0) >= -most and numbers.max(initial=0.0) <= most):  # False for NaN
        for good, what in ((np.isfinite(array), "finite"), (np.abs(array) <= most, f"within {most:g}")):
            if not good.all():
                row = int(np.argmin(good.all(axis=1)))
                raise InputError(f"{name} must be {what}; row {row} is [{', '.join(map(str, array[row]))}]")
    return array


def _check_not_zero(directions: np.ndarray) -> None:
    zero = directions[:, 0] == 0.0
    if zero.any():
        zero &= directions[:, 1] == 0.0
        zero &= directions[:, 2] == 0.0
        if zero.any():
            raise InputError(f"directions must not be zero; row {int(np.argmax(zero))} is")
