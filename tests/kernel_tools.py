"""Small launches on the device of the tests, for tests of single device functions."""

import numpy as np
import pytest

from tests import device

from wrt.core.device import start  # isort: skip (before warp: it silences Warp's banner)
import warp as wp

DEVICE = start(device.NAME)
cpu_only = pytest.mark.skipif(DEVICE.is_cuda, reason="of code that runs on the CPU alone")


def vec3s(rows) -> wp.array:
    """Rows of three numbers as a Warp array of vec3."""
    return wp.array(np.ascontiguousarray(rows, dtype=np.float32).reshape(-1, 3), dtype=wp.vec3, device=DEVICE)


def vec2s(rows) -> wp.array:
    return wp.array(np.ascontiguousarray(rows, dtype=np.float32).reshape(-1, 2), dtype=wp.vec2, device=DEVICE)


def floats(values) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=wp.float32, device=DEVICE)


def ints(values) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=DEVICE)


def uints(values) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.uint32), dtype=wp.uint32, device=DEVICE)


def zeros(n: int, dtype=wp.float32) -> wp.array:
    return wp.zeros(n, dtype=dtype, device=DEVICE)


def launch(kernel, n: int, *arguments) -> None:
    """Run `kernel` over n threads; its last arguments are usually the arrays that it fills."""
    wp.launch(kernel, dim=n, inputs=list(arguments), device=DEVICE)


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows scaled to unit length, in float64."""
    rows = np.asarray(rows, dtype=np.float64)
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def rounded(rows: np.ndarray) -> np.ndarray:
    """The float32 values that a device sees, back in float64: an oracle must start from the same numbers."""
    return np.asarray(rows, dtype=np.float32).astype(np.float64)


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    """n unit vectors, uniform over the sphere, as float32 values in float64."""
    return rounded(unit(rng.normal(size=(n, 3))))


def sobol_like(n: int, rng: np.random.Generator) -> np.ndarray:
    """n points of the unit square, evenly spread (a rotated rank-1 lattice): for integrals with little noise."""
    i = np.arange(n)
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    points = np.stack([(i + 0.5) / n, np.mod(i * golden, 1.0)], axis=1)
    return np.minimum(np.mod(points + rng.random(2), 1.0), 1.0 - 2.0**-24)
