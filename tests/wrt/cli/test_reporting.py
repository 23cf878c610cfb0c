"""What all measuring commands share: the formats of reports, the time left, and what Ctrl-C keeps. This module is the study of a plan."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from wrt.cli.reporting import measured
from wrt.core.interrupts import Interrupted
from wrt.lab.bench.report import Columns, Row
from wrt.lab.plans import Plan, option

TITLE, LEGEND = "Squares", "square: the number times itself."
COLUMNS: Columns = {"number": "{number}", "square": "{square}"}


@dataclass(frozen=True)
class Squares(Plan):
    """Square the numbers below COUNT."""

    COMMAND, STUDY = "bench squares", __name__
    count: int = option(3, "How many numbers", (1, 100))
    stop: int = option(100, "Number before which the work is interrupted")


def total(plan: Squares) -> int:
    return plan.count


def rows(plan: Squares) -> Iterator[Row]:
    for number in range(plan.count):
        if number == plan.stop:
            raise Interrupted(15)
        yield Row(number=number, square=number**2, detail={"halves": [number / 2] * 2, "odd": bool(number % 2)})


def run(*arguments: object) -> Any:
    return CliRunner().invoke(measured(Squares), [*map(str, arguments)])


def test_a_table_can_be_read_by_other_programs(tmp_path: Path) -> None:
    assert run("-o", tmp_path / "a.csv").exit_code == 0
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "# command: python -m wrt bench squares --count 3 --stop 100" and lines[1].startswith("# machine: ")
    assert list(csv.DictReader(lines[2:]))[2] == {"number": "2", "square": "4", "detail.halves": "[1.0, 1.0]", "detail.odd": "False"}
    run("-o", tmp_path / "a.json")
    found = json.loads((tmp_path / "a.json").read_text())
    assert found["rows"][1] == {"number": 1, "square": 1, "detail": {"halves": [0.5, 0.5], "odd": True}} and found["machine"]
    refused = run("-o", tmp_path / "a.txt")
    assert refused.exit_code != 0 and not (tmp_path / "a.txt").exists()


def test_ctrl_c_keeps_the_finished_rows(tmp_path: Path) -> None:
    done = run("--stop", 2, "-o", tmp_path / "a.md")
    assert done.exit_code == 128 + 15
    text = (tmp_path / "a.md").read_text()
    assert "interrupted after 2 rows" in text and "square: 1" not in text and "|      1 |" in text and "|      4 |" not in text
    assert "the results so far are kept" in done.output
    nothing = run("--stop", 0, "-o", tmp_path / "b.md")
    assert isinstance(nothing.exception, KeyboardInterrupt) or nothing.exit_code != 0
    assert not (tmp_path / "b.md").exists()


def test_progress_tells_the_time_left() -> None:
    lines = [line for line in run().output.splitlines() if "of 3" in line]
    assert [line.split("(")[1][:6] for line in lines] == ["1 of 3", "2 of 3"] and all("left" in line for line in lines)


def test_the_studies_know_their_number_of_rows() -> None:
    """The number is the expected one where no structure refuses a mesh."""
    from wrt.lab import plans
    from wrt.lab.bench import report
    from wrt.scene.shapes import icosphere

    ball = icosphere(1)
    for plan in (plans.Accel((ball,), ("bvh8", "bvh2"), ("primary", "random"), rays=64, runs=1), plans.Float64((ball,), rays=64)):
        assert report.study_of(plan).total(plan) == len(report.run(plan)), plan
