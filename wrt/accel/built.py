"""Arrays that a builder makes, and figures of a structure: sizes, costs, refits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from wrt.core.device import on_host
from wrt.core.types import WarpArray


@dataclass(frozen=True, eq=False)
class Built:
    """Result of a builder, in NumPy arrays, or in Warp's if it was built on a device (`parents`: of each node there).

    arrays: one for each field of the structure's struct but `primitives` and `recorder`: records, or rows of numbers. order: (R,)
    int32, prim_id of each record of `primitives`; one may occur several times. Where cells share records, an array `references` has
    their indices. nodes, leaves, depth, sah_cost: as in AccelStats.
    """

    arrays: dict[str, Any]
    order: Any
    nodes: int = 0
    leaves: int = 0
    depth: int = 0
    sah_cost: float = float("nan")
    parents: WarpArray | None = None

    def on_host(self) -> Built:
        """Return the same with NumPy arrays."""
        if not isinstance(self.order, wp.array):
            return self
        return replace(self, arrays={name: on_host(array) for name, array in self.arrays.items()}, order=on_host(self.order),
                       parents=None)

    @property
    def references(self) -> int:
        return len(self.arrays.get("references", self.order))


@dataclass(frozen=True)
class AccelStats:
    """Figures of a structure.

    Attributes
    ----------
    build_seconds : float
        Wall clock, without the compilation of kernels.
    nodes, leaves, depth : int
        Size of the tree; 0 without a tree.
    references : int
        Primitives in all leaves together; structures that split space hold some of them several times.
    bytes : int
        Memory on the device, triangles included.
    sah_cost : float
        Expected cost of a random line through the root box, at 1 per node visited and 1 per primitive tested; NaN if unknown.
    """

    build_seconds: float = 0.0
    nodes: int = 0
    leaves: int = 0
    depth: int = 0
    references: int = 0
    bytes: int = 0
    sah_cost: float = float("nan")


@dataclass(frozen=True)
class Refit:
    """Result of `refit` or `move`.

    Attributes
    ----------
    seconds : float
        Wall clock.
    growth : float
        SAH cost of the refitted tree divided by its cost when it was built.
    rebuilt : bool
        Whether that was above `rebuild_at`, so that a new tree was built.
    """

    seconds: float
    growth: float
    rebuilt: bool
