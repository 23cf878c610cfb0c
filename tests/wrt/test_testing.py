"""wrt.testing: what is public, and the pytest plugin."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

import wrt.testing
from tests.data import ROOT

USE = """
import numpy as np

def closest_hit(vertices, faces, origins, directions):
    return np.full(len(origins), np.inf), np.full(len(origins), -1)

def test_hard_case(hard_case):
    assert (hard_case.rays, hard_case.seed) == (7, 3)
    hard_case.check(closest_hit)

def test_nothing_else():
    pass
"""


def test_the_function_is_public() -> None:
    report = wrt.testing.hard_cases(lambda v, f, o, d: (np.zeros(len(o)), np.full(len(o), -1)), ["D_published", "E_grid"], rays=5)
    assert (report.results[0].ok, report.results[1].lost) == (True, 5) and "E_grid" in wrt.testing.CASES


def pytest_run(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env={"PYTHONPATH": str(ROOT)}).stdout


def test_the_plugin_runs_a_test_once_a_case(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["wrt.testing"]\n')
    (tmp_path / "test_use.py").write_text(USE)
    said = pytest_run(tmp_path, "--hard-case-rays", "7", "--hard-case-seed", "3", "-k", "D_published or E_grid or nothing_else")
    assert "1 failed, 2 passed" in said and f"{len(wrt.testing.CASES) - 2} deselected" in said
    assert "E_grid: of 7 rays 7 lost, 0 invented, 0 with a wrong triangle" in said


def test_nobody_gets_the_plugin_unasked(tmp_path: Path) -> None:
    (tmp_path / "test_use.py").write_text("import sys\ndef test_it():\n    assert 'wrt' not in sys.modules\n")
    assert "1 passed" in pytest_run(tmp_path)
    assert "pytest11" not in (ROOT / "pyproject.toml").read_text()
