"""Types of the values in a TOML scene file, and the base class of its tables. A single number in place of a colour is a grey."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, WithJsonSchema, model_validator

from wrt.core.types import JsonObject
from wrt.scene.materials import WRAPS
from wrt.scene.values import rounded

Annotation: TypeAlias = Any  # a type, or metadata of a type, made at run time


def _repeated(count: int) -> Callable[[object], object]:
    """Return a function that turns a single number into a list of `count` equal numbers."""
    return lambda value: [value] * count if isinstance(value, int | float) and not isinstance(value, bool) else value


def _or_one(values: dict[str, Any], count: int) -> WithJsonSchema:
    array = {"type": "array", "items": values, "minItems": count, "maxItems": count}
    return WithJsonSchema({"anyOf": [values, array]})


def unit(name: str) -> Annotation:
    """Return metadata that gives a number a unit in the schema."""
    return Field(json_schema_extra={"unit": name})


def within(bounds: dict[str, Any]) -> BeforeValidator:
    """Return metadata that rounds a number to its limits ge and le: 90.0000025 degrees are pi / 2 in float32."""
    return BeforeValidator(lambda value: rounded(
        value, bounds.get("ge") or 0.0, bounds.get("le", value)) if isinstance(value, float) else value)


LENGTH, DEGREES = unit("length"), unit("degrees")
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[float], Field(min_length=16, max_length=16)]
Positive = Annotated[float, Field(gt=0.0)]
Point = Annotated[list[float], Field(min_length=3, max_length=3), LENGTH]
Length = Annotated[float, Field(gt=0.0), LENGTH]
Angle = Annotated[float, DEGREES]
Angles = Annotated[list[float], Field(min_length=3, max_length=3), DEGREES]
Share = Annotated[  # a colour that reflects or transmits
    list[Annotated[float, within({"ge": 0.0, "le": 1.0}), Field(ge=0.0, le=1.0)]], Field(min_length=3, max_length=3),
    BeforeValidator(_repeated(3)),
    _or_one({"type": "number", "minimum": 0, "maximum": 1}, 3)]
Radiance = Annotated[  # a colour without an upper bound
    list[Annotated[float, Field(ge=0.0)]], Field(min_length=3, max_length=3), BeforeValidator(_repeated(3)),
    _or_one({"type": "number", "minimum": 0}, 3)]
Scale3 = Annotated[list[float], Field(min_length=3, max_length=3), BeforeValidator(_repeated(3)), _or_one({"type": "number"}, 3)]
Scale2 = Annotated[list[float], Field(min_length=2, max_length=2), BeforeValidator(_repeated(2)), _or_one({"type": "number"}, 2)]
WrapMode = Literal["repeat", "clamp", "mirror"]
Wraps = Annotated[list[WrapMode], Field(min_length=2, max_length=2),
                  BeforeValidator(lambda value: [value] * 2 if isinstance(value, str) else value),
                  _or_one({"type": "string", "enum": list(WRAPS)}, 2)]
Size = Annotated[list[Annotated[int, Field(ge=1, le=32768)]], Field(min_length=2, max_length=2)]


class Table(BaseModel):
    """A table of the file. Unknown keys, wrong types, NaN and infinity are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _note_keys(cls, data: Any, info: ValidationInfo) -> Any:
        """Record the keys of this table in the context of the validation, for the message about an unknown key."""
        if isinstance(info.context, dict) and isinstance(data, dict):
            info.context[id(data)] = list(cls.model_fields)
        return data

    def given(self, *leave_out: str) -> JsonObject:
        """Return the fields that the file sets, except `leave_out`, as plain values."""
        return self.model_dump(exclude_unset=True, exclude=set(leave_out))


class TypedTable(Table):
    """A table whose key `type` gives its kind."""

    type: str


def require_one(table: Table, *choices: tuple[str, ...]) -> None:
    """Raise ValueError unless the table sets fields of exactly one group in `choices`."""
    given = [names for names in choices if any(getattr(table, name) is not None for name in names)]
    if len(given) != 1:
        raise ValueError("give exactly one of " + ", or ".join(" and ".join(names) for names in choices))
