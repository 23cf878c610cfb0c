"""State of a structure at one time: everything that a query reads and a refit replaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar
from weakref import WeakKeyDictionary

from wrt.accel.built import AccelStats, Built
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.structure import Structure
from wrt.core.types import Device, WarpArray, WarpStruct

T = TypeVar("T")
UNBUILT = AccelStats()


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of a structure. A refit replaces it as a whole; only a refit in place writes to its arrays.

    surfaces: kernels.structs.Surfaces with the number of triangles and the spheres alone. attributes: normals, materials and the
    like, where wrt.build knows them. built: None over instances. built_cost: SAH cost that growth is measured against. roots: root
    of each world (W,), over instances. followed: vertices of the last refit, if they require gradients. changes: refits in place
    write to it.
    """

    structure: Structure
    device: Device
    surfaces: WarpStruct
    attributes: FlatScene | None
    geometry: Geometry | InstancedGeometry
    data: WarpStruct = None
    stats: AccelStats = UNBUILT
    built: Built | None = None
    built_cost: float = float("nan")
    roots: WarpArray | None = None
    followed: WarpArray | None = None
    changes: bool = False

    @property
    def mesh(self) -> Geometry:
        """Geometry of a structure over one mesh."""
        assert isinstance(self.geometry, Geometry)
        return self.geometry

    @property
    def arrays(self) -> Built:
        """Arrays of a structure over one mesh."""
        assert self.built is not None
        return self.built

    def over(self, geometry: Geometry | InstancedGeometry) -> Snapshot:
        """Return a snapshot over another geometry, with nothing built yet."""
        return Snapshot(self.structure, self.device, self.surfaces, self.attributes, geometry)

    def counting(self, data: WarpStruct) -> Snapshot:
        """Return the snapshot for kernels that count, with `data` in place of its own."""
        units = self.structure.units._replace(counters=True)
        return replace(self, structure=self.structure._replace(units=units), data=data)


def once(make: Callable[[Snapshot], T]) -> Callable[[Snapshot], T]:
    """Cache a function of a snapshot, except for snapshots that refits in place change."""
    kept: WeakKeyDictionary[Snapshot, T] = WeakKeyDictionary()

    def made(snapshot: Snapshot) -> T:
        if snapshot in kept:
            return kept[snapshot]
        return make(snapshot) if snapshot.changes else kept.setdefault(snapshot, make(snapshot))

    return made
