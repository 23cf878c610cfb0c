"""Class of a structure with its intersection tests: the key by which kernels are cached."""

from dataclasses import dataclass, fields
from functools import cache
from typing import Any, NamedTuple, TypeVar, get_type_hints

from wrt.accel.structures import ACCELERATORS
from wrt.core.checks import accepts, did_you_mean, require_known, shown
from wrt.core.device import made_once
from wrt.core.errors import InputError
from wrt.core.types import DeviceFunction, Kernel, KernelModule, WarpType
from wrt.kernels.query import make_any_hit_kernel, make_closest_hit_kernel, make_worlds_kernel
from wrt.kernels.traverse import instances as traverse_instances
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE

T = TypeVar("T")


def check_units(triangle: str, box: str) -> None:
    """Raise InputError for an unknown triangle test or box test."""
    require_known(triangle, RAY_TRIANGLE, "triangle test", "triangle")
    require_known(box, RAY_AABB, "box test", "box")


@dataclass(frozen=True)
class NoOptions:
    """Empty options, for a structure without options."""


@cache
def _types_of(options: type[Any]) -> dict[str, Any]:
    """Return the types of the fields of a dataclass."""
    return get_type_hints(options)


def options_of(name: str, options: type[T], values: dict[str, object]) -> T:
    """Make the options of a structure. Raises InputError for unknown options, wrong types and values out of range."""
    known, types = {field.name: field for field in fields(options)}, _types_of(options)  # type: ignore[arg-type]
    for option, value in values.items():
        if option not in known:
            names = [*known, "triangle", "box"]
            raise InputError(f"is no option of {name}",
                             argument=option, hint=f"{did_you_mean(option, names)}there is {', '.join(names)}")
        if not accepts(types[option], value):
            raise InputError(f"must be {getattr(types[option], '__name__', types[option])}, got {shown(value)}", argument=option)
    return options(**values)


def default_options(name: str) -> dict[str, object]:
    """Return the default value of each option of the structure called `name`."""
    return {field.name: field.default for field in fields(ACCELERATORS[name].options)}


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
    return make_worlds_kernel(structure.struct, structure.traversal(any_hit=any_hit), any_hit)
