"""Helpers to launch kernels on the tests' device: arrays, launches, random directions; machine code of kernels."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from tests import device

from wrt.core.device import start  # isort: skip (before warp: it silences Warp's banner)
import warp as wp

DEVICE = start(device.NAME)
cpu_only = pytest.mark.skipif(DEVICE.is_cuda, reason="tests code for the CPU only")


def vec3s(rows) -> wp.array:
    """Return (N, 3) numbers as a Warp array of vec3."""
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
    """Launch `kernel` with n threads."""
    wp.launch(kernel, dim=n, inputs=list(arguments), device=DEVICE)


def unit(rows: np.ndarray) -> np.ndarray:
    """Return the rows scaled to unit length, float64."""
    rows = np.asarray(rows, dtype=np.float64)
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def rounded(rows: np.ndarray) -> np.ndarray:
    """Round to float32 and return float64, so that an oracle starts from the same numbers as the device."""
    return np.asarray(rows, dtype=np.float32).astype(np.float64)


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return n unit vectors, uniform over the sphere: float64 that float32 holds exactly."""
    return rounded(unit(rng.normal(size=(n, 3))))


def sobol_like(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return n evenly spread points of the unit square, (n, 2): a randomly shifted rank-1 lattice, for integrals with little noise."""
    i = np.arange(n)
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    points = np.stack([(i + 0.5) / n, np.mod(i * golden, 1.0)], axis=1)
    return np.minimum(np.mod(points + rng.random(2), 1.0), 1.0 - 2.0**-24)


def machine_code(kernel, folder: Path) -> tuple[bytes, bytes]:
    """Compile a kernel for Turing; return its code, and the numbers of registers and of bytes of the stack (.nv.info)."""
    from elftools.elf.elffile import ELFFile  # other tests need no such package

    (binary,) = wp.compile_aot_module(kernel.module, arch=75, module_dir=folder)
    sections = {section.name: section.data() for section in ELFFile(BytesIO(Path(binary).read_bytes())).iter_sections()}
    (code,) = (data for name, data in sections.items() if name.startswith(".text."))
    return code, sections[".nv.info"]
