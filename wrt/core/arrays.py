"""Arrays from and to others without a copy: NumPy, Warp, and whatever else speaks DLPack or has `__array__`."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import warp as wp
from warp._src import context  # there is no public way to ask whether a tape records

from wrt.core.checks import shown
from wrt.core.errors import InputError

DLPACK_CPU = 1
REAL = "iufO"  # NumPy's kinds of real numbers, and objects such as fractions: no bool, complex, text or date


def to_numpy(array: Any) -> np.ndarray:
    """A NumPy array of the same memory; a copy only of what is on a GPU."""
    return array.numpy() if isinstance(array, wp.array) else np.asarray(array)


def to_warp(array: Any, dtype: Any = None) -> Any:
    """A Warp array of the same memory (of a NumPy array: on the CPU); a copy only of what cannot be written to.

    dtype: a Warp type, such as vec3 for arrays of three columns; None: the array's own.
    """
    if isinstance(array, wp.array):
        return array
    array = np.ascontiguousarray(array)
    return wp.array(array, dtype=dtype or wp.dtype_from_numpy(array.dtype), device="cpu", copy=not array.flags.writeable)


def real_numbers(value: Any, name: str, shape: str) -> np.ndarray:
    """An array of what somebody gives as real numbers: arrays of integers or floats of any size as they are, lists, scalars;
    objects as float32. Raises InputError that calls it `name`, and says that `shape` was expected."""
    if "numpy.ma" in sys.modules and isinstance(value, np.ma.MaskedArray):  # else there is none, and that module takes long
        raise InputError(f"{name} must not be a masked array: its mask would be ignored; leave masked rows out, or fill them")
    try:
        array = np.asarray(value)
        if array.dtype.kind in REAL:
            return float32(array) if array.dtype.kind == "O" else array
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{name} must be {shape} of real numbers, got {shown(value)}")


def float32(array: np.ndarray) -> np.ndarray:
    """Aligned and without gaps, the same array if it is so; what is beyond float32 becomes infinite."""
    with np.errstate(over="ignore"):
        return np.require(array, np.float32, ["C", "A"])


def check_no_gradients(**arrays: Any) -> None:
    """Raise InputError that names the Warp array of which a tape would wait for gradients: there are none."""
    for name, array in arrays.items() if context.runtime.tape is not None else ():
        if isinstance(array, wp.array) and array.requires_grad:
            raise InputError(f"{name} requires gradients and a wp.Tape is recording, but wrt has no gradients: ask outside of the"
                             f" tape, or give wp.clone({name}, requires_grad=False)")


def taken(value: Any, name: str) -> Any:
    """What somebody gives for an array of vectors: NumPy and Warp arrays, and what has no `__dlpack__`, as they are; other
    tensors as an array of the same memory, NumPy's on the CPU and Warp's of vec3 on a GPU. Raises InputError that calls it
    `name` where a tensor does not share its memory."""
    if isinstance(value, np.ndarray | wp.array) or not hasattr(value, "__dlpack__"):
        return value
    try:
        if value.__dlpack_device__()[0] == DLPACK_CPU:
            return np.from_dlpack(value)
        return wp.from_dlpack(value, dtype=wp.vec3)
    except (BufferError, TypeError, RuntimeError, ValueError) as error:
        raise InputError(f"{name}: {shown(value)} does not share its memory: {error}") from error
