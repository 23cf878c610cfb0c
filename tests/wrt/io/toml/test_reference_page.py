"""The page on scene files agrees with the schema, and its example is a scene file."""

from __future__ import annotations

import json
import re
import tomllib
import warnings
from pathlib import Path
from typing import Any

import pytest

from docs.site.scene_format import EXAMPLE, scene_format
from tests.data import ROOT
from wrt.io.load import load_scene, schema
from wrt.io.toml.schema import scene_schema

PAGE = ROOT / "docs" / "scene_format.md"
# Numbers without a unit: shares, counts, factors, directions of any length, indices of refraction.
NO_UNIT = {
    "albedo", "alpha", "alpha_cutoff", "axis", "blades", "clearcoat", "clearcoat_roughness", "color_a", "color_b", "count", "direction",
    "eta", "exponent", "f_number", "first", "ior", "k", "matrix", "max_depth", "metallic", "min_throughput", "normal_scale", "offset",
    "roughness", "scale", "segments", "sides", "specular", "specular_color", "specular_factor", "spp", "subdivisions", "transmission",
    "tube_segments", "up"}


def tables() -> dict[str, Any]:
    document = schema()
    return {"SceneTable": document, **document["$defs"]}


def test_the_committed_page_is_what_the_tool_makes() -> None:
    assert PAGE.read_text(encoding="utf-8") == scene_format(), "run: python docs/site/scene_format.py"


def test_every_key_of_every_table_has_a_row() -> None:
    """The line before a table has keys with one value and keys of other tables; the page's head describes `name`."""
    sections = re.split(r"^### .*\n", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    keys = [re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) for section in sections]
    shared = [re.findall(r"`(\w+)`", "".join(re.findall(r"((?:`\w+`, )*`\w+`): as in", section))) for section in sections]
    fixed = [re.findall(r"`(\w+) = \"", section.split("\n")[0]) for section in sections]
    found = sorted(sorted({*each}) for each in map(sum, zip(keys, shared, fixed, strict=True), [[]] * len(keys)))
    assert found == sorted(sorted({*table["properties"]} - {"name"}) for table in tables().values())


def numeric(value: Any) -> bool:
    if value.get("type") in ("number", "integer"):
        return True
    parts = [*value.get("anyOf", ()), *([value["items"]] if isinstance(value.get("items"), dict) else [])]
    return any(numeric(part) for part in parts)


def test_every_number_has_a_unit_or_is_known_to_have_none() -> None:
    for name, table in tables().items():
        for key, value in table["properties"].items():
            if numeric(value):
                assert ('"unit"' in json.dumps(value)) != (key in NO_UNIT), f"{name}.{key}"


@pytest.mark.parametrize(("section", "row"), [
    ("Settings", '| `size` | 2 whole numbers (pixels, 1 to 32768) | `[640,360]` | width and height |'),
    ("Camera", "| `fov_y` | number (degrees, 0.0005 to 179.94) | `45.0` | full vertical angle of view |"),
    ("Sphere", "| `radius` | number (length, > 0) | required | radius of the sphere |"),
    ("Tube", "| `radius` | number or list of numbers (length, > 0) | `0.1` | one radius, or one for each point |"),
    ("Mesh", "| `instances` | list of [Transform](#transform) (1 or more) |  | transforms, each of one copy of the mesh,"
             " applied before `transform`; the mesh is stored once |"),
    ("Gradient", "| `top` | 1 or 3 numbers (radiance, >= 0) | `[0.5,0.7,1.0]` | from straight above (+y) |"),
])
def test_rows(section: str, row: str) -> None:
    text = PAGE.read_text(encoding="utf-8").split(f"### {section}\n")[1].split("###")[0]
    assert row in text.splitlines()


def test_the_example_is_a_scene_and_shows_most_of_it(tmp_path: Path) -> None:
    path = tmp_path / "example.toml"
    page = PAGE.read_text(encoding="utf-8")
    assert re.findall(r"```toml\n(.*?)```", page, re.DOTALL) == [EXAMPLE]
    path.write_text(EXAMPLE, encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(path)
    assert len(scene.cameras) == 3 and {m.kind for m in scene.materials} == {"diffuse", "glass", "conductor"}
    used = {"SceneTable"}

    def visit(value: Any, schema: dict[str, Any]) -> None:
        """Add the names of the tables of a value that has the schema."""
        if "discriminator" in schema:
            by = schema["discriminator"]
            schema = {"$ref": by["mapping"][value.get(by["propertyName"], "perspective")]}
        for each in schema.get("anyOf", ()):
            if isinstance(value, dict) and "$ref" in each:
                visit(value, each)
        if "$ref" in schema:
            name = schema["$ref"].rsplit("/", 1)[-1]
            used.add(name)
            schema = tables()[name]
        if isinstance(value, dict):
            for key, each in value.items():
                visit(each, schema.get("properties", {}).get(key) or schema.get("additionalProperties") or {})
        elif isinstance(value, list) and "items" in schema:
            for each in value:
                visit(each, schema["items"])

    visit(tomllib.loads(EXAMPLE), scene_schema())
    assert len(used) >= 0.6 * len(tables()) and used >= {"SettingsTable", "CameraTable", "MaterialTable", "MeshTable"}
