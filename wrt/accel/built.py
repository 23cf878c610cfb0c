"""The arrays that a builder gives, and figures of a structure: sizes, costs, refits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from wrt.core.device import on_host


@dataclass(frozen=True, eq=False)
class Built:
    """What a builder gives: arrays, one for each field of the structure's struct but `primitives` and `recorder`, records or
    rows of numbers (a field that is no array: a NumPy scalar or row); order: (R,) int32, the prim_id of each record of
    `primitives`, where one may stand more than once, unless cells share records: then there is an array `references` of their
    indices; and what AccelStats tells of a tree.

    What was made on a device is there: then arrays and order are Warp's, and parents is the parent of each node."""

    arrays: dict[str, Any]
    order: Any
    nodes: int = 0
    leaves: int = 0
    depth: int = 0
    sah_cost: float = float("nan")
    parents: Any = None

    def on_host(self) -> Built:
        """The same with NumPy arrays."""
        if not isinstance(self.order, wp.array):
            return self
        return replace(self, arrays={name: on_host(array) for name, array in self.arrays.items()}, order=on_host(self.order),
                       parents=None)

    @property
    def references(self) -> int:
        return len(self.arrays.get("references", self.order))


@dataclass(frozen=True)
class AccelStats:
    """build_seconds: wall clock, without those in which the builder's kernels were compiled; nodes, leaves, depth: 0 where there is
    no tree; references: primitives in all leaves together, more than there are where a structure splits space; bytes: on the
    device, triangles included; sah_cost: expected cost of a random line through the root box, one node visited and one
    primitive tested costing 1 each (NaN where nobody knows)."""

    build_seconds: float
    nodes: int
    leaves: int
    depth: int
    references: int
    bytes: int
    sah_cost: float


@dataclass(frozen=True)
class Refit:
    """What OneMesh.refit or Instances.move did: seconds; growth: SAH cost of the refitted tree over that of the tree when it was
    built; rebuilt: whether that was too much, and a new tree was built."""

    seconds: float
    growth: float
    rebuilt: bool
