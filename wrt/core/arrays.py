"""Arrays from and to others without a copy: NumPy, Warp, and whatever else speaks DLPack or has `__array__`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.core.warp_private import recording_tape

DLPACK_CPU = 1
REAL = "iufO"  # NumPy's kinds of real numbers, and objects such as fractions: no bool, complex, text or date


def to_numpy(array: Any) -> np.ndarray:
    """A NumPy array of the same memory; a copy only of what is on a GPU."""
    array = taken(array, "an array", None)
    return array.numpy() if isinstance(array, wp.array) else np.asarray(array)


def to_warp(array: Any, dtype: Any = None) -> Any:
    """A Warp array of the same memory (of a NumPy array: on the CPU); a copy only of what cannot be written to.

    dtype: a Warp type, such as vec3 for arrays of three columns; None: the array's own.
    """
    if not isinstance(array, np.ndarray):
        array = taken(array, "an array", dtype)
    if isinstance(array, wp.array):
        return array
    array = np.ascontiguousarray(array)
    return wp.array(array, dtype=dtype or wp.dtype_from_numpy(array.dtype), device="cpu", copy=not array.flags.writeable)


def real_numbers(value: Any, name: str, shape: str) -> np.ndarray:
    """An array of what somebody gives as real numbers: arrays and tensors of integers or floats of any size as they are, lists,
    scalars; objects as float32; what is on a GPU is copied. Raises InputError that calls it `name`, and says that `shape` was
    expected."""
    if "numpy.ma" in sys.modules and isinstance(value, np.ma.MaskedArray):  # else there is none, and that module takes long
        raise InputError(f"{name} must not be a masked array: its mask would be ignored; leave masked rows out, or fill them")
    value = taken(value, name, None)
    try:
        array = value.numpy() if isinstance(value, wp.array) else np.asarray(value)
        if array.dtype.kind in REAL:
            return float32(array) if array.dtype.kind == "O" else array
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{name} must be {shape} of real numbers, got {shown(value)}")


def float32(array: np.ndarray) -> np.ndarray:
    """Aligned and without gaps, the same array if it is so; what is beyond float32 becomes infinite."""
    with np.errstate(over="ignore"):
        return np.require(array, np.float32, ["C", "A"])


def check_no_gradients(what: str = "this", **arrays: Any) -> None:
    """Raise InputError that names the Warp array in which a tape would wait for gradients of `what`, which has none."""
    for name, array in arrays.items() if recording_tape() is not None else ():
        if isinstance(array, wp.array) and array.requires_grad:
            raise InputError(f"{name} requires gradients and a wp.Tape is recording, but {what} has none (t, u, v and point of"
                             f" closest_hit have, in origins, directions and vertices): ask outside of the tape, or give"
                             f" wp.clone({name}, requires_grad=False)")


def is_tensor(value: Any) -> bool:
    """Whether it is another library's array, which shares its memory by DLPack."""
    return not isinstance(value, np.ndarray | wp.array) and hasattr(value, "__dlpack__")


def on_cpu(tensor: Any) -> bool:
    """Whether the memory of a tensor is the host's."""
    return bool(tensor.__dlpack_device__()[0] == DLPACK_CPU)


def taken(value: Any, name: str, dtype: Any = wp.vec3) -> Any:
    """What somebody gives for an array: tensors as an array of the same memory, NumPy's on the CPU and on a GPU Warp's of `dtype`
    (None: the tensor's own); all else as it is. Raises InputError that calls it `name` where a tensor does not share its memory."""
    if not is_tensor(value):
        return value
    try:
        if on_cpu(value):
            return np.from_dlpack(value)
        return wp.from_dlpack(value, dtype=dtype)
    except (BufferError, TypeError, RuntimeError, ValueError, AttributeError) as error:  # the last: JAX's, under jit
        raise InputError(f"{name}: {shown(value)} does not share its memory: {error} (closest_hit of wrt.torch and of"
                         f" wrt.jax has gradients)") from error


def returned(*given: Any) -> Callable[[Any], Any] | None:
    """What makes an array of NumPy or Warp a tensor of the library whose tensor is the first among `given`, without a copy (one of
    a GPU comes to the CPU if that tensor is there); None where there is no tensor, or its library is not known to make some."""
    for value in given:
        if is_tensor(value):
            has_namespace = hasattr(value, "__array_namespace__")  # the array API's way; torch has none
            module = type(value).__module__.partition(".")[0]
            home: Any = value.__array_namespace__() if has_namespace else sys.modules.get(module)
            return partial(_given_to, home.from_dlpack, on_cpu(value)) if hasattr(home, "from_dlpack") else None
    return None


def _given_to(from_dlpack: Callable[[Any], Any], to_cpu: bool, array: Any) -> Any:
    """On the CPU an array of NumPy, which knows all of the protocol's versions."""
    return from_dlpack(to_numpy(array) if to_cpu or not isinstance(array, wp.array) or array.device.is_cpu else array)
