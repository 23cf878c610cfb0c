"""Fresnel's formulas in float64, as a reference."""

import numpy as np


def fresnel(cosine, n):
    """Return the unpolarised reflectance of a boundary to the complex index n, in complex arithmetic from Snell's law."""
    cosine = np.asarray(cosine, np.complex128)
    sine = np.sqrt(1.0 - cosine**2)
    inner = np.sqrt(1.0 - (sine / n) ** 2)
    s = (cosine - n * inner) / (cosine + n * inner)
    p = (n * cosine - inner) / (n * cosine + inner)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)
