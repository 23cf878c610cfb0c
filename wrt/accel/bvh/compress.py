"""Boxes of wide nodes, compressed to 8 bits per plane, in the layout of kernels/wide/nodes.py.

Ylitie, Karras and Laine 2017, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", section 3.2.
"""

import numpy as np

from wrt.kernels.wide.layout import EXIST_SHIFT, EXPONENT_BITS, FIRST_BYTES, MANTISSA_BITS, PLANES, WORD, first_reference

EXPONENT_BIAS, LARGEST_EXPONENT = 127, 255  # of float32
LARGEST_BYTE = 255
EXPONENT_SHIFTS = EXPONENT_BITS * np.arange(3, dtype=np.uint32)  # bit positions of the exponents of x, y, z in a node's word


def decoded(origin: np.ndarray, step: np.ndarray, byte: np.ndarray) -> np.ndarray:
    """Decode planes origin + byte * step as kernels do: only the sum rounds. origin, step: (..., 1) float32; byte: (..., W)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return origin + byte.astype(np.float32) * step


def steps(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the biased exponent of the least power of two p with low + 255 p >= high; LARGEST_EXPONENT if no finite p suffices."""
    with np.errstate(invalid="ignore", over="ignore"):
        _, exponent = np.frexp((high.astype(np.float64) - low) / LARGEST_BYTE)
        biased = np.clip(np.where(high > low, exponent, -EXPONENT_BIAS) - 1 + EXPONENT_BIAS, 1, LARGEST_EXPONENT)
        for _ in range(3):  # frexp is one too small for a power of two, and the sum may round down
            short = ~(decoded(low, powers(biased), np.full_like(low, LARGEST_BYTE)) >= high)
            biased = np.minimum(biased + short, LARGEST_EXPONENT)
    return biased


def powers(biased: np.ndarray) -> np.ndarray:
    return (biased.astype(np.uint32) << MANTISSA_BITS).view(np.float32)


def compress(lo: np.ndarray, hi: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Compress the boxes of N nodes' children. Return the start of each compressed node: all its floats before the references to children.

    lo, hi: (N, W, 3) float32; exists: (N, W) bool, whether a child exists. Result: (N, F) float32 with F = first_reference(W, True).
    Every compressed box contains the original box. Along an axis whose extent 8 bits cannot cover, the box is infinite.
    """
    n, width = exists.shape
    low = np.where(exists[..., None], lo, np.float32(np.inf)).min(axis=1)
    high = np.where(exists[..., None], hi, np.float32(-np.inf)).max(axis=1)
    low, high = np.where(low <= high, low, 0.0).astype(np.float32), np.where(low <= high, high, 0.0).astype(np.float32)
    biased = steps(low, high)
    coarse = (biased == LARGEST_EXPONENT) | ~np.isfinite(low) | ~np.isfinite(high)
    origin = np.where(coarse, np.float32(np.nan), low)
    step = powers(np.where(coarse, 1, biased))
    bytes_ = np.zeros((n, 3, 2, width), np.uint8)
    for end, planes in enumerate((lo, hi)):
        wanted = np.where((exists[..., None] & ~coarse[:, None, :]), planes, low[:, None, :]).transpose(0, 2, 1)
        bytes_[:, :, end] = nearest(np.where(coarse, 0.0, low).astype(np.float32)[..., None], step[..., None], wanted, end == 1)
    out = np.zeros((n, first_reference(width, True)), np.float32)
    out[:, :WORD] = origin
    exponents = np.where(coarse, 1, biased).astype(np.uint32)
    mask = (exists.astype(np.uint32) << np.arange(width, dtype=np.uint32)).sum(axis=1, dtype=np.uint32)
    out[:, WORD] = ((exponents << EXPONENT_SHIFTS).sum(axis=1, dtype=np.uint32) | mask << EXIST_SHIFT).view(np.float32)
    out[:, FIRST_BYTES:] = bytes_.reshape(n, len(PLANES) * width).view(np.float32)
    return out


def nearest(origin: np.ndarray, step: np.ndarray, planes: np.ndarray, upward: bool) -> np.ndarray:
    """Return, for each of `planes`, the byte whose decoded plane is the nearest not above it, or not below it if `upward`."""
    with np.errstate(over="ignore", invalid="ignore"):
        t = (planes.astype(np.float64) - origin) / step.astype(np.float64)
    byte = np.clip(np.where(np.isfinite(t), np.ceil(t) if upward else np.floor(t), 0.0), 0.0, LARGEST_BYTE)
    for _ in range(2):  # the decoded plane may round to the wrong side
        plane = decoded(origin, step, byte)
        byte += np.where(plane < planes, 1.0, 0.0) if upward else np.where(plane > planes, -1.0, 0.0)
        byte = np.clip(byte, 0.0, LARGEST_BYTE)
    return byte.astype(np.uint8)


def existing_children(nodes: np.ndarray, width: int) -> np.ndarray:
    """Return the mask of existing children, (N, W) bool, which each node stores in the bits of its entry WORD."""
    word = np.ascontiguousarray(nodes[:, WORD]).view(np.uint32)
    return (word[:, None] >> np.arange(EXIST_SHIFT, EXIST_SHIFT + width, dtype=np.uint32) & 1).astype(bool)


def decompress(nodes: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Decompress the boxes of children, bit for bit as kernels do: lo, hi (N, W, 3). A missing child gets an empty box."""
    n = len(nodes)
    word = np.ascontiguousarray(nodes[:, WORD]).view(np.uint32)
    step = powers(word[:, None] >> EXPONENT_SHIFTS & LARGEST_EXPONENT)
    bytes_ = np.ascontiguousarray(nodes[:, FIRST_BYTES:]).view(np.uint8).reshape(n, 3, 2, width)
    planes = decoded(nodes[:, :WORD, None, None], step[:, :, None, None], bytes_)
    exists = existing_children(nodes, width)[..., None]
    lo, hi = (planes[:, :, end].transpose(0, 2, 1) for end in range(2))
    lo, hi = np.where(np.isnan(lo), np.float32(-np.inf), lo), np.where(np.isnan(hi), np.float32(np.inf), hi)
    return np.where(exists, lo, np.float32(np.inf)), np.where(exists, hi, np.float32(-np.inf))
