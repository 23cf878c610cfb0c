"""State of a structure at one time: everything that a query reads and a refit replaces."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from wrt.accel.built import AccelStats, Built
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.structure import Structure
from wrt.core.types import Device, WarpArray, WarpStruct

P = ParamSpec("P")
T = TypeVar("T")
UNBUILT = AccelStats()


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of a structure. A refit makes a new one; only a refit in place modifies its arrays."""

    structure: Structure
    device: Device
    surfaces: WarpStruct  # kernels.structs.Surfaces, with only n_triangles and spheres set.
    attributes: FlatScene | None  # Normals, materials and the like; None if the structure was built from a geometry.
    geometry: Geometry | InstancedGeometry
    data: WarpStruct = None  # Warp struct of the arrays.
    stats: AccelStats = UNBUILT
    built: Built | None = None  # None for instances.
    built_cost: float = float("nan")  # SAH cost at the last build.
    roots: WarpArray | None = None  # For instances, (W,) index of each world's root node.
    order: np.ndarray | None = None  # For instances, (I,) row of geometry.to_world of each placement.
    followed: WarpArray | None = None  # Vertices of the last refit, if they require gradients.
    changes: bool = False  # True if refits in place modify the arrays.

    @property
    def mesh(self) -> Geometry:
        """Geometry of a structure over one mesh."""
        assert isinstance(self.geometry, Geometry)
        return self.geometry

    @property
    def arrays(self) -> Built:
        """Result of the builder, or of the last refit, of a structure over one mesh."""
        assert self.built is not None
        return self.built

    def observed(self, data: WarpStruct, observer: str) -> "Snapshot":
        """Return the snapshot with `data` in place of its own data, for kernels with an observer (Units.observer)."""
        units = self.structure.units._replace(observer=observer)
        return replace(self, structure=self.structure._replace(units=units), data=data)


def once(make: Callable[Concatenate[Snapshot, P], T]) -> Callable[Concatenate[Snapshot, P], T]:
    """Cache the results of a function of a snapshot, except for snapshots that refits in place modify.

    The function's other arguments, such as `threads`, must not change its result.
    """
    cache: WeakKeyDictionary[Snapshot, T] = WeakKeyDictionary()

    def cached(snapshot: Snapshot, /, *arguments: P.args, **named: P.kwargs) -> T:
        if snapshot in cache:
            return cache[snapshot]
        value = make(snapshot, *arguments, **named)
        return value if snapshot.changes else cache.setdefault(snapshot, value)

    return cached
