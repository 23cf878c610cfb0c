"""Boxes of wide nodes in 8 bits a plane: Ylitie, Karras and Laine 2017, "Efficient Incoherent Ray Traversal on GPUs Through
Compressed Wide BVHs", section 3.2; the layout is told in kernels/wide/nodes.py."""

from __future__ import annotations

import numpy as np

EXPONENT_BIAS = 127


def decoded(origin: np.ndarray, step: np.ndarray, byte: np.ndarray) -> np.ndarray:
    """The planes as kernels take them: one rounding, that of the sum. origin, step: (..., 1) float32; byte: (..., W)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return origin + byte.astype(np.float32) * step


def steps(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The exponents (biased) of the least power of two by which 255 steps lead from low to high or beyond; 255 where none does."""
    with np.errstate(invalid="ignore", over="ignore"):
        _, exponent = np.frexp((high.astype(np.float64) - low) / 255.0)
        biased = np.clip(np.where(high > low, exponent, -EXPONENT_BIAS) - 1 + EXPONENT_BIAS, 1, 255)
        for _ in range(3):  # a power of two itself, and the roundings of the sum
            short = ~(decoded(low, powers(biased), np.full_like(low, 255.0)) >= high)
            biased = np.minimum(biased + short, 255)
    return biased


def powers(biased: np.ndarray) -> np.ndarray:
    return (biased.astype(np.uint32) << 23).view(np.float32)


def compress(lo: np.ndarray, hi: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The numbers of each node that stand before its references. lo, hi: (N, W, 3) float32; there: (N, W) whether there is such
    a child. Every box that comes out contains the one that went in; an axis on which 8 bits cannot tell that holds nothing back."""
    n, width = there.shape
    low = np.where(there[..., None], lo, np.float32(np.inf)).min(axis=1)
    high = np.where(there[..., None], hi, np.float32(-np.inf)).max(axis=1)
    low, high = np.where(low <= high, low, 0.0).astype(np.float32), np.where(low <= high, high, 0.0).astype(np.float32)
    biased = steps(low, high)
    untold = (biased == 255) | ~np.isfinite(low) | ~np.isfinite(high)
    origin = np.where(untold, np.float32(np.nan), low)
    step = powers(np.where(untold, 1, biased))
    bytes_ = np.zeros((n, 3, 2, width), np.uint8)
    for end, planes in enumerate((lo, hi)):
        wanted = np.where((there[..., None] & ~untold[:, None, :]), planes, low[:, None, :]).transpose(0, 2, 1)
        bytes_[:, :, end] = nearest(np.where(untold, 0.0, low).astype(np.float32)[..., None], step[..., None], wanted, end == 1)
    out = np.zeros((n, 4 + 6 * width // 4), np.float32)
    out[:, :3] = origin
    exponents = np.where(untold, 1, biased).astype(np.uint32)
    mask = (there.astype(np.uint32) << np.arange(width, dtype=np.uint32)).sum(axis=1, dtype=np.uint32)
    out[:, 3] = (exponents[:, 0] | exponents[:, 1] << 8 | exponents[:, 2] << 16 | mask << 24).view(np.float32)
    out[:, 4:] = bytes_.reshape(n, 6 * width).view(np.float32)
    return out


def nearest(origin: np.ndarray, step: np.ndarray, planes: np.ndarray, upward: bool) -> np.ndarray:
    """The byte whose plane is the last one not above each plane, or the first one not below it (upward)."""
    with np.errstate(over="ignore", invalid="ignore"):
        t = (planes.astype(np.float64) - origin) / step.astype(np.float64)
    byte = np.clip(np.where(np.isfinite(t), np.ceil(t) if upward else np.floor(t), 0.0), 0.0, 255.0)
    for _ in range(2):  # the sum may round to the other side
        plane = decoded(origin, step, byte)
        byte += np.where(plane < planes, 1.0, 0.0) if upward else np.where(plane > planes, -1.0, 0.0)
        byte = np.clip(byte, 0.0, 255.0)
    return byte.astype(np.uint8)


def children_there(nodes: np.ndarray, width: int) -> np.ndarray:
    """(N, W): which children the nodes' words tell of."""
    word = np.ascontiguousarray(nodes[:, 3]).view(np.uint32)
    return (word[:, None] >> np.arange(24, 24 + width, dtype=np.uint32) & 1).astype(bool)


def decompress(nodes: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """lo, hi: (N, W, 3) float32, the boxes as kernels take them: empty where there is no child, endless on axes that hold nothing
    back."""
    n = len(nodes)
    word = np.ascontiguousarray(nodes[:, 3]).view(np.uint32)
    step = powers(word[:, None] >> np.array([0, 8, 16], np.uint32) & 255)
    bytes_ = np.ascontiguousarray(nodes[:, 4:]).view(np.uint8).reshape(n, 3, 2, width)
    planes = decoded(nodes[:, :3, None, None], step[:, :, None, None], bytes_)
    there = children_there(nodes, width)[..., None]
    lo, hi = (planes[:, :, end].transpose(0, 2, 1) for end in range(2))
    lo, hi = np.where(np.isnan(lo), np.float32(-np.inf), lo), np.where(np.isnan(hi), np.float32(np.inf), hi)
    return np.where(there, lo, np.float32(np.inf)), np.where(there, hi, np.float32(-np.inf))
