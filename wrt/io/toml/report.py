"""Checks of a TOML scene file against its schema, with a line for each mistake."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from wrt.core.checks import short, unknown
from wrt.core.errors import InputError, InputErrors
from wrt.core.types import JsonObject
from wrt.io.toml.schema import Schema, Table, scene_schema
from wrt.scene.values import ROUNDING

MOST = 20  # largest number of problems in the message about a file
# The types of a schema: in words, and in Python.
TYPES: dict[str, tuple[str, tuple[type, ...]]] = {
    "number": ("a number", (int, float)), "integer": ("a whole number", (int,)), "string": ("text", (str,)),
    "boolean": ("true or false", (bool,)), "array": ("an array", (list,)), "object": ("a table", (dict,)),
}
# The limits of a schema: in signs, and the comparison that is true of a value beyond.
LIMITS = {"minimum": (">=", operator.lt), "exclusiveMinimum": (">", operator.le), "maximum": ("<=", operator.gt),
          "exclusiveMaximum": ("<", operator.ge)}


def check(data: JsonObject, path: Path) -> JsonObject:
    """Return the tables of a scene file unchanged. Raises one InputError that lists all mistakes."""
    schema = scene_schema()
    raise_all(list(mistakes(data, schema, "", schema["$defs"])), path)
    return data


def check_settings(values: JsonObject, origin: str) -> JsonObject:
    """Check settings by the rules of [settings] in a scene file. Raises one InputError that begins with `origin` and lists all mistakes."""
    schema = scene_schema()
    for name in values:
        if name in schema["properties"]:
            raise InputError("is a key of the scene, not of its settings", path=origin, place=name, hint="write it into the scene file")
    raise_all([*mistakes(values, schema["$defs"]["SettingsTable"], "", schema["$defs"])], Path(origin))
    return values


def raise_all(problems: Sequence[InputError], path: Path) -> None:
    """Raise one InputError with a line for each problem, at most MOST lines. Without problems, return."""
    lines = {str(problem): problem for problem in problems}
    if len(lines) == 1:
        raise problems[0].at(path)
    if lines:
        more = [f"and {len(lines) - MOST} more"] * (len(lines) > MOST)
        raise InputErrors("\n  ".join([f"{len(lines)} errors", *list(lines)[:MOST], *more]), list(lines.values()), path=path)


def mistakes(value: Any, schema: Schema, place: str, tables: Mapping[str, Table]) -> Iterator[InputError]:
    """Yield an error for each place where a value does not fit its schema. place: of the value in the file, such as "meshes[0].file"."""
    if "$ref" in schema:
        schema = tables[schema["$ref"].rsplit("/", 1)[-1]]
    choices = schema.get("anyOf") or [schema]
    fitting = [each for each in choices if _has_type(value, _type(each))]
    if not fitting:
        yield _wrong(value, " or ".join(TYPES[_type(each)][0] for each in choices), place)
    elif fitting[0] is not schema and "anyOf" in schema:
        yield from mistakes(value, fitting[0], place, tables)
    elif "discriminator" in schema:
        yield from _in_one_of(value, schema, place, tables)
    elif isinstance(value, dict):
        yield from _in_table(value, schema, place, tables)
    elif isinstance(value, list):
        least, most = schema.get("minItems", 0), schema.get("maxItems", math.inf)
        if not least <= len(value) <= most:
            yield _wrong(value, f"{least} values" if least == most else f"at least {least} values", place)
            return
        for i, each in enumerate(value):
            yield from mistakes(each, schema["items"], f"{place}[{i}]", tables)
    elif isinstance(value, str):
        if value not in schema.get("enum", [value]):
            yield unknown(value, "value", schema["enum"], place=place)
    elif isinstance(value, float) and not math.isfinite(value):
        yield _wrong(value, "a finite number", place)
    elif isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
        yield _wrong(value, "a number of at most 64 bits", place)
    elif not isinstance(value, bool):
        yield from (_wrong(value, f"a number {LIMITS[name][0]} {schema[name]:.15g}", place)
                    for name in LIMITS if name in schema and _beyond(value, name, schema[name]))


def _in_table(value: JsonObject, schema: Schema, place: str, tables: Mapping[str, Table]) -> Iterator[InputError]:
    found: list[InputError] = []
    for name, each in value.items():
        inside = schema["additionalProperties"] or schema["properties"].get(name)
        if inside is None:
            found.append(unknown(name, "key", schema["properties"], place=_join(place, name)))
        else:
            found += mistakes(each, inside, _join(place, name), tables)
    found += [InputError("is missing", place=_join(place, name)) for name in schema.get("required", ()) if name not in value]
    yield from found
    if isinstance(schema, Table) and not found and (text := schema.mistakes(value)):
        yield InputError(text, place=place or "file")


def _in_one_of(value: JsonObject, schema: Schema, place: str, tables: Mapping[str, Table]) -> Iterator[InputError]:
    key, names = schema["discriminator"]["propertyName"], schema["discriminator"]["mapping"]
    defaults = [kind for kind, each in names.items() if key not in tables[each.rsplit("/", 1)[-1]]["required"]]
    kind = value.get(key, *defaults)
    if key not in value and not defaults:
        yield InputError("is missing", place=_join(place, key))
    elif kind not in list(names):
        yield unknown(kind if isinstance(kind, str) else short(kind), key, names, place=_join(place, key))
    else:
        yield from mistakes(value, {"$ref": names[kind]}, place, tables)


def _type(schema: Schema) -> str:
    return str(schema.get("type", "object"))  # references and choices are of tables


def _has_type(value: object, name: str) -> bool:
    return isinstance(value, TYPES[name][1]) and (name == "boolean" or not isinstance(value, bool))


def _beyond(value: float, name: str, limit: float) -> bool:
    """Return whether a number is beyond a limit by more than a rounding to float32: 90.0000025 degrees are pi / 2 in float32."""
    near = isinstance(value, float) and "exclusive" not in name and abs(value - limit) <= ROUNDING * abs(limit)
    return LIMITS[name][1](value, limit) and not near


def _wrong(value: object, expected: str, place: str) -> InputError:
    shown = str(value).lower() if isinstance(value, bool) else short(value)
    return InputError(f"got {shown}, expected {expected}", place=place or "file")


def _join(place: str, key: str) -> str:
    """Return the place of a key of a table, with the key as TOML writes it: in quotes if necessary."""
    plain = key.replace("_", "").replace("-", "").isalnum() and key.isascii()
    return ".".join(filter(None, [place, key if plain else f'"{key}"']))
