"""Kinds of lights and backgrounds: each says once what it is, for scenes in Python, for scene files and for the device."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import Field, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from wrt.core.checks import as_array, at_thing
from wrt.core.errors import InputError
from wrt.scene.values import Color, _unit, as_number, as_vector

K = TypeVar("K", bound="Kind")


Limits = dict[str, float]


def _number(value: Any, what: str, limits: Limits, unit: float = 1.0) -> float:
    low, high = limits.get("ge", limits.get("gt", -math.inf)), limits.get("le", limits.get("lt", math.inf))
    return as_number(value, what, low=low * unit, high=high * unit)


def _image(value: Any, what: str, limits: Limits) -> np.ndarray:
    image = as_array(value, np.float32, what)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(f"{what} must be (H, W, 3), got {image.shape}")
    if not np.isfinite(image).all() or (image < 0.0).any():
        raise InputError(f"{what} must be finite and not negative")
    return image


# What a field of a kind can be, and how it is checked.
FORMS: dict[str, Callable[[Any, str, Limits], Any]] = {
    "point": lambda value, what, limits: as_vector(value, what),  # in world space; it moves with the scene
    "direction": lambda value, what, limits: _unit(as_vector(value, what), what),  # of any length, kept at 1; it turns
    "color": lambda value, what, limits: as_vector(value, what, low=0.0),
    "number": _number,
    "angle": lambda value, what, limits: _number(value, what, limits, math.pi / 180.0),  # radians here, degrees in files and limits
    "image": _image,  # (H, W, 3) float32 linear radiance; in a file the name of an image file
}


def given(form: str, about: str, unit: str = "", **limits: float) -> dict[str, Any]:
    """A field's `metadata`: one of FORMS, what it is (for the reference of scene files), its unit where the form says none, and
    for numbers and angles their limits (ge, gt, le, lt)."""
    return {"form": form, "about": about, "unit": unit, "limits": limits}


def forms(kind: type[Kind]) -> dict[str, Field[Any]]:
    """The fields that describe the thing, by name; `name` itself is none."""
    return {each.name: each for each in fields(kind) if "form" in each.metadata}  # type: ignore[arg-type]


class Kind:
    """A frozen dataclass whose fields are each `field(metadata=given(...))`, and `name: str = ""`.

    kind: its name in scene files, in the table of kinds here and in the one of device functions; what: how messages call it.
    """

    kind: ClassVar[str]
    what: ClassVar[str]
    name: str

    def __post_init__(self) -> None:
        at = at_thing(self.what, self.name)
        for name, each in forms(type(self)).items():
            check = FORMS[each.metadata["form"]]
            object.__setattr__(self, name, check(getattr(self, name), at + name, each.metadata["limits"]))

    def record(self) -> dict[str, Any]:
        """What the device function reads: values by their names in the struct of kernels/structs.py."""
        raise NotImplementedError

    def moved(self: K, matrix: np.ndarray) -> K:
        """Under a (4, 4) transform: points move, directions turn, all else stays, as in glTF."""
        changes: dict[str, Any] = {}
        for name, each in forms(type(self)).items():
            if each.metadata["form"] == "point":
                changes[name] = matrix[:3, :3] @ getattr(self, name) + matrix[:3, 3]
            elif each.metadata["form"] == "direction":
                changes[name] = matrix[:3, :3] @ getattr(self, name)
        return replace(self, **changes)  # type: ignore[type-var]

    def places(self) -> list[Color]:
        """Its points in the world; none of what is infinitely far away."""
        return [getattr(self, name) for name, each in forms(type(self)).items() if each.metadata["form"] == "point"]
