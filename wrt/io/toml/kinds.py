"""Lights and backgrounds of a TOML scene file: each kind's table, from what its fields say of themselves, and the thing itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, create_model

from wrt.io.toml.material_schema import Angle, Point, Radiance, Table, Vector, unit
from wrt.scene.kinds import Kind, forms

K = TypeVar("K", bound=Kind)
TYPES: dict[str, Any] = {"point": Point, "direction": Vector, "color": Radiance, "number": float, "angle": Angle, "image": str}


def kind_table(kind: type[Kind], what: str) -> type[Table]:
    """The table of that kind (PointLightTable, say, where `what` is Light), with angles in degrees and an image by its file."""
    literal: Any = Literal
    found: dict[str, Any] = {"type": (literal[kind.kind], ...)}
    for key, each in forms(kind).items():
        form, limits = each.metadata["form"], each.metadata["limits"]
        value: Any = TYPES[form] if not each.metadata["unit"] else Annotated[TYPES[form], unit(each.metadata["unit"])]
        default = ... if each.default is MISSING else _written(form, each.default)
        found["file" if form == "image" else key] = (value, Field(default, description=each.metadata["about"], **limits))
    if "file" not in found and _has_name(kind):
        found["name"] = (str, Field("", description="for messages"))
    summary = (kind.__doc__ or kind.__name__).split("\n\n")[0]
    name = "".join(part.capitalize() for part in kind.kind.split("_"))
    return create_model(f"{name}{what}Table", __base__=Table, __doc__=summary, **found)


def _has_name(kind: type[Kind]) -> bool:
    return "name" in (each.name for each in fields(kind))  # type: ignore[arg-type]


def _written(form: str, value: Any) -> Any:
    """A default as a file would have it."""
    if form == "angle":
        return math.degrees(value)
    return list(value) if isinstance(value, tuple) else value


def make(kind: type[K], table: Any, name: str, read: Callable[[str], Any]) -> K:
    """The light or background of a checked table; `read` is given the name of an image file."""
    values: dict[str, Any] = {"name": name} if _has_name(kind) else {}
    for key, each in forms(kind).items():
        written = "file" if each.metadata["form"] == "image" else key
        if written not in table.model_fields_set:
            continue
        value = getattr(table, written)
        if each.metadata["form"] == "image":
            value, values["name"] = read(value), value
        values[key] = math.radians(value) if each.metadata["form"] == "angle" else value
    return kind(**values)
