"""Make docs/scene_format.md, the reference of scene files, from the schema that checks them: python docs/site/scene_format.py."""

import json
import re
from pathlib import Path
from typing import Any

from wrt.io.load import schema

Schema = dict[str, Any]
TOP = "SceneTable"
SHARED_KEYS = 4  # if two tables share so many equal keys or more, the page describes these keys once
TABLE = "| key | type | default | meaning |\n|---|---|---|---|"
WORDS = {"string": "text", "boolean": "true or false", "integer": "whole number"}
HEAD = """\
# Scene files

A scene is a [TOML](https://toml.io) file. `python -m wrt validate scene.toml` reports every mistake with its place. `python -m wrt schema`
prints the JSON Schema for editors.

- [Concepts](concepts.md#spaces-and-units) describes spaces and units. Angles are in degrees here, and in radians in Python.
- Matrices are 16 numbers, row by row, and act on column vectors. One number for a colour is a grey.
- File names are relative to the scene file. `scene.save("room.toml")` writes a scene, and its meshes and images to `room_files`.
- Objects and lights may have a `name`, for messages.

## Example
"""
EXAMPLE = Path(__file__).with_name("scene_example.toml").read_text(encoding="utf-8")


def scene_format() -> str:
    """Return the page in Markdown."""
    document = schema()
    tables: dict[str, Schema] = {TOP: document, **document["$defs"]}
    places = _places(tables)
    parts = [HEAD, f"```toml\n{EXAMPLE}```\n", "## Tables\n"]
    for i, (name, found) in enumerate(places.items()):
        where = "At the top of the file." if name == TOP else f"In {', '.join(f'`{place}`' for place in found)}."
        sentence = " ".join(tables[name]["description"].split())
        known, before = _described_before(tables, name, list(places)[:i])
        more = f" {', '.join(f'`{key}`' for key in known)}: as in {_link(before)}." if known else ""
        fixed = {key: value["const"] for key, value in tables[name]["properties"].items() if "const" in value and "default" not in value}
        where = f"{where[:-1]}, with {', '.join(f'`{key} = {json.dumps(value)}`' for key, value in fixed.items())}." if fixed else where
        rows = _rows(tables[name], {"name", *known, *fixed})
        parts.append("\n".join([f"### {_title(name)}\n{where} {sentence}{more}\n", *([TABLE, *rows, ""] if rows else [])]))
    return "\n".join(parts)


def _title(name: str) -> str:
    """Return the title of a table: "Point light" for PointLightTable."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", re.sub(r"(Table|Shape)$", "", name)).capitalize()


def _described_before(tables: dict[str, Schema], name: str, before: list[str]) -> tuple[list[str], str]:
    """Return the keys that an earlier table describes in the same words, if they are SHARED_KEYS or more, and that table's name."""
    for each in before:
        there, extra = tables[each]["properties"], {*tables[each]["required"]} ^ {*tables[name]["required"]}
        known = [key for key, value in tables[name]["properties"].items() if there.get(key) == value and key not in extra]
        if len(known) >= SHARED_KEYS:
            return known, each
    return [], ""


def _link(reference: str) -> str:
    title = _title(reference.rsplit("/", 1)[-1])
    return f"[{title}](#{title.lower().replace(' ', '-')})"


def _places(tables: dict[str, Schema]) -> dict[str, list[str]]:
    """Return the places of each table in a file, such as "meshes[].transform"; tables are in the order of the page."""
    places: dict[str, list[str]] = {TOP: []}

    def visit(name: str, prefix: str) -> None:
        for key, value in tables[name]["properties"].items():
            for reference, place in _references(value, prefix + key):
                inner = reference.rsplit("/", 1)[-1]
                new = inner not in places
                places.setdefault(inner, []).append(place)
                if new:
                    visit(inner, f"{place}.")

    visit(TOP, "")
    return places


