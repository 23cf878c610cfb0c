"""What a builder gives, and what a refit replaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from wrt.accel.geometry import Geometry


@dataclass(frozen=True, eq=False)
class Built:
    """What a builder gives: arrays, one for each field of the structure's struct but `primitives` and `recorder`, records or
    rows of numbers (a field that is no array: a NumPy scalar or row); order: (R,) int32, the prim_id of each record of
    `primitives`, where one may stand more than once, unless cells share records: then there is an array `references` of their
    indices; and what AccelStats tells of a tree."""

    arrays: dict[str, np.ndarray]
    order: np.ndarray
    nodes: int = 0
    leaves: int = 0
    depth: int = 0
    sah_cost: float = float("nan")

    @property
    def references(self) -> int:
        return len(self.arrays.get("references", self.order))


@dataclass(frozen=True, eq=False)
class State:
    """All that a refit changes. It is replaced as a whole, and nothing in it is written to: whoever takes it once has parts that
    belong together, whatever other threads do. data: the Warp struct that kernels get; built_cost: the SAH cost that growth is
    measured against. Until the structure is built, there is a geometry and nothing else."""

    geometry: Geometry
    built: Any = None
    data: Any = None
    stats: Any = None
    built_cost: float = float("nan")
