"""Descriptions of dataclass fields, for Python, for scene files and for the reference page; the base class of lights and backgrounds."""

from __future__ import annotations

from dataclasses import Field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

if TYPE_CHECKING:  # the command line reads descriptions without NumPy
    import numpy as np

    from wrt.scene.values import Color

K = TypeVar("K", bound="Kind")
Record = dict[str, Any]  # values by the field names of a device struct: scalars, tuples, arrays


def given(form: str, about: str, unit: str = "", **limits: Any) -> dict[str, Any]:
    """Return the `metadata` that describes a dataclass field.

    - form: a key of wrt.scene.values.FORMS; about: text in the reference of scene files; unit: "" for none, or if the form implies it.
    - limits: bounds ge, gt, le, lt of numbers, angles (in degrees) and colours; or the allowed values or classes (among)."""
    return {"form": form, "about": about, "unit": unit, "limits": limits}


def forms(kind: type[object]) -> dict[str, Field[Any]]:
    """Return the fields of a dataclass that `given` describes, by name."""
    return {each.name: each for each in fields(kind) if "form" in each.metadata}  # type: ignore[arg-type]


def check_fields(thing: object, at: str) -> None:
    """Convert each described field of a dataclass instance to its form; None stays if it is the default. Messages begin with `at`."""
    from wrt.scene.values import FORMS

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
        from wrt.core.checks import at_thing

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
