"""The page on scene files agrees with the schema, and its example is a scene file."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

from docs.site.scene_format import EXAMPLE, scene_format
from tests.data import ROOT
from wrt.io.load import load_scene, schema

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


def test_the_example_is_a_scene(tmp_path: Path) -> None:
    path = tmp_path / "example.toml"
    assert re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL) == [EXAMPLE]
    path.write_text(EXAMPLE, encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(path)
    assert len(scene.cameras) == 3 and {m.kind for m in scene.materials} == {"diffuse", "glass", "conductor"}
