"""A structure at one time: all that a query reads, and all that a refit replaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from wrt.accel.flat_scene import FlatScene
from wrt.accel.structure import Structure

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A structure as it was once. A refit replaces it as a whole, and only a refit in place writes to what is in it: whoever takes
    it once has parts that belong together, whatever other threads do.

    structure: kind and test units; device: a Warp device; surfaces: kernels.structs.Surfaces with the number of triangles and the
    spheres alone; attributes: what wrt.build knows of the primitives beyond the geometry (None: nothing); geometry: a Geometry or
    an InstancedGeometry.

    data: the Warp struct that kernels get; stats: AccelStats; built: what the builder gave, None of instances; built_cost: the SAH
    cost that growth is measured against; roots: of instances the root of each world, a Warp array (W,); followed: the Warp array
    of a refit, where it requires gradients (wrt.accel.queries.gradients); changes: whether refits in place write to it.
    """

    structure: Structure
    device: Any
    surfaces: Any
    attributes: FlatScene | None
    geometry: Any
    data: Any = None
    stats: Any = None
    built: Any = None
    built_cost: float = float("nan")
    roots: Any = None
    followed: Any = None
    changes: bool = False

    def over(self, geometry: Any) -> Snapshot:
        """The same over another geometry, before anything is built over it."""
        return Snapshot(self.structure, self.device, self.surfaces, self.attributes, geometry)

    def counting(self, data: Any) -> Snapshot:
        """The same for kernels that count, with another record of what they read."""
        units = self.structure.units._replace(counters=True)
        return replace(self, structure=self.structure._replace(units=units), data=data)


def once(make: Callable[[Snapshot], T]) -> Callable[[Snapshot], T]:
    """A function of a snapshot: called once for each, unless refits in place change it."""
    kept: WeakKeyDictionary[Snapshot, T] = WeakKeyDictionary()

    def made(snapshot: Snapshot) -> T:
        if snapshot in kept:
            return kept[snapshot]
        return make(snapshot) if snapshot.changes else kept.setdefault(snapshot, make(snapshot))

    return made
