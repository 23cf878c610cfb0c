"""The long runs work: a soak of a few seconds, and mutants that are valid code."""

from __future__ import annotations

import ast
import re

import pytest

from tests import mutants, soak
from tests.data import ROOT
from tests.device import NAME


@pytest.mark.skipif(NAME != "cpu", reason="its processes render on the CPU")
def test_a_soak_checks_answers_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    assert soak.run(1.0, seed=3, growth=1000.0, report=lines.append) == 0, lines
    assert re.search(r"^\d+ steps in .*, all right: \d+ ", lines[-2]) and "MiB per hour" in lines[-1]
    assert soak.slope([0.0, 1800.0, 3600.0, 5400.0], [900.0, 10.0, 20.0, 30.0]) == (pytest.approx(20.0), pytest.approx(20.0))
    hits = soak.Soak.hits
    monkeypatch.setattr(soak.Soak, "hits", lambda self, *rays: hits(self, *rays) + str(self.random.random()).encode())
    assert soak.run(1e9, seed=3, growth=1000.0, report=lines.append) == 1
    assert lines[-1].startswith("seed 3, step ")


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
