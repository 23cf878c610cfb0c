"""Boxes of wide nodes, compressed to 8 bits per plane, in the layout of kernels/wide/nodes.py.

Ylitie, Karras and Laine 2017, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", section 3.2.
"""

import numpy as np

from wrt.accel.queries.raw_launches import launch_raw
from wrt.kernels.wide.layout import EXIST_SHIFT, EXPONENT_BITS, FIRST_BYTES, MANTISSA_BITS, PLANES, WORD, first_reference

LARGEST_EXPONENT = 255  # of float32
EXPONENT_SHIFTS = EXPONENT_BITS * np.arange(3, dtype=np.uint32)  # bit positions of the exponents of x, y, z in a node's word


def decoded(origin: np.ndarray, step: np.ndarray, byte: np.ndarray) -> np.ndarray:
    """Decode planes origin + byte * step as kernels do: only the sum rounds. origin, step: (..., 1) float32; byte: (..., W)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return origin + byte.astype(np.float32) * step


def powers(biased: np.ndarray) -> np.ndarray:
    return (biased.astype(np.uint32) << MANTISSA_BITS).view(np.float32)


def compress(lo: np.ndarray, hi: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Compress the boxes of N nodes' children. Return the start of each compressed node: all its floats before the references to children.

    lo, hi: (N, W, 3) float32; exists: (N, W) bool, whether a child exists. Result: (N, F) float32 with F = first_reference(W, True).
    Every compressed box contains the original box. Along an axis whose extent 8 bits cannot cover, the box is infinite.
    """
    from wrt.kernels.build.wide_fit import compress_all  # imported when it is needed: no default structure is compressed

    n, width = exists.shape
    out, planes = np.zeros((n, first_reference(width, True)), np.float32), np.empty((n, len(PLANES), width), np.float32)
    for end, (boxes, empty) in enumerate(((lo, np.inf), (hi, -np.inf))):
        planes[:, end::2] = np.where(exists[..., None], boxes, np.float32(empty)).transpose(0, 2, 1)
    mask = (exists.astype(np.uint32) << np.arange(width, dtype=np.uint32)).sum(axis=1, dtype=np.uint32)
    out[:, WORD] = (mask << EXIST_SHIFT).view(np.float32)
    launch_raw(compress_all, n, out.reshape(-1), planes.reshape(-1), width, out.shape[1])
    return out


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
