"""What all measuring commands share: the formats of reports, the time left, and what Ctrl-C keeps. This module is the study of a plan."""

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
from wrt.core.errors import InputError
from wrt.core.interrupts import Interrupted
from wrt.lab.bench import resume
from wrt.lab.bench.report import Columns, Groups, Row
from wrt.lab.plans import Plan, option

TITLE, LEGEND = "Squares", "square: the number times itself."
COLUMNS: Columns = {"number": "{number}", "square": "{square}"}


@dataclass(frozen=True)
class Squares(Plan):
    """Square the numbers below COUNT."""

    COMMAND, STUDY = "bench squares", __name__
    count: int = option(3, "How many numbers", (1, 100))
    files: Sequence[str] = option((), "Files, which must not change")


measured_numbers: list[int] = []  # by all runs of a test
stop_before = [100]  # the number before which SIGTERM comes


@pytest.fixture(autouse=True)
def _no_runs_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    measured_numbers.clear()
    stop_before[0] = 100


def groups(plan: Squares) -> Groups:
    """Yield an empty group, then a group for each two numbers."""
    yield list
    for first in range(0, plan.count, 2):
        yield partial(square_rows, range(first, min(first + 2, plan.count)))


def square_rows(numbers: Sequence[int]) -> list[Row]:
    if numbers[0] >= stop_before[0]:
        raise Interrupted(15)
    measured_numbers.extend(numbers)
    return [Row(number=number, square=number**2, detail={"halves": [number / 2] * 2, "odd": bool(number % 2)},
                pair=(number, np.float64(0.1)), share=math.nan, inner=Row(largest=math.inf, array=np.arange(3.0)), _hidden="x")
            for number in numbers]


def run(*arguments: object, stop: int = 100) -> Any:
    stop_before[0] = stop
    return CliRunner().invoke(measured(Squares), [*map(str, arguments)])


def test_a_table_can_be_read_by_other_programs(tmp_path: Path) -> None:
    assert run("-o", tmp_path / "a.csv").exit_code == 0
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "# command: python -m wrt bench squares --count 3" and lines[1].startswith("# machine: ")
    found = list(csv.DictReader(lines[2:]))[2]
    assert (found["number"], found["square"], found["detail.halves"], found["detail.odd"]) == ("2", "4", "[1.0, 1.0]", "False")
    run("-o", tmp_path / "a.json")
    data = json.loads((tmp_path / "a.json").read_text())
    assert data["rows"][1] == {"number": 1, "square": 1, "detail": {"halves": [0.5, 0.5], "odd": True}, "pair": [1, 0.1], "share": None,
                               "inner": {"largest": None}}
    assert data["machine"] and "resume" not in data
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


@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_a_stopped_run_is_resumed_without_measuring_again(tmp_path: Path, suffix: str) -> None:
    path, whole = tmp_path / f"a{suffix}", tmp_path / f"whole{suffix}"
    run("--count", 7, "-o", whole)
    measured_numbers.clear()
    assert run("--count", 7, "-o", path, stop=2).exit_code == 128 + 15 and measured_numbers == [0, 1]
    again = run("--count", 7, "-o", path, "--resume", stop=6)
    assert again.exit_code == 128 + 15 and measured_numbers == [0, 1, 2, 3, 4, 5] and "(3 of 5" in again.output
    assert run("--count", 7, "-o", path, "--resume", stop=6).exit_code == 128 + 15  # a signal before any new row loses nothing
    assert run("--count", 7, "-o", path, "--resume").exit_code == 0 and measured_numbers == list(range(7))
    assert without_machine(path) == without_machine(whole) and "resumed after 6 rows of" in path.read_text()


def without_machine(path: Path) -> object:
    if path.suffix == ".json":
        return {name: value for name, value in json.loads(path.read_text()).items() if name != "machine"}
    return [line for line in path.read_text().splitlines() if not line.startswith("# machine")]


def test_a_run_without_a_file_begins_with_resume(tmp_path: Path) -> None:
    assert run("-o", tmp_path / "a.json", "--resume").exit_code == 0 and measured_numbers == [0, 1, 2]


def refusal(*arguments: object) -> str:
    measured_numbers.clear()
    done = run(*arguments, "--resume")
    assert isinstance(done.exception, InputError) and not measured_numbers  # exit code 2 of the whole command line
    return str(done.exception)


def test_what_cannot_be_resumed_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, named = tmp_path / "a.json", tmp_path / "data.txt"
    named.write_text("one")
    files = ("--files", f"name={named}")
    run("--count", 7, *files, "-o", path, stop=2)
    before = path.read_bytes()
    assert "count 7 (here 5)" in refusal("--count", 5, *files, "-o", path)
    named.write_text("two")
    assert "is the report of other options: files" in refusal("--count", 7, *files, "-o", path)
    named.write_text("one")
    with monkeypatch.context() as patch:
        patch.setattr(resume, "DIGEST", "another")
        assert "another version of wrt" in refusal("--count", 7, *files, "-o", path)
    assert path.read_bytes() == before
    assert run("--count", 7, *files, "-o", path, "--resume").exit_code == 0
    for name, text in (("whole.json", path.read_text()), ("b.json", "{"), ("c.json", "[]"), ("d.csv", "a,b\n1,2\n"), ("e.csv", ""),
                       ("f.json", '{"resume": "{}"}'), ("g.json", '{"resume": 3}'), ("h.json", "[" * 100000),
                       *((f"{i}.json", json.dumps({"resume": json.dumps({"of": {}, "machine": "", "groups": groups})}))
                         for i, groups in enumerate((1, [1], [None], {"is": "Row", "of": {}})))):
        (tmp_path / name).write_text(text)
        assert "is not the report of an interrupted run" in refusal("--count", 7, *files, "-o", tmp_path / name)
    for arguments in ((), ("-o", tmp_path / "a.md")):
        assert "--resume needs the report to resume" in refusal(*arguments)


def test_progress_tells_the_time_left() -> None:
    """Of four groups, the first is empty and the others have 2, 2 and 1 rows."""
    lines = [line for line in run("--count", 5).output.splitlines() if "of 4" in line]
    assert [line.split("(")[1][:6] for line in lines] == ["2 of 4", "2 of 4", "3 of 4", "3 of 4"] and all("left" in line for line in lines)
