"""Descriptions of dataclass fields, for Python, for scene files and for the reference page; the base class of lights and backgrounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import Field, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from wrt.core.checks import as_array, as_choice, as_integer, as_one, as_size, at_thing
from wrt.core.errors import wrong
from wrt.scene.values import Color, _unit, as_number, as_vector

K = TypeVar("K", bound="Kind")
Limits = dict[str, Any]  # limits of a field: the keywords of `given`
Record = dict[str, Any]  # values by the field names of a device struct: scalars, tuples, arrays


def _number(value: Any, what: str, limits: Limits, unit: float = 1.0) -> float:
    low = max(limits.get(each, -math.inf) for each in ("ge", "gt"))
    high = min(limits.get(each, math.inf) for each in ("le", "lt"))
    return as_number(value, what, low=low * unit, high=high * unit, unit="" if unit == 1.0 else "radians")


def _image(value: Any, what: str, limits: Limits) -> np.ndarray:
    image = as_array(value, np.float32, what)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise wrong(what, f"must be (H, W, 3), got {image.shape}")
    if not np.isfinite(image).all() or (image < 0.0).any():
        raise wrong(what, "must be finite and not negative")
    return image


# Forms of a field. The function of a form checks and converts a value. Its arguments: the value, its name in messages, the limits.
FORMS: dict[str, Callable[[Any, str, Limits], Any]] = {
    "point": lambda value, what, limits: as_vector(value, what),  # in world space; a transform moves it
    "direction": lambda value, what, limits: _unit(as_vector(value, what), what),  # of any length, stored at 1; a transform turns it
    "color": lambda value, what, limits: as_vector(value, what, low=0.0, high=limits.get("le", math.inf)),
    "number": _number,
    "angle": lambda value, what, limits: _number(value, what, limits, math.pi / 180.0),  # radians; degrees in files and limits
    "whole": lambda value, what, limits: as_integer(value, what, limits["ge"], limits["le"]),
    "flag": lambda value, what, limits: value,
    "choice": lambda value, what, limits: as_choice(value, limits["among"], what),
    "size": lambda value, what, limits: as_size(value, what),
    "image": _image,  # (H, W, 3) float32 linear radiance; a scene file names an image file
    "texture": lambda value, what, limits: as_one(value, limits["among"], what),
}


def given(form: str, about: str, unit: str = "", **limits: Any) -> dict[str, Any]:
    """Return the `metadata` that describes a dataclass field.

    - form: a key of FORMS; about: text in the reference of scene files; unit: "" for none, or if the form implies the unit.
    - limits: bounds ge, gt, le, lt of numbers, angles (in degrees) and colours; or the allowed values or classes (among)."""
    return {"form": form, "about": about, "unit": unit, "limits": limits}


def forms(kind: type[object]) -> dict[str, Field[Any]]:
    """Return the fields of a dataclass that `given` describes, by name."""
    return {each.name: each for each in fields(kind) if "form" in each.metadata}  # type: ignore[arg-type]


def check_fields(thing: object, at: str) -> None:
    """Convert each described field of a dataclass instance to its form; None stays if it is the default. Messages begin with `at`."""
    for name, each in forms(type(thing)).items():
        value = getattr(thing, name)
        if value is not None or each.default is not None:
            object.__setattr__(thing, name, FORMS[each.metadata["form"]](value, at + name, each.metadata["limits"]))


class Kind:
    """Base of frozen dataclasses whose fields are described by `field(metadata=given(...))`, except `name: str = ""`.

    kind: name of the class in scene files, in LIGHTS or BACKGROUNDS, and in the table of device functions; what: noun in messages."""

    kind: ClassVar[str]
    what: ClassVar[str]
    name: str

    def __post_init__(self) -> None:
        check_fields(self, at_thing(self.what, self.name))

    def record(self) -> Record:
        """Return the values of the fields of the device struct, kernels.structs.Light or Background, by name."""
        raise NotImplementedError

    def moved(self: K, matrix: np.ndarray) -> K:
        """Return a copy with points and directions transformed by a (4, 4) matrix. Intensities stay the same, as in glTF."""
        changes: dict[str, Any] = {}
        for name, each in forms(type(self)).items():
            if each.metadata["form"] == "point":
                changes[name] = matrix[:3, :3] @ getattr(self, name) + matrix[:3, 3]
            elif each.metadata["form"] == "direction":
                changes[name] = matrix[:3, :3] @ getattr(self, name)
        return replace(self, **changes)  # type: ignore[type-var]

    def places(self) -> list[Color]:
        """Return the points of a light in world space; [] for a light at infinity."""
        return [getattr(self, name) for name, each in forms(type(self)).items() if each.metadata["form"] == "point"]
