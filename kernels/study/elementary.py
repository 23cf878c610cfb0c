"""The elementary functions of wrt.kernels.shade on arrays, to compare devices with each other and with exact values."""

import warp as wp

from wrt.kernels.shade.elementary import acos, atan2, exp, power, sin_cos
from wrt.kernels.structs import kernel

FUNCTIONS = ("sin", "cos", "acos", "exp", "atan2", "power")


@kernel
def call_functions(x: wp.array(dtype=float), y: wp.array(dtype=float), out: wp.array2d(dtype=float)):
    """Store in out[i] the values of all FUNCTIONS, in their order, of x[i] or of (x[i], y[i])."""
    i = wp.tid()
    sin, cos = sin_cos(x[i])
    out[i, 0] = sin
    out[i, 1] = cos
    out[i, 2] = acos(x[i])
    out[i, 3] = exp(x[i])
    out[i, 4] = atan2(x[i], y[i])
    out[i, 5] = power(x[i], y[i])
