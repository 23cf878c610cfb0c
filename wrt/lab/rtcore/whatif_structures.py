"""Binary BVHs as a design would have them, for what-if studies: other traversals, and planes of fewer bits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from wrt.accel.answers import Counters
from wrt.accel.base import Accelerator
from wrt.accel.built import Built
from wrt.accel.bvh.binary import Bvh2
from wrt.accel.geometry import Geometry
from wrt.core.errors import InputError
from wrt.kernels.study.bvh2_study import LEVELS, STACK_SIZE, Study
from wrt.kernels.traverse.counters import PRIMITIVE_SPACE

FRAME_BYTES = 16  # of a node with quantised planes: its corner (12) and an exponent of the step for each axis
REFERENCE_BYTES = 16  # of a binary node, as Bvh2Node has them


@cache
def studied(study: Study) -> type[Bvh2]:
    """The structure class whose kernels are those of a study."""
    return type("Bvh2Study", (Bvh2,), {"kernels": study, "__doc__": Bvh2.__doc__})


def with_traversal(accel: Accelerator, study: Study) -> Accelerator:
    """The same tree, walked otherwise. Raises InputError where it is too deep for a trail."""
    if study.entries < STACK_SIZE and accel.stats.depth > LEVELS:
        raise InputError(f"the tree is {accel.stats.depth} deep: more than the {LEVELS} levels that a restart trail has bits for")
    return studied(study).restore(accel.built, accel.geometry)


@dataclass(frozen=True, eq=False)
class Planes:
    """lo, hi: (N, C, 3) float32 boxes as they come out of their few bits, none smaller than it was; node_bytes."""

    lo: np.ndarray
    hi: np.ndarray
    node_bytes: int


def quantised(lo: np.ndarray, hi: np.ndarray, bits: int, reference_bytes: int = REFERENCE_BYTES) -> Planes:
    """Planes of so many bits in the frame of their node: its lowest corner, and for each axis a step that is a power of two, as
    in compressed wide BVHs (Ylitie, Karras and Laine 2017, section 3.1). lo, hi: (N, C, 3) float32, of C children; empty
    ones (lo = inf) stay as they are.

    Rounded outwards, and moved one step on where float32 arithmetic would still cut something off: no box shrinks.
    """
    empty = ~(lo <= hi).all(axis=2, keepdims=True)
    low = np.where(empty, np.inf, lo).min(axis=1, keepdims=True)
    high = np.where(empty, -np.inf, hi).max(axis=1, keepdims=True)
    origin = np.where(np.isfinite(low), low, 0.0).astype(np.float32)
    extent = np.where(np.isfinite(high - low), high.astype(np.float64) - low, 0.0)
    # One step to spare, for planes that have to move on.
    step = np.exp2(np.ceil(np.log2(np.maximum(extent / ((1 << bits) - 2), 2.0**-100)))).astype(np.float32)

    def plane(code: np.ndarray) -> np.ndarray:
        return origin + code.astype(np.float32) * step

    with np.errstate(invalid="ignore"):
        below = np.clip(np.floor((lo.astype(np.float64) - origin) / step), 0, (1 << bits) - 1)
        above = np.clip(np.ceil((hi.astype(np.float64) - origin) / step), 0, (1 << bits) - 1)
        below -= (plane(below) > lo) & (below > 0)
        above += (plane(above) < hi) & (above < (1 << bits) - 1)
    out_lo, out_hi = np.where(empty, lo, plane(below)), np.where(empty, hi, plane(above))
    size = -(-lo.shape[1] * 6 * bits // 8) + FRAME_BYTES + reference_bytes
    return Planes(out_lo.astype(np.float32), out_hi.astype(np.float32), size)


def with_planes(accel: Accelerator, bits: int) -> tuple[Accelerator, int]:
    """The same tree with planes of so many bits, and the bytes of a node."""
    nodes = accel.built.arrays["nodes"].copy()
    lo, hi = (np.stack([nodes[f"{end}_{side}"] for side in (0, 1)], axis=1) for end in ("lo", "hi"))
    planes = quantised(lo, hi, bits)
    for side in (0, 1):
        nodes[f"lo_{side}"], nodes[f"hi_{side}"] = planes.lo[:, side], planes.hi[:, side]
    built: Built = replace(accel.built, arrays={**accel.built.arrays, "nodes": nodes})
    return Bvh2.restore(built, accel.geometry), planes.node_bytes


def resized(counters: Counters, before: int, after: int) -> Counters:
    """The same fetches from nodes of another size."""
    node = counters.address < int(PRIMITIVE_SPACE)
    counts: Any = counters.counts.copy()
    counts["node_bytes"] = counts["nodes"] * after
    return Counters(counts, counters.first, np.where(node, counters.address // before * after, counters.address),
                    np.where(node, after, counters.size))


def base(geometry: Geometry) -> Accelerator:
    """The binary BVH that all studies start from."""
    return Bvh2(geometry)
