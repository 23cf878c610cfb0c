"""Affine maps in arrays of a device, as arguments of moves and sensors."""

from collections.abc import Callable
from math import prod

import numpy as np
import warp as wp

from wrt.core.checks import shown
from wrt.core.device import row_type, upload
from wrt.core.errors import InputError
from wrt.core.types import Device, WarpArray, WarpStruct
from wrt.kernels.transforms import Transforms

KINDS = {np.dtype(np.float32): wp.float32, np.dtype(np.float64): wp.float64}
ROWS = (7,), (3, 4), (4, 4)
Shape = tuple[int, ...]


def transforms_of(numbers: WarpArray | np.ndarray, size: int, device: Device, outside: bool = False) -> WarpStruct:
    """Make kernels.transforms.Transforms of an array of float32 or float64 with one dimension. size, outside: fields of it."""
    out = Transforms()
    if isinstance(numbers, np.ndarray):
        numbers = upload(numbers.reshape(-1), wp.float64, device)
    out.floats, out.doubles = (numbers, None) if numbers.dtype == wp.float32 else (None, numbers)
    out.size, out.outside = size, outside
    return out


def require_on(device: Device, **arrays: WarpArray) -> None:
    """Raise InputError, which names the argument, unless the arrays are on the device and contiguous."""
    for name, array in arrays.items():
        if array.device != device:
            raise InputError(f"must be on {device}, as the structure is, not on {array.device}", argument=name)
        if not array.is_contiguous:
            raise InputError("must be contiguous", argument=name, hint=f"pass {name}.contiguous()")


def transforms_in(array: WarpArray, name: str, form: str, fits: Callable[[Shape], bool], outside: bool) -> tuple[WarpStruct, Shape]:
    """Return kernels.transforms.Transforms in the memory of a contiguous Warp array, and its leading shape. Values are not checked.

    form: the leading shape in the message; fits: whether a leading shape is right. Raises InputError that names the argument.
    """
    kind = row_type(array.dtype)
    shape = (*array.shape, *kind.shape)
    for row in ROWS if kind.base in KINDS else ():
        lead = shape[:len(shape) - len(row)]
        if (*lead, *row) == shape and fits(lead):
            numbers = wp.array(ptr=array.ptr, dtype=KINDS[kind.base], shape=prod(shape), device=array.device)  # the caller owns the memory
            return transforms_of(numbers, prod(row), array.device, outside), lead
    raise InputError(f"must be a Warp array ({form},) of transformf or mat44f, or ({form}, 7) or ({form}, 3 or 4, 4) of float32 or float64,"
                     f" got {shown(array)}", argument=name)
