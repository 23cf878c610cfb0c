"""docs/scene_format.md, the reference of scene files, made from the schema that checks them: `wrt schema --markdown`."""

from __future__ import annotations

import json
import re
from typing import Any

from wrt.io.load import schema

Schema = dict[str, Any]
TOP = "SceneTable"
WORDS = {"string": "text", "boolean": "true or false", "integer": "whole number"}
HEAD = """\
# Scene files

A scene is a [TOML](https://toml.io) file: `python -m wrt render scene.toml`, `wrt.load_scene("scene.toml")`. This page is made
by `python -m wrt schema --markdown` from the schema that every file is checked against; `python -m wrt schema` prints that as JSON
Schema, for editors, and `python -m wrt validate scene.toml` tells all that is wrong with a file at once, each with its place. An
unknown key, a wrong type, NaN and infinity are mistakes.

World space is right-handed, +y is up. *length*: in the scene's own unit, whatever that is, as long as the scene is at least 1e-15
units across and no shape reaches farther than 1e18 from the origin (see [accuracy](accuracy.md#known-limits)). Angles are in
degrees here (in Python, in radians). Colours are linear Rec. 709, red, green and blue; where one is asked for, a single number is a
grey. *radiance*, *irradiance* and *radiant intensity* belong to each other, and have no unit of their own: a white diffuse surface
that receives the irradiance pi has the radiance 1, which is shown as white. Matrices are 16 numbers, row by row, and act on column
vectors. Names of files are relative to the scene file. What a scene lacks to be seen (a camera, any light) is added and told.

## An example
"""
EXAMPLE = """\
title = "one of everything that needs no other file"

[settings]
size = [320, 180]
spp = 16
max_depth = 6
tonemap = "aces"

[cameras.front]
position = [0, 1.5, 7]
target = [0, 0.7, 0]
fov_y = 30
aperture_radius = 0.02              # without one it is a pinhole

[cameras.portrait]                  # a real lens: 50 mm, f/2, one unit being a metre
position = [2, 1.2, 4]
target = [0, 0.7, 0]
focal_length = 0.05
sensor_height = 0.024
f_number = 2
blades = 7

[cameras.plan]
type = "orthographic"
position = [0, 9, 0]
target = [0, 0, 0]
up = [0, 0, -1]
height = 8

[background]
type = "gradient"
bottom = [0.5, 0.45, 0.4]
top = [0.4, 0.6, 0.9]

[materials.floor]
albedo_texture = { checkerboard = { color_a = 0.7, color_b = [0.1, 0.1, 0.12], scale = 8 } }

[materials.clay]
albedo = [0.7, 0.3, 0.2]
specular = 0.2                      # a grey

[materials.glass]
kind = "glass"
absorption = [0.3, 0.05, 0.1]

[materials.gold]
kind = "conductor"
metal = "gold"
roughness = 0.2

[[quads]]
corner = [-4, 0, 4]
edge_u = [8, 0, 0]
edge_v = [0, 0, -8]
material = "floor"

[[spheres]]
center = [-1, 0.6, 0]
radius = 0.6
material = "glass"

[[boxes]]
low = [-0.4, 0, -0.4]
high = [0.4, 0.8, 0.4]
material = "clay"
transform = { translate = [2.2, 0, -1], rotate = [0, 30, 0] }

[[meshes]]
shape = { kind = "teapot" }
material = "clay"
transform = { translate = [0.9, 0, 0], rotate = [0, -20, 0], scale = 0.6 }
motion = [{ rotate = [0, 0, 0] }, { rotate = [0, 360, 0] }]     # of `wrt animate`

[[meshes]]
shape = { kind = "torus", radius = 0.25, tube_radius = 0.08 }
material = "gold"
instances = [{ translate = [-2, 0.08, 1] }, { translate = [-2.2, 0.24, 1], axis = [0, 0, 1], angle = 15 }]

[[meshes]]
shape = { kind = "icosphere", subdivisions = 3, radius = 0.2 }
material = "gold"
transform = { translate = [0, 0.2, 1.5] }
morph = { shape = { kind = "icosphere", subdivisions = 3, radius = 0.3 } }

[[lights]]
type = "directional"
direction = [-1, -2, -1.5]
irradiance = 1.5

[[lights]]
type = "rectangle"
corner = [-1, 4, -1]
edge_u = [2, 0, 0]
edge_v = [0, 0, 2]
radiance = [4, 3.6, 3]
"""


def scene_format() -> str:
    """The whole page."""
    document = schema()
    tables: dict[str, Schema] = {TOP: document, **document["$defs"]}
    places = _places(tables)
    parts = [HEAD, f"```toml\n{EXAMPLE}```\n", "## Tables\n"]
    for name, found in places.items():
        where = "At the top of the file." if name == TOP else f"In {', '.join(f'`{place}`' for place in found)}."
        sentence = " ".join(tables[name]["description"].split())
        parts.append(f"### {_title(name)}\n{where} {sentence}\n\n{_table(tables[name])}\n")
    return "\n".join(parts)


def _title(name: str) -> str:
    """CameraTable: Camera; PointLightTable: Point light."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", re.sub(r"(Table|Shape)$", "", name)).capitalize()


def _link(reference: str) -> str:
    title = _title(reference.rsplit("/", 1)[-1])
    return f"[{title}](#{title.lower().replace(' ', '-')})"


def _places(tables: dict[str, Schema]) -> dict[str, list[str]]:
    """Each table, in the order of a file, with the keys where it stands."""
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
    """The tables that a value may be, and where: [] marks a list, NAME a key that is free."""
    if "$ref" in value:
        return [(value["$ref"], place)]
    parts = [(each, place) for each in (*value.get("anyOf", ()), *value.get("oneOf", ()))]
    parts += [(value["items"], f"{place}[]")] if "items" in value else []
    parts += [(value["additionalProperties"], f"{place}.NAME")] if isinstance(value.get("additionalProperties"), dict) else []
    return [found for each, at in parts for found in _references(each, at)]


def _table(table: Schema) -> str:
    rows = ["| key | type | unit | default | limits | |", "| --- | --- | --- | --- | --- | --- |"]
    for key, value in table["properties"].items():
        default = "required" if key in table.get("required", ()) else _default(value)
        meaning = value.get("description", "says which kind of table this is").replace("|", "\\|")
        cells = (f"`{key}`", _type(value), _find(value, "unit"), default, _limits(value), meaning)
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def _type(value: Schema) -> str:
    if "$ref" in value:
        return _link(value["$ref"])
    if "const" in value or "enum" in value:
        return " or ".join(f'`"{each}"`' for each in value.get("enum", [value.get("const")]))
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
    return " or ".join(_type(each) for each in choices)


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
    return f"`{json.dumps(default)}`"


def _find(value: Any, key: str) -> str:
    """What the value or a part of it says of the key; "" where none does."""
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
