"""Arrays from and to others without a copy: NumPy, Warp, and whatever else speaks DLPack or has `__array__`."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from wrt.arguments import shown
from wrt.errors import InputError

DLPACK_CPU = 1


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
