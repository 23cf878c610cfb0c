"""State of a structure: its class with its intersection tests, the result of its builder, its statistics, and what a query reads of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry, InstancedGeometry
from wrt.core.checks import require_known
from wrt.core.device import made_once, on_host
from wrt.core.errors import InputError
from wrt.core.types import Device, DeviceFunction, Kernel, KernelModule, WarpArray, WarpStruct, WarpType
from wrt.kernels.query import make_any_hit_kernel, make_closest_hit_kernel, make_worlds_kernel
from wrt.kernels.traverse import instances as traverse_instances
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE

P = ParamSpec("P")
T = TypeVar("T")


def check_units(triangle: str, box: str) -> None:
    """Raise InputError for an unknown triangle test or box test."""
    require_known(triangle, RAY_TRIANGLE, "triangle test", "triangle")
    require_known(box, RAY_AABB, "box test", "box")


class Structure(NamedTuple):
    """Class and intersection tests (units) of a structure, from which kernels are made. Hashable.

    With Units.instances, the structure is a tree over structures of this class (wrt.accel.instances).
    """

    accel: type[Any]  # a subclass of wrt.accel.base.OneMesh, a module that imports this one
    units: Units = Units()

    @property
    def struct(self) -> WarpType:
        """Warp struct of the structure's arrays."""
        return struct_of(self)

    @property
    def bottom(self) -> WarpType:
        """Warp struct of a structure over one mesh: this structure, or, with instances, a structure of the lower level."""
        return struct_of(self._replace(units=self.units._replace(instances=False)))

    @property
    def filtered(self) -> "Structure":
        """The structure for rays that do not see all instances (Units.filtered)."""
        return self._replace(units=self.units._replace(filtered=True))

    def require_one_mesh(self, message: str) -> None:
        """Raise InputError with `message` if the structure has instances or spheres."""
        if self.units.instances or self.units.spheres:
            raise InputError(message, argument="accel")

    def traversal(self, *, any_hit: bool, accepts: DeviceFunction | None = None) -> DeviceFunction:
        """Make the traversal, a Warp function (accel, surfaces, ray) -> Hit. accepts: Warp function that can reject hits."""
        traverse = self.accel.kernels.make_traversal(self.units, any_hit, accepts)
        if self.units.instances:
            return traverse_instances.make_traversal(self.units, any_hit, traverse, self.bottom)
        return traverse


class WrappedStructure(NamedTuple):
    """A structure whose traversal notes each ray, for kernels of pictures; hashable, like Structure. wrapper: module with
    make_struct(struct) and make_traversal(struct, traverse, any_hit)."""

    inner: Structure
    wrapper: KernelModule

    @property
    def units(self) -> Units:
        return self.inner.units

    @property
    def struct(self) -> WarpType:
        struct: WarpType = self.wrapper.make_struct(self.inner.struct)
        return struct

    def traversal(self, *, any_hit: bool, accepts: DeviceFunction | None = None) -> DeviceFunction:
        inner = self.inner.traversal(any_hit=any_hit, accepts=accepts)
        wrapped: DeviceFunction = self.wrapper.make_traversal(self.inner.struct, inner, any_hit)
        return wrapped


@made_once
def struct_of(structure: Structure) -> WarpType:
    if structure.units.instances:
        return traverse_instances.make_struct(structure.bottom)
    return structure.accel.kernels.make_struct(structure.units.triangle_test.record)


@made_once
def closest_hit_kernel(structure: Structure) -> Kernel:
    return make_closest_hit_kernel(structure.struct, structure.traversal(any_hit=False))


@made_once
def any_hit_kernel(structure: Structure) -> Kernel:
    return make_any_hit_kernel(structure.struct, structure.traversal(any_hit=True))


@made_once
def worlds_kernel(structure: Structure, any_hit: bool) -> Kernel:
    return make_worlds_kernel(structure.struct, structure.traversal(any_hit=any_hit), any_hit, structure.units.filtered)


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
    bodies: WarpArray | None = None  # For instances: see Instances.bodies; None if an object is not an instance.
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


def once_for_all(make: Callable[Concatenate[Snapshot, P], T]) -> Callable[Concatenate[Snapshot, P], T]:
    """Cache the results of a function of a snapshot, which refits in place must not change, nor other arguments, such as `threads`."""
    cache: WeakKeyDictionary[Snapshot, T] = WeakKeyDictionary()

    def cached(snapshot: Snapshot, /, *arguments: P.args, **named: P.kwargs) -> T:
        if snapshot in cache:
            return cache[snapshot]
        return cache.setdefault(snapshot, make(snapshot, *arguments, **named))

    return cached


def once(make: Callable[Concatenate[Snapshot, P], T]) -> Callable[Concatenate[Snapshot, P], T]:
    """Do as `once_for_all`, but call the function each time for a snapshot that refits in place modify."""
    cached = once_for_all(make)

    def present(snapshot: Snapshot, /, *arguments: P.args, **named: P.kwargs) -> T:
        return (make if snapshot.changes else cached)(snapshot, *arguments, **named)

    return present