def _references(value: Any, place: str) -> list[tuple[str, str]]:
    """Return (reference, place) of each table that a value may hold. In a place, [] marks a list and NAME stands for any key."""
    if "$ref" in value:
        return [(value["$ref"], place)]
    parts = [(each, place) for each in (*value.get("anyOf", ()), *value.get("oneOf", ()))]
    parts += [(value["items"], f"{place}[]")] if "items" in value else []
    parts += [(value["additionalProperties"], f"{place}.NAME")] if isinstance(value.get("additionalProperties"), dict) else []
    return [found for each, at in parts for found in _references(each, at)]


def _rows(table: Schema, left_out: set[str]) -> list[str]:
    rows = []
    for key, value in [each for each in table["properties"].items() if each[0] not in left_out]:
        default = "required" if key in table.get("required", ()) else _default(value)
        notes = ", ".join(each for each in (_find(value, "unit"), _limits(value)) if each)
        cells = (f"`{key}`", f"{_type(value)} ({notes})" if notes else _type(value), default, value.get("description", ""))
        rows.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return rows


def _type(value: Schema) -> str:
    if "$ref" in value:
        return _link(value["$ref"])
    if "const" in value or "enum" in value:
        return ", ".join(f'`"{each}"`' for each in value.get("enum", [value.get("const")]))
    choices = [each for each in (*value.get("anyOf", ()), *value.get("oneOf", ())) if each.get("type") != "null"]
    if choices:
        return _choice(choices)
    if value["type"] == "array":
        return _array(value)
    if value["type"] == "object":
        return f"table of {_type(value['additionalProperties'])}"
    return WORDS.get(value["type"], "") or str(value["type"])


def _choice(choices: list[Schema]) -> str:
    one, *more = choices
    if len(more) == 1 and more[0].get("items") == one:
        return f"1 or {_array(more[0])}" if "minItems" in more[0] else f"{_type(one)} or {_array(more[0])}"
    return (", " if all("$ref" in each for each in choices) else " or ").join(_type(each) for each in choices)


def _array(value: Schema) -> str:
    count = value.get("minItems") if value.get("minItems") == value.get("maxItems") else None
    inner = _type(value["items"])
    if count is None:
        return f"list of {inner}" + ("s" if inner in ("number", "text") else "")
    return f"{count} {inner}s" if inner in ("number", "whole number") else f"{count} of {inner}"


def _default(value: Schema) -> str:
    default = value.get("default")
    if default is None or default == "" or default == {} or default == []:
        return ""
    if isinstance(default, list) and len(set(default)) == 1 and _type(value).startswith("1 or"):
        default = default[0]  # one number stands for all
    return f"`{json.dumps(default, separators=(',', ':'))}`"


def _find(value: Any, key: str) -> str:
    """Return, as text, what the schema `value` or the first of its parts with this key has under `key`; "" if none has it."""
    if key in value:
        return str(value[key])
    inner = [*value.get("anyOf", ()), *([value["items"]] if isinstance(value.get("items"), dict) else [])]
    return next((found for part in inner if (found := _find(part, key))), "")


def _limits(value: Schema) -> str:
    low, high = _find(value, "minimum"), _find(value, "maximum")
    above, below = _find(value, "exclusiveMinimum"), _find(value, "exclusiveMaximum")
    if low and high:
        return f"{_number(low)} to {_number(high)}"
    found = [f"{sign} {_number(limit)}" for sign, limit in ((">=", low), (">", above), ("<=", high), ("<", below)) if limit]
    least = [each["minItems"] for each in (value, *value.get("anyOf", ())) if "minItems" in each and "maxItems" not in each]
    return ", ".join(found + [f"{count} or more" for count in least])


def _number(text: str) -> str:
    return format(float(text), ".15g")


if __name__ == "__main__":
    (Path(__file__).parents[1] / "scene_format.md").write_text(scene_format(), encoding="utf-8")
