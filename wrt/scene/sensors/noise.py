"""Noise of range sensors."""

from __future__ import annotations

from typing import Any

import numpy as np

from wrt.core.arrays import given_like
from wrt.core.checks import as_array, as_integer
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike
from wrt.scene.sensors.sensor import as_doubles
from wrt.scene.values import as_number


def with_range_noise(ranges: ArrayLike, seed: int, constant: float = 0.0, proportional: float = 0.0, dropout: float = 0.0) -> Any:
    """Add the noise of a range sensor to ranges, independently for each element.

    The error of a range r is normally distributed with the standard deviation sqrt(constant^2 + (proportional r)^2). A result
    below 0 becomes 0.

    Parameters
    ----------
    ranges
        True ranges in scene units, 0 or more, of any shape; a miss is inf and stays inf.
    seed
        The same seed and shape give the same noise.
    constant, proportional
        Parts of the standard deviation: one in scene units, and one as a fraction of r.
    dropout
        Probability, 0 to 1, that a hit becomes a miss (inf).

    Returns
    -------
    float32 array of the shape and the library of `ranges`

    Raises
    ------
    InputError
        If a range is NaN, negative or, with its noise, beyond float32, or an argument is out of range.
    """
    given, ranges = ranges, as_doubles(ranges, "ranges")
    if not (ranges >= 0.0).all():
        raise InputError(f"must be 0 or more, or inf for a miss, got {ranges[~(ranges >= 0.0)][0]:g}", argument="ranges")
    constant, proportional = (as_number(value, name, low=0.0) for value, name in ((constant, "constant"), (proportional, "proportional")))
    if not 0.0 <= as_number(dropout, "dropout") <= 1.0:
        raise InputError(f"must be 0 to 1, got {dropout:g}", argument="dropout")
    rng = np.random.default_rng(as_integer(seed, "seed", 0, (1 << 63) - 1))
    normal, lost = rng.standard_normal(ranges.shape), rng.random(ranges.shape) < dropout
    hit = np.isfinite(ranges) & ~lost
    r = np.where(hit, ranges, 0.0)
    noisy = np.where(hit, np.maximum(r + np.hypot(constant, proportional * r) * normal, 0.0), np.inf)
    out = as_array(noisy, np.float32, "ranges").reshape(ranges.shape)
    if (hit & np.isinf(out)).any():
        raise InputError("must be within the range of float32, with their noise, or inf for a miss", argument="ranges")
    return given_like(given, out)
