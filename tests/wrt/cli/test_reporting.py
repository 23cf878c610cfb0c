"""What all measuring commands share: options of a plan, --quick, formats of reports, the time left, and what Ctrl-C keeps.

This module is the study of a plan."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from wrt.cli.reporting import measured
from wrt.core.interrupts import Interrupted
from wrt.lab import Plan, option
from wrt.lab.bench import Error, Queries, Visibility
from wrt.lab.bench.report import Columns, Groups, Row
from wrt.lab.claims import Claims
from wrt.lab.hard_cases import Stability
from wrt.lab.mitsuba import Mitsuba
from wrt.lab.rtcore import RtCore, WhatIf

TITLE, LEGEND = "Squares", "square: the number times itself."
COLUMNS: Columns = {"number": "{number}", "square": "{square}"}


@dataclass(frozen=True)
class Squares(Plan):
    """Square the numbers below COUNT."""

    COMMAND, STUDY, QUICK = "bench squares", __name__, {"count": 1}
    count: int = option(3, "How many numbers", (1, 100))
    files: Sequence[str] = option((), "Files, which must not change")


stop_before = [100]  # the number before which SIGTERM comes


def groups(plan: Squares) -> Groups:
    """Yield an empty group, then a group for each two numbers."""
    yield list
    for first in range(0, plan.count, 2):
        yield partial(square_rows, range(first, min(first + 2, plan.count)))


def square_rows(numbers: Sequence[int]) -> list[Row]:
    if numbers[0] >= stop_before[0]:
        raise Interrupted(15)
    return [Row(number=number, square=number**2, detail={"halves": [number / 2] * 2, "odd": bool(number % 2)},
                pair=(number, np.float64(0.1)), share=math.nan, inner=Row(largest=math.inf, array=np.arange(3.0)), _hidden="x")
            for number in numbers]


def run(*arguments: object, stop: int = 100) -> Any:
    stop_before[0] = stop
    return CliRunner().invoke(measured(Squares), [*map(str, arguments)])


def test_a_table_can_be_read_by_other_programs(tmp_path: Path) -> None:
    assert run("--files", "a,b", "--files", "c", "-o", tmp_path / "a.csv").exit_code == 0
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "# command: python -m wrt bench squares --count 3 --files a,b,c" and lines[1].startswith("# machine: ")
    found = list(csv.DictReader(lines[2:]))[2]
    assert (found["number"], found["square"], found["detail.halves"], found["detail.odd"]) == ("2", "4", "[1.0, 1.0]", "False")
    run("-o", tmp_path / "a.json")
    data = json.loads((tmp_path / "a.json").read_text())
    assert data["rows"][1] == {"number": 1, "square": 1, "detail": {"halves": [0.5, 0.5], "odd": True}, "pair": [1, 0.1], "share": None,
                               "inner": {"largest": None}}
    assert data["machine"]
    refused = run("-o", tmp_path / "a.txt")
    assert refused.exit_code != 0 and not (tmp_path / "a.txt").exists()


def test_ctrl_c_keeps_the_finished_rows(tmp_path: Path) -> None:
    done = run("-o", tmp_path / "a.md", stop=2)
    assert done.exit_code == 128 + 15
    text = (tmp_path / "a.md").read_text()
    assert "interrupted after 2 rows" in text and "square: 1" not in text and "|      1 |" in text and "|      4 |" not in text
    assert "the results so far are kept" in done.output
    nothing = run("-o", tmp_path / "b.md", stop=0)
    assert isinstance(nothing.exception, KeyboardInterrupt) or nothing.exit_code != 0
    assert not (tmp_path / "b.md").exists()


def test_progress_tells_the_time_left() -> None:
    """Of four groups, the first is empty and the others have 2, 2 and 1 rows."""
    lines = [line for line in run("--count", 5).output.splitlines() if "of 4" in line]
    assert [line.split("(")[1][:6] for line in lines] == ["1 of 4", "2 of 4", "2 of 4", "3 of 4", "3 of 4"]
    assert all("left" in line for line in lines)


def test_quick_lists_its_smaller_defaults_and_keeps_stated_options() -> None:
    done = run("--quick", "-q")
    assert done.stderr == "squares --quick: count 1 instead of 3\n" and "--count 1`" in done.stdout
    assert "no effect" in run("--quick", "--count", 2).stderr


@pytest.mark.parametrize("plan", [Queries, Visibility, Claims, Error, Stability, Mitsuba, RtCore, WhatIf])
def test_quick_is_less_than_the_default(plan: Any) -> None:
    defaults = {name: plan.__dataclass_fields__[name].default for name in plan.QUICK}
    assert all(plan.QUICK[name] < default for name, default in defaults.items() if not isinstance(default, str | tuple))
    assert any(plan.QUICK[name] != default for name, default in defaults.items())
