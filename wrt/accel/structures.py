"""Table of acceleration structures, name -> class, and their options. A lookup imports the class, so that `--help` waits for no Warp."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar, get_type_hints

from wrt.core.checks import accepts, did_you_mean, shown
from wrt.core.errors import InputError
from wrt.core.registry import Registry

T = TypeVar("T")

ACCELERATORS: Registry[type[Any]] = Registry("structure", {
    "bvh": "wrt.accel.bvh.wide:Bvh8",  # the default
    "bvh2": "wrt.accel.bvh.binary:Bvh2",
    "bvh4": "wrt.accel.bvh.wide:Bvh4",
    "bvh6": "wrt.accel.bvh.six:Bvh6",
    "bvh8": "wrt.accel.bvh.wide:Bvh8",
    "bvh2_sphere": "wrt.accel.bvh.volumes:Bvh2Sphere",
    "bvh2_kdop": "wrt.accel.bvh.volumes:Bvh2Kdop",
    "bvh8c": "wrt.accel.bvh.wide:Bvh8c",
    "kdtree": "wrt.accel.cells.trees:KdTree",
    "bsp": "wrt.accel.cells.trees:Bsp",
    "brute_force": "wrt.accel.brute_force:BruteForce",
    "grid": "wrt.accel.cells.grid:Grid",
    "octree": "wrt.accel.cells.trees:Octree",
}, "wrt.structures", type)


@dataclass(frozen=True)
class NoOptions:
    """Empty options, for a structure without options."""


def require_between(**options: tuple[float, float, float]) -> None:
    """Raise InputError for an option whose value is out of range. options: name=(value, low, high)."""
    for name, (value, low, high) in options.items():
        if not low <= value <= high:
            raise InputError(f"must be {low:.10g} to {high:.10g}, got {value}", argument=name)


def options_of(name: str, options: type[T], values: dict[str, object]) -> T:
    """Make the options of a structure. Raises InputError for unknown options, wrong types and values out of range."""
    known, types = {field.name: field for field in fields(options)}, get_type_hints(options)  # type: ignore[arg-type]
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
