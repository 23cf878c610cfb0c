"""Checks of a TOML scene file against the schema, with a line for each mistake."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wrt.core.checks import short, unknown
from wrt.core.errors import InputError, InputErrors
from wrt.core.types import JsonObject

if TYPE_CHECKING:
    from wrt.io.toml.schema import SceneTable

MOST = 20  # largest number of problems in the message about a file

# The expected value by pydantic's type of error; {} is filled from the error's context.
_EXPECTED = {
    "float_type": "a number", "int_type": "a whole number", "string_type": "text", "bool_type": "true or false",
    "list_type": "an array", "dict_type": "a table", "model_type": "a table", "model_attributes_type": "a table",
    "finite_number": "a finite number", "greater_than": "a number > {gt}", "greater_than_equal": "a number >= {ge}",
    "less_than": "a number < {lt}", "less_than_equal": "a number <= {le}",
    "too_short": "at least {min_length} values", "too_long": "at most {max_length} values",
}


def check(data: JsonObject, path: Path) -> SceneTable:
    """Convert the tables of a scene file to pydantic models. Raises one InputError that lists all mistakes."""
    from wrt.io.toml.schema import scene_table

    materials = data.get("materials")
    known = materials if isinstance(materials, dict) else {}
    return _models(scene_table(), data, path, [] if data.get("include") else unknown_materials(data, known))


def check_settings(values: JsonObject, origin: str) -> JsonObject:
    """Check settings by the rules of [settings] in a scene file. Raises one InputError that begins with `origin` and lists all mistakes."""
    from wrt.io.toml.schema import SceneTable, SettingsTable

    for name in values:
        if name in SceneTable.model_fields:
            raise InputError("is a key of the scene, not of its settings", path=origin, place=name, hint="write it into the scene file")
    return _models(SettingsTable, values, Path(origin)).given()


def _models(table: Any, data: dict[str, Any], path: Path, others: Sequence[InputError] = ()) -> Any:
    """Convert `data` to the pydantic model `table`. If it has mistakes, raises one InputError that lists the mistakes and `others`."""
    from pydantic import ValidationError

    known_keys: dict[int, list[str]] = {}
    try:
        return table.model_validate(data, context=known_keys)
    except ValidationError as error:
        problems = [_line(each, data, known_keys) for each in error.errors(include_url=False)]
    raise_all([*problems, *others], path)


def raise_all(problems: Sequence[InputError], path: Path) -> None:
    """Raise one InputError with a line for each problem, at most MOST lines. Without problems, return."""
    lines = {str(problem): problem for problem in problems}
    if len(lines) == 1:
        raise problems[0].at(path)
    if lines:
        more = [f"and {len(lines) - MOST} more"] * (len(lines) > MOST)
        raise InputErrors("\n  ".join([f"{len(lines)} errors", *list(lines)[:MOST], *more]), list(lines.values()), path=path)


def unknown_materials(data: JsonObject, known: Collection[str]) -> list[InputError]:
    """Return an error for each reference to an unknown material. The schema reports values of a wrong type."""
    found: list[tuple[str, Any]] = []
    for kind in ("spheres", "quads", "boxes", "meshes"):
        for i, table in enumerate(_tables(data.get(kind))):
            at = f"{kind}[{i}]"
            found.append((f"{at}.material", table.get("material")))
            groups = table.get("materials")
            if isinstance(groups, dict):
                found += [(f"{at}.materials.{group}", name) for group, name in groups.items()]
            found += [(f"{at}.parts[{j}].material", part.get("material"))
                      for j, part in enumerate(_tables(table.get("parts")))]
    return [unknown(name, "material", known, place=place) for place, name in found if isinstance(name, str) and name not in known]


def _tables(value: Any) -> list[dict[str, Any]]:
    return [table if isinstance(table, dict) else {} for table in value] if isinstance(value, list) else []


def _line(error: Any, data: dict[str, Any], known_keys: dict[int, list[str]]) -> InputError:
    kind, context = error["type"], error.get("ctx", {})
    place, parent = _place(error["loc"], data, kind == "missing")
    if kind == "extra_forbidden":
        return unknown(str(error["loc"][-1]), "key", known_keys.get(id(parent), []), place=place)
    if kind == "missing":
        return InputError("is missing", place=place)
    if kind == "value_error":
        return InputError(str(context["error"]), place=place or "file")
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        tag = "type" if context["discriminator"].endswith("()") else context["discriminator"].strip("'")
        if kind == "union_tag_not_found":
            return InputError("is missing", place=f"{place}.{tag}")
        choices = [name.strip("'") for name in context["expected_tags"].split(", ")]
        return unknown(_text(context["tag"]), tag, choices, place=f"{place}.{tag}")
    if kind == "literal_error":
        choices = re.findall("'([^']*)'", context["expected"])
        return unknown(_text(error["input"]), "value", choices, place=place)
    expected = _EXPECTED[kind].format(**context) if kind in _EXPECTED else error["msg"]
    value = error["input"]
    return InputError(f"got {str(value).lower() if isinstance(value, bool) else short(value)}, expected {expected}", place=place)


def _text(value: object) -> str:
    return value if isinstance(value, str) else short(value)


def _place(location: Sequence[str | int], data: Any, missing: bool) -> tuple[str, Any]:
    """Return the place of a mistake in the file, such as "meshes[0].file", and the table that holds its last key.

    pydantic's `location` also names members of unions. The place leaves out parts that are no keys of the file, but keeps a missing key."""
    place, parent = "", data
    for i, part in enumerate(location):
        if isinstance(part, str) and isinstance(data, dict) and (part in data or (missing and i == len(location) - 1)):
            parent, data = data, data.get(part)
            place += f".{_key(part)}" if place else _key(part)
        elif isinstance(part, int) and isinstance(data, list) and part < len(data):
            parent, data = data, data[part]
            place += f"[{part}]"
    return place, parent


def _key(name: str) -> str:
    """Return a key as TOML writes it, in quotes if necessary."""
    return name if name and name.replace("_", "").replace("-", "").isalnum() and name.isascii() else f'"{name}"'
