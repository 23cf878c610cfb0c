"""The long runs work: a soak of a few seconds, mutants that are valid code, and figures in a table."""

from __future__ import annotations

import ast
import importlib
import json
import re
from pathlib import Path

import pytest

from tests import mutants, trust
from tests.data import ROOT
from tests.device import NAME


@pytest.mark.skipif(NAME != "cpu", reason="its processes render on the CPU")
def test_a_soak_checks_answers_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("websockets")
    from tests import soak

    lines: list[str] = []
    assert soak.run(1.0, seed=3, growth=1000.0, report=lines.append) == 0, lines
    assert re.search(r"^\d+ steps in .*, all right: \d+ ", lines[-2]) and "MiB per hour" in lines[-1]
    assert soak.slope([0.0, 1800.0, 3600.0, 5400.0], [900.0, 10.0, 20.0, 30.0]) == (pytest.approx(20.0), pytest.approx(20.0))
    hits = soak.Soak.hits
    monkeypatch.setattr(soak.Soak, "hits", lambda self, *rays: hits(self, *rays) + str(self.random.random()).encode())
    assert soak.run(1e9, seed=3, growth=1000.0, report=lines.append) == 1
    assert lines[-1].startswith("seed 3, step ")


@pytest.mark.parametrize("name, arguments", [("soak", ("--hours", "nan")), ("soak", ("--growth", "-1")), ("mutants", ("--count", "-1")),
                                             ("mutants", ("--workers", "0")), ("mutants", ("--first", "-1"))])
def test_wrong_arguments_are_refused(name: str, arguments: tuple[str, str], monkeypatch: pytest.MonkeyPatch,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("websockets")
    monkeypatch.setattr("sys.argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"tests.{name}").main()
    said = capsys.readouterr().err
    assert ended.value.code == 2 and "must be a" in said and arguments[0] in said


def test_mutants_are_valid_code_with_one_change() -> None:
    """A change in an annotation, a comment or a docstring would survive and say nothing."""
    chosen = mutants.sample(seed=0)
    assert chosen == mutants.sample(seed=0) != mutants.sample(seed=1) and len(chosen) > 2000
    for mutant in chosen[:60]:
        text = (ROOT / mutant.path).read_text("utf-8")
        changed = mutant.apply(text)
        assert changed.splitlines()[mutant.line - 1] != text.splitlines()[mutant.line - 1]
        if mutant.path.endswith(".py"):
            assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(text)), mutant
    text = '// a < b\nint f(int x) { return x < 3 ? x + 1 : x * 2; }  // x + 1\n#include "a + b"\ntemplate <int N> struct A {};\n'
    assert [text[begin:end] for begin, end in mutants.cpp_tokens(text)] == ["<", "3", "+", "1", "*", "2"]
    text = '"""1 + 1"""\nimport warp\nN = 2\n@f(1)\ndef g(a: wp.array(ndim=3) = 1) -> int:\n    """2 < 3"""\n    return a - 1.5\n'
    assert [text[begin:end] for begin, end in mutants.python_tokens(text) if mutants.changed(text[begin:end])] == ["2", "-", "1.5"]


def test_a_mutant_is_noticed_by_the_tests_of_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = object.__new__(mutants.Worker)
    worker.root, worker.thorough, worker.unchanged = tmp_path, False, {}
    file, mutant = tmp_path / "a.py", mutants.Mutant("a.py", 1, 4, 5, "1", "0")
    file.write_text("x = 1\n")
    monkeypatch.setattr(worker, "pytest", lambda arguments: file.read_text().replace("x = 1\n", ""))
    assert worker.run(mutant) == ("noticed", "x = 0\n") and file.read_text() == "x = 1\n"
    monkeypatch.setattr(worker, "pytest", lambda arguments: "")
    assert worker.run(mutant) == ("survived", "")
    monkeypatch.setattr(worker, "unchanged", {})
    monkeypatch.setattr(worker, "pytest", lambda arguments: "FAILED always")
    assert worker.run(mutant) == ("not counted", "its tests fail without a change: FAILED always")
    for path in ("kernels/units/box.py", "kernels/wide/box.h", "kernels/wide/nodes.py"):
        assert all((ROOT / stage[0]).exists() for stage in mutants.stages(path, thorough=True))


def test_figures_become_a_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = trust.PAGE.read_text("utf-8")
    assert trust.BEGIN in page and trust.END in page
    assert all(f"| {each['what']} | {each['found']} |" in page for each in json.loads(trust.STORED.read_text("utf-8")).values())
    monkeypatch.setattr(trust, "STORED", tmp_path / "trust.json")
    monkeypatch.setattr(trust, "collected", lambda: (1234, 56))
    trust.record("soak", "1 step", "nothing")
    trust.record("soak", "2 steps", "nothing")
    lines = trust.table().splitlines()
    assert len(lines) == 5 and "| 1,234 tests |" in lines[2] and "| 56 more tests |" in lines[3]
    assert re.fullmatch(r"\| `python -m tests.soak` \| \d{4}-\d\d-\d\d \| 2 steps \| nothing \|", lines[4])
