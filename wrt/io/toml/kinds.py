"""Pydantic tables made from the described fields of a class (wrt.scene.kinds), and lights and backgrounds made from such tables."""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, create_model

from wrt.io.toml.values import Angle, Annotation, Point, Radiance, Share, Size, Table, TypedTable, Vector, unit, within
from wrt.scene.kinds import Kind, Limits, forms
from wrt.scene.values import SMALLEST

K = TypeVar("K", bound=Kind)
_literal: Any = Literal
TYPES: dict[str, Callable[[Limits], Annotation]] = {
    "point": lambda limits: Point, "direction": lambda limits: Vector, "angle": lambda limits: Angle,
    "color": lambda limits: Share if limits.get("le") == 1.0 else Radiance,
    "number": lambda limits: float, "whole": lambda limits: int, "flag": lambda limits: bool, "size": lambda limits: Size,
    "choice": lambda limits: _literal[limits["among"]], "image": lambda limits: str,
}
BOUNDED = ("number", "whole", "angle")  # forms whose limits become bounds in the schema; for other forms, the types in TYPES have bounds


def described(kind: type, types: Mapping[str, Callable[[Limits], Annotation]] = TYPES) -> dict[str, Annotation]:
    """Return the keys of a class's table: its described fields, with angles in degrees and the key "file" for an image."""
    keys: dict[str, Any] = {}
    for key, each in forms(kind).items():
        form, limits = each.metadata["form"], each.metadata["limits"]
        bounds = limits if form in BOUNDED else {}
        if bounds.get("ge") == SMALLEST:
            bounds = {**bounds, "ge": None, "gt": 0.0}
        value: Any = types[form](limits)
        if form in ("number", "angle") and bounds:
            value = Annotated[value, within(bounds)]
        if each.metadata["unit"]:
            value = Annotated[value, unit(each.metadata["unit"])]
        default = ... if each.default is MISSING else _written(form, each.default)
        if each.default is None:
            value = value | None
        keys["file" if form == "image" else key] = (value, Field(default, description=each.metadata["about"], **bounds))
    return keys


def kind_table(kind: type[Kind], what: str) -> type[TypedTable]:
    """Make the table of a kind: for the kind "point", PointLightTable if `what` is "Light"."""
    keys = {"type": (_literal[kind.kind], ...), **described(kind)}
    if "file" not in keys and _has_name(kind):
        keys["name"] = (str, Field("", description="name in messages"))
    summary = (kind.__doc__ or kind.__name__).split("\n\n")[0]
    name = "".join(part.capitalize() for part in kind.kind.split("_"))
    return create_model(f"{name}{what}Table", __base__=TypedTable, __doc__=summary, **keys)


def _has_name(kind: type[Kind]) -> bool:
    return "name" in (each.name for each in fields(kind))  # type: ignore[arg-type]


def _written(form: str, value: Any) -> Any:
    """Return a default value as a scene file writes it."""
    if form == "angle":
        return math.degrees(value)
    return list(value) if isinstance(value, tuple) else value


def values_of(kind: type, table: Table) -> dict[str, Any]:
    """Return the values that a checked table sets, by the class's field names: angles in radians, an image as the name of its file."""
    values: dict[str, Any] = {}
    for key, each in forms(kind).items():
        form = each.metadata["form"]
        written = "file" if form == "image" else key
        if written in table.model_fields_set:
            value = getattr(table, written)
            values[key] = math.radians(value) if form == "angle" else value
    return values


def make(kind: type[K], table: Table, name: str, read: Callable[[str], np.ndarray]) -> K:
    """Make the light or background of a checked table. read: function that returns the image of a file name."""
    values: dict[str, Any] = ({"name": name} if _has_name(kind) else {}) | values_of(kind, table)
    for key, each in forms(kind).items():
        if each.metadata["form"] == "image":
            values |= {key: read(values[key]), "name": values[key]}
    return kind(**values)
