"""Arrays shared with other libraries without a copy: with NumPy, Warp, and all libraries that have DLPack or `__array__`."""

import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, TypeGuard

import numpy as np
import warp as wp

from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.core.types import Array, ArrayLike, Tensor, WarpArray, WarpType
from wrt.core.warp_private import recording_tape, refuse_capture

DLPACK_CPU = 1
REAL = "iufO"  # NumPy's kinds of real numbers, and objects such as fractions: no bool, complex, text or date


def to_numpy(array: ArrayLike) -> np.ndarray:
    """Return a NumPy array of the same memory, or a copy of an array on a GPU."""
    if type(array) is np.ndarray:
        return array
    array = from_tensor(array, "an array", None)
    return _on_host(array) if isinstance(array, wp.array) else np.asarray(array)


def _on_host(array: WarpArray) -> np.ndarray:
    """Return the values of a Warp array. Raises InputError in a capture, because launches that would write them have not run."""
    refuse_capture(array.device)
    return np.asarray(array.numpy())


def to_warp(array: ArrayLike, dtype: WarpType = None) -> WarpArray:
    """Return a Warp array of the same memory, or a copy of a read-only NumPy array. NumPy arrays stay on the CPU.

    dtype: a Warp type, such as vec3 for arrays of three columns; None keeps the array's type."""
    if not isinstance(array, np.ndarray):
        array = from_tensor(array, "an array", dtype)
    if isinstance(array, wp.array):
        return array
    refuse_capture()
    array = np.ascontiguousarray(array)
    return wp.array(array, dtype=dtype or wp.dtype_from_numpy(array.dtype), device="cpu", copy=not array.flags.writeable)


def contiguous(array: Any) -> Any:
    """Return the Warp array, or a contiguous copy. Raises InputError in a capture on the CPU, because Warp cannot record such a copy."""
    if not array.is_contiguous:
        refuse_capture()
    return array.contiguous()


def real_numbers(value: object, name: str, shape: str) -> np.ndarray:
    """Return an argument as a NumPy array of real numbers: integers and floats keep their type, objects become float32.

    name, shape: the argument's name and expected shape, for the message of InputError. An array on a GPU is copied."""
    if "numpy.ma" in sys.modules and isinstance(value, np.ma.MaskedArray):  # np.ma takes long to import
        raise InputError("must not be a masked array", hint="leave masked rows out, or fill them", argument=name)
    value = from_tensor(value, name, None)
    try:
        array = _on_host(value) if isinstance(value, wp.array) else np.asarray(value)
        if array.dtype.kind in REAL:
            return float32(array) if array.dtype.kind == "O" else array
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"must be {shape} of real numbers, got {shown(value)}", argument=name)


def float32(array: np.ndarray) -> np.ndarray:
    """Return a contiguous and aligned float32 array, without a copy if possible. Values beyond float32 become infinite."""
    if array.dtype == np.float32 and array.flags.c_contiguous and array.flags.aligned:  # NumPy's check takes ten times as long
        return array
    with np.errstate(over="ignore"):
        return np.require(array, np.float32, ["C", "A"])


def check_no_gradients(what: str = "this", **arrays: object) -> None:
    """Raise InputError for a Warp array that requires gradients while a tape records, because the query `what` has no gradients."""
    for name, array in arrays.items() if recording_tape() is not None else ():
        if isinstance(array, wp.array) and array.requires_grad:
            raise InputError(f"requires gradients and a wp.Tape is recording, but {what} has none (t, u, v and point of"
                             f" closest_hit have gradients, in origins, directions and vertices)", argument=name,
                             hint=f"query outside of the tape, or pass wp.clone({name}, requires_grad=False)")


def is_tensor(value: object) -> TypeGuard[Tensor]:
    """Return True for an array of another library than NumPy and Warp that shares its memory by DLPack."""
    return not isinstance(value, np.ndarray | wp.array) and hasattr(value, "__dlpack__")


def on_cpu(tensor: Tensor) -> bool:
    """Return True if a tensor is in the memory of the host."""
    kind = tensor.__dlpack_device__()[0]
    return bool(getattr(kind, "value", kind) == DLPACK_CPU)  # Open3D's enumeration is not equal to integers


def from_tensor(value: object, name: str, dtype: WarpType = wp.vec3) -> Any:
    """Return a tensor as an array of the same memory: a NumPy array on the CPU, a Warp array on a GPU. Other values stay unchanged.

    dtype: type of the Warp array; None keeps the tensor's type. Raises InputError for the argument `name` if memory cannot be shared."""
    if not is_tensor(value):
        return value
    try:
        if on_cpu(value):
            return np.from_dlpack(value)
        return wp.from_dlpack(value, dtype=dtype)
    except (BufferError, TypeError, RuntimeError, ValueError, AttributeError) as error:  # the last: JAX's, under jit
        with suppress(BufferError, TypeError, RuntimeError, ValueError, AttributeError):
            return np.asarray(value.numpy())  # type: ignore[attr-defined]  # for libraries with an incomplete DLPack
        gradients = getattr(value, "requires_grad", type(value).__module__.startswith("jax"))
        raise InputError(f"{shown(value)} does not share its memory: {error}", argument=name,
                         hint="closest_hit of wrt.torch and of wrt.jax has gradients" if gradients else "pass a NumPy array") from error


def to_tensor_like(*arguments: object) -> Callable[[Array], Tensor] | None:
    """Return a function that turns an array into a tensor of the same library as the first tensor in `arguments`, without a copy.

    An array on a GPU is copied if that tensor is on the CPU. Returns None without a tensor, or if the library has no `from_dlpack`."""
    for value in arguments:
        if is_tensor(value):
            namespace = getattr(value, "__array_namespace__", None)  # the array API's; torch has none
            library: Any = namespace() if namespace else sys.modules.get(type(value).__module__.partition(".")[0])
            return partial(_to_tensor, library.from_dlpack, on_cpu(value)) if hasattr(library, "from_dlpack") else None
    return None


def given_like(like: Any, values: np.ndarray) -> Any:
    """Return NumPy values as an array of the library of `like`, and on its device."""
    give, values = to_tensor_like(like), np.asarray(values)
    if isinstance(like, wp.array):
        return wp.array(values, device=like.device)
    if give is None:
        return values
    return give(values if on_cpu(like) else wp.array(values, device=to_warp(like).device))


def _to_tensor(from_dlpack: Callable[[Array], Tensor], to_cpu: bool, array: Array) -> Tensor:
    """Convert an array by `from_dlpack`. On the CPU a NumPy array is passed, because NumPy supports all versions of DLPack."""
    return from_dlpack(to_numpy(array) if to_cpu or not isinstance(array, wp.array) or array.device.is_cpu else array)
