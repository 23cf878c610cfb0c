"""Result of a builder, and statistics of structures and refits."""

from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from wrt.core.device import on_host
from wrt.core.types import WarpArray


@dataclass(frozen=True, eq=False)
class Built:
    """Result of a builder, in NumPy arrays, or in Warp arrays if it was built on the device.

    In a grid or octree, cells share records: arrays["references"] lists the indices of each cell's records. The other fields are as in
    AccelStats.
    """

    arrays: dict[str, Any]  # For each field of the Warp struct, except `primitives` (records of the triangle test) and `recorder`.
    order: Any  # (R,) int32, prim_id of each record in `primitives`; a prim_id may occur several times.
    nodes: int = 0
    leaves: int = 0
    depth: int = 0
    sah_cost: float = float("nan")
    parents: WarpArray | None = None  # (N,) Warp array, index of each node's parent; None if `arrays` are NumPy arrays.

    def on_host(self) -> "Built":
        """Convert the arrays to NumPy arrays."""
        if not isinstance(self.order, wp.array):
            return self
        return replace(self, arrays={name: on_host(array) for name, array in self.arrays.items()}, order=on_host(self.order),
                       parents=None)

    @property
    def references(self) -> int:
        return len(self.arrays.get("references", self.order))


@dataclass(frozen=True)
class AccelStats:
    """Statistics of a structure.

    Attributes
    ----------
    build_seconds : float
        Wall-clock time of the build, without the compilation of kernels.
    nodes, leaves, depth : int
        Number of nodes, number of leaves, and depth of the tree. The nodes of a grid are its cells, with depth 1. Brute force has 0.
    references : int
        Number of primitives in all leaves together. A structure that splits space counts some primitives several times.
    bytes : int
        Memory on the device, including the triangles.
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
        Wall-clock time.
    growth : float
        SAH cost of the refitted tree divided by the SAH cost at the last build; NaN after a refit in place.
    rebuilt : bool
        Whether `growth` exceeded `rebuild_at`, so that a new tree was built.
    """

    seconds: float
    growth: float
    rebuilt: bool
