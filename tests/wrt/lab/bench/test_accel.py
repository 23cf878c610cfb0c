"""bench accel: the rows hold what was measured, a structure that loses a ray is reported, and the command writes the tables."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.refused import refused
from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.lab.bench import accel as bench
from wrt.lab.bench.accel import Plan, run, timing
from wrt.lab.bench.report import Row, text
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere


@pytest.fixture
def box(tmp_path: Path) -> Path:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    return tmp_path / "box.obj"


def plan(box: Path, **options) -> Plan:
    return Plan((box,), **{"rays": 400, "runs": 2, "structures": ("brute_force", "bvh2"), **options})


def made(structure="s", triangles=1000, seconds=(1.0,), build=(0.5,), kind="primary", **fields) -> Row:
    return Row(**{"mesh": "m", "triangles": triangles, "structure": structure, "kind": kind, "rays": 10**6, "build": build,
                  "build_median": build[0], "bytes_per_triangle": 50.0, "peak_bytes": 1.0, "sah_cost": 7.0, "depth": 5,
                  "references": triangles, "nodes": 3.0, "boxes": 6.0, "primitives": 2.0, "differ": 0, "checked": 10, "wrong": 0,
                  **timing(10**6, np.array(seconds), np.ones(len(seconds)))} | fields)


def test_rows_hold_what_the_structures_say(box) -> None:
    rows = run(plan(box))
    assert [(row.structure, row.kind) for row in rows] == [
        (name, kind) for kind in ("primary", "shadow", "diffuse", "random") for name in ("brute_force", "bvh2")]
    for row in rows:
        assert row.mesh == "box.obj" and row.triangles == 12 and row.rays == 400 and row.checked == 400
        assert row.differ == row.wrong == 0 and len(row.seconds) == 2 and min(row.mrays) > 0.0
        if row.structure == "brute_force":
            assert (row.primitives, row.nodes) == (12.0, 0.0) and row.bytes_per_triangle == 40.0
        else:
            assert 1.0 <= row.nodes and row.boxes == pytest.approx(2.0 * row.nodes) and row.primitives < 12.0
    assert set(rows[0].as_dict()) >= {"mrays_median", "build_median", "wrong"}


def test_in_a_stadium_the_rays_are_those_of_the_mesh_alone(box) -> None:
    (row,) = run(plan(box, stadium=True, structures=("bvh2",), kinds=("primary",), rays=100, runs=1))
    (alone,) = run(plan(box, structures=("bvh2",), kinds=("primary",), rays=100, runs=1))
    assert row.mesh == "box.obj in a stadium" and row.triangles == 12 + 80_002 and row.wrong == row.differ == 0
    assert alone.primitives < row.primitives < alone.primitives + 12.0


def test_a_structure_that_loses_rays_is_told(box, monkeypatch) -> None:
    class Losing(ACCELERATORS["bvh2"]):  # type: ignore[misc, name-defined]
        name = "losing"

        def closest_hit(self, *args, **options):
            hits = super().closest_hit(*args, **options)
            hits.prim_id[::10] = -1
            return hits

        def any_hit(self, *args, **options):
            return ~super().any_hit(*args, **options)

    monkeypatch.setitem(bench.ACCELERATORS, "losing", Losing)
    rows = run(plan(box, structures=("losing",), kinds=("primary", "shadow")))
    assert [row.kind for row in rows] == ["primary", "shadow"]
    primary, shadow = rows
    assert 0 < primary.differ <= 40 and 0 < primary.wrong <= 40 and shadow.differ == shadow.wrong == 400


def test_a_structure_that_refuses_is_named_and_the_others_go_on(box, monkeypatch) -> None:
    class Refusing(ACCELERATORS["bvh2"]):  # type: ignore[misc, name-defined]
        name = "refusing"

        def _build(self, options):
            raise InputError("more than 11 triangles")

    monkeypatch.setitem(bench.ACCELERATORS, "refusing", Refusing)
    rows = run(plan(box, structures=("refusing", "bvh2"), kinds=("random",)))
    assert rows[0] == Row(mesh="box.obj", structure="refusing", reason="more than 11 triangles") and rows[1].structure == "bvh2"
    assert "| refusing  | box.obj | more than 11 triangles |" in text(rows, Plan(), "")
    assert "<td>more than 11 triangles</td>" in rows._repr_html_()


def test_the_build_that_is_timed_is_not_the_first(box, monkeypatch) -> None:
    sizes = []

    class Slow(ACCELERATORS["bvh2"]):  # type: ignore[misc, name-defined]
        name = "slow"

        def _build(self, options):
            sizes.append(len(self.geometry))
            return super()._build(options)

    monkeypatch.setitem(bench.ACCELERATORS, "slow", Slow)
    run(plan(box, structures=("slow",), kinds=("random",), builds=2))
    assert len(sizes) == 3 and sizes[0] != sizes[1] == sizes[2]


def test_meshes_need_no_file_and_a_notebook_shows_tables() -> None:
    rows = run(Plan((icosphere(1), icosphere(2)), ("bvh2",), ("primary",), rays=100, runs=1))
    page = rows._repr_html_()
    assert [row.triangles for row in rows] == [80, 320] and page.count("<table>") == 2 and "icosphere, 320 triangles" in page
    assert "bench accel icosphere" in text(rows, Plan((icosphere(1),)), "")
    with refused("mesh", "Mesh or the path"):
        run(Plan((1,)))  # type: ignore[arg-type]
    with refused(what="no triangles"):
        run(Plan((Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)),)))


def test_the_tables_hold_what_was_measured() -> None:
    page = text([made("a", seconds=(1.0, 1.0)), made("b", seconds=(0.5, 0.5), differ=3)], Plan(), "")
    line = next(line for line in page.splitlines() if line.startswith("| b"))
    named = dict(zip(bench.COLUMNS, (cell.strip() for cell in line.strip("|").split("|")), strict=True))
    assert named["Mray/s"] == "2 [2, 2]" and named["speed / first"] == "2.00" and named["differ"] == "3" and named["build ms"] == "500"


def test_without_meshes_a_terrain_grows() -> None:
    sizes = [len(mesh.faces) for mesh in bench.meshes(Plan(max_triangles=20_000))]
    assert sizes == sorted(sizes) and len(sizes) >= 3 and sizes[-1] <= 20_000
    assert np.all(np.diff(np.log(sizes)) > 1.0)


def test_all_structures_but_brute_force_by_default() -> None:
    names = bench.names(Plan())
    assert "bvh2" in names and "brute_force" not in names and "bvh" not in names and len(set(names)) == len(names)


def test_the_command_prints_json_and_writes_a_report(box, tmp_path) -> None:
    out = command("bench", "accel", str(box), "--rays", "100", "--runs", "1", "--structures", "bvh2", "--kinds", "random,diffuse",
                  "--json", "-q", "-o", str(tmp_path / "accel.md"))
    assert out.code == 0 and out.err == ""
    facts = json.loads(out.out)
    assert [row["kind"] for row in facts["rows"]] == ["diffuse", "random"] and facts["refused"] == []
    told = (tmp_path / "accel.md").read_text()
    assert "bench accel box.obj" in told and str(tmp_path) not in told


@pytest.mark.parametrize(("arguments", "message"), [
    (("--structures", "nonsense"), "no structure 'nonsense'"),
    (("--kinds", "x"), "no kind of ray 'x'"),
    (("--rays", "0"), "rays must be 1"),
    (("nothing.obj",), "nothing.obj"),
])
def test_mistakes_are_told_in_a_line(arguments, message) -> None:
    out = command("bench", "accel", *arguments)
    assert out.code == 2 and len(out.errors) == 1 and message in out.errors[0]
