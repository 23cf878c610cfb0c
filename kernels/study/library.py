"""The functions whose last bits are the library's: each compiler for each device brings its own."""

import warp as wp

from wrt.kernels.structs import kernel

LIBRARY = ("sin", "cos", "exp", "log", "pow", "acos", "atan2")


@kernel
def call_library(x: wp.array(dtype=float), out: wp.array2d(dtype=float)):
    """A row of each x: what LIBRARY names, of arguments in their domains that follow from it."""
    i = wp.tid()
    a = x[i]
    unit = a / (1.0 + wp.abs(a))
    out[i, 0] = wp.sin(a)
    out[i, 1] = wp.cos(a)
    out[i, 2] = wp.exp(a)
    out[i, 3] = wp.log(wp.abs(a))
    out[i, 4] = wp.pow(wp.abs(a), 1.0 + unit)
    out[i, 5] = wp.acos(unit)
    out[i, 6] = wp.atan2(a, unit + 2.0)
