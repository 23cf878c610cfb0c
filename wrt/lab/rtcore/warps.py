"""Assign rays to warps of 32 lanes, and compute SIMT efficiency, the share of the lanes' time that rays use."""

import numpy as np

WARP = 32
BLOCK = (8, 4)  # pixels of a warp: columns, rows
MORTON_BITS = 10  # bits of each coordinate in a Morton code


def blocks(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the warp and the lane of each pixel, (height * width,) each: warps are blocks of 8 x 4 pixels, row by row."""
    y, x = np.divmod(np.arange(width * height), width)
    across = -(-width // BLOCK[0])
    return y // BLOCK[1] * across + x // BLOCK[0], y % BLOCK[1] * BLOCK[0] + x % BLOCK[0]


def packed(n: int) -> np.ndarray:
    """Return the warp of each of n successive rays, (n,); all warps but the last are full."""
    return np.arange(n) // WARP


def efficiency(cost: np.ndarray, warp: np.ndarray) -> float:
    """Return the SIMT efficiency, 0 to 1; it is 1 if all costs are 0. cost, warp: (N,) of each ray.
    A warp occupies its 32 lanes for the cost of its costliest ray."""
    longest = longest_of(cost, warp)
    total = WARP * float(longest.sum())
    return float(cost.sum()) / total if total > 0.0 else 1.0


def longest_of(cost: np.ndarray, warp: np.ndarray) -> np.ndarray:
    """Return the largest cost of a ray in each warp, (W,) float64. cost: (N,), not negative."""
    out = np.zeros(int(warp.max(initial=-1)) + 1)
    np.maximum.at(out, warp, cost)
    return out


def by_coherence(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return an order, (N,) int64, in which similar rays are neighbours.
    Sort by the octant of the direction, then along Morton curves through the origins and through the directions. Sources:
    Pharr et al. 1997, Garanzha and Loop 2010."""
    octant = (directions < 0.0) @ np.array([4, 2, 1])
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return np.lexsort((morton(unit), morton(origins), octant))


def morton(points: np.ndarray) -> np.ndarray:
    """Return the position of each point on a Morton curve through the points' box, (N,) int64."""
    if not len(points):
        return np.zeros(0, np.int64)
    lo, extent = points.min(axis=0), np.ptp(points, axis=0)
    cell = (points - lo) / np.where(extent > 0.0, extent, 1.0) * ((1 << MORTON_BITS) - 1)
    code = np.zeros(len(points), np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= (cell[:, axis].astype(np.int64) >> bit & 1) << (3 * bit + axis)
    return code
