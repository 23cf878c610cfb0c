"""`bench pictures`: both ways give the same pixels, and the report tells both."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.command_line import wrt as command
from tests.data import ROOT
from wrt.lab.bench.pictures import Plan
from wrt.lab.bench.report import run, text

SCENE = ROOT / "scenes" / "cornell_box.toml"


def test_both_ways_are_measured_and_agree() -> None:
    plan = Plan((SCENE,), size="32x18", spp=2, runs=3)
    rows = run(plan)
    (row,) = rows
    assert (row.scene, row.differ, len(row.loop), len(row.waves)) == ("cornell_box.toml", 0, 3, 3)
    assert row.rays > 1.0 and min(row.loop + row.waves) > 0.0
    told = text(rows, plan, "a machine")
    assert "python -m wrt bench pictures cornell_box.toml --size 32x18 --spp 2 --runs 3" in told
    assert f"Geometric mean of loop / waves: {row.ratio_median:.2f}" in told


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = command("bench", "pictures", SCENE, "--size", "32x18", "--spp", 1, "--runs", 1, "-o", "a.md", "--json")
    assert result.code == 0 and json.loads(result.out)["rows"][0]["differ"] == 0 and "loop / waves" in Path("a.md").read_text()
