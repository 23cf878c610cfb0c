"""`bench rtcore`: rays in the order of warps, rows that hold what was counted, and a command that prints them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from wrt.accel.scenes.build import build
from wrt.lab.bench.rays import ray_sets
from wrt.lab.bench.report import run, text
from wrt.lab.rtcore.meshes import Plan, bvhs, in_warps
from wrt.scene.shapes import icosphere


def test_rays_stand_in_blocks_of_the_picture() -> None:
    accel = build(icosphere(3), "bvh2")
    plain = ray_sets(accel, 32 * 32)
    ordered = in_warps(accel, plain)
    for kind, rays in plain.items():
        assert sorted(map(tuple, rays.directions.tolist())) == sorted(map(tuple, ordered[kind].directions.tolist()))
    row_of = {tuple(d): i for i, d in enumerate(plain["primary"].directions.tolist())}
    pixels = np.array([row_of[tuple(d)] for d in ordered["primary"].directions.tolist()])
    for warp in pixels.reshape(-1, 32):
        y, x = np.divmod(warp, 32)
        assert np.ptp(x) == 7 and np.ptp(y) == 3
    spread = [np.ptp(sets["diffuse"].origins.reshape(-1, 32, 3), axis=1).mean() for sets in (plain, ordered)]
    assert spread[1] < spread[0]  # rays of a warp start closer to each other


def test_rows_and_command(tmp_path: Path) -> None:
    mesh, report = tmp_path / "box.obj", tmp_path / "out.md"
    mesh.write_text(BOX_OBJ)
    rows = run(Plan((mesh,), ("bvh2",), ("primary",), 1024))
    assert [(row.structure, row.name, row.mesh_triangles, row.rays) for row in rows] == [("bvh2", "primary", 12, 1024)]
    assert rows[0].boxes == pytest.approx(2.0 * rows[0].nodes)
    assert rows[0].low <= rows[0].rays_per_second <= rows[0].high
    assert "<b>box.obj, 12 triangles</b>" in rows._repr_html_()
    assert "box.obj, 12 triangles" in text(rows, Plan((mesh,)), "") and {"bvh2", "bvh4"} <= set(bvhs())
    arguments = ("bench", "rtcore", str(mesh), "--structures", "bvh2", "--kinds", "primary", "--rays", "1024", "-q")
    result = command(*arguments, "-o", str(report))
    assert result.code == 0 and report.read_text().startswith("# The model of the RT core")
    told = json.loads(command(*arguments, "--json").out)["rows"][0]
    assert told["nodes"] == rows[0].nodes and told["limit"] in told["clocks"]
