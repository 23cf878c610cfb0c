"""What a builder gives, and what a refit replaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.device import on_host

T = TypeVar("T")


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


@dataclass(frozen=True, eq=False)
class State:
    """All that a refit changes. It is replaced as a whole, and nothing but a refit in place writes to what is in it: whoever takes
    it once has parts that belong together, whatever other threads do. data: the Warp struct that kernels get; built_cost: the SAH
    cost that growth is measured against; followed: the Warp array of a refit, where it requires gradients
    (wrt.accel.queries.gradients); changes: whether refits in place write to it. Until the structure is built, there is a geometry
    and nothing else."""

    geometry: Geometry
    built: Any = None
    data: Any = None
    stats: Any = None
    built_cost: float = float("nan")
    followed: Any = None
    changes: bool = False


def once(make: Callable[..., T]) -> Callable[..., T]:
    """A function whose last argument is a state of a structure: called once for each, unless refits in place change it."""
    kept: WeakKeyDictionary[State, T] = WeakKeyDictionary()

    def made(*given: Any) -> T:
        state = given[-1]
        if state in kept:
            return kept[state]
        return make(*given) if state.changes else kept.setdefault(state, make(*given))

    return made
