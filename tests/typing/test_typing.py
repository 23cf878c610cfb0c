"""mypy (strict) and pyright accept the calls in examples.py, with their types, and report the errors in mistakes.py."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.data import ROOT

EXAMPLES, MISTAKES = (Path(__file__).with_name(name) for name in ("examples.py", "mistakes.py"))


def mypy(tmp_path: Path) -> set[tuple[str, int]]:
    """Return (file, line) of each error that mypy reports, with Warp's own types instead of stubs/."""
    pytest.importorskip("mypy")
    config = tmp_path / "mypy.ini"
    config.write_text("[mypy]\nstrict = True\nfollow_imports = silent\nignore_missing_imports = True\n")
    result = subprocess.run([sys.executable, "-m", "mypy", "--config-file", str(config), "--cache-dir", str(tmp_path / "cache"),
                             "--no-error-summary", "--hide-error-context", str(EXAMPLES), str(MISTAKES)],
                            capture_output=True, text=True, cwd=ROOT)
    assert result.returncode in (0, 1), result.stderr
    return {(Path(file).name, int(line)) for file, line in re.findall(r"^(\S+?):(\d+): error:", result.stdout, re.M)}


def pyright(tmp_path: Path) -> set[tuple[str, int]]:
    """Return (file, line) of each error that pyright reports."""
    pytest.importorskip("basedpyright")
    config = tmp_path / "pyrightconfig.json"
    # `strict` without the rules that need types which Warp and trimesh do not declare.
    rules = {"reportUnknownMemberType": "none", "reportUnknownArgumentType": "none", "reportUnknownVariableType": "none",
             "reportUnusedExpression": "none", "reportUnusedCallResult": "none"}
    config.write_text(json.dumps({"include": [str(EXAMPLES), str(MISTAKES)], "typeCheckingMode": "strict", "pythonVersion": "3.11",
                                  "extraPaths": [str(ROOT)], "stubPath": str(tmp_path)} | rules))
    result = subprocess.run([sys.executable, "-m", "basedpyright", "--outputjson", "-p", str(config), "--pythonpath", sys.executable],
                            capture_output=True, text=True, cwd=tmp_path)
    found = json.loads(result.stdout)["generalDiagnostics"]
    return {(Path(each["file"]).name, each["range"]["start"]["line"] + 1) for each in found if each["severity"] == "error"}


@pytest.mark.parametrize("check", [mypy, pyright])
def test_documented_calls_pass_and_mistakes_are_found(check, tmp_path: Path) -> None:
    wrong = {(MISTAKES.name, i) for i, line in enumerate(MISTAKES.read_text().splitlines(), 1) if "  # Error" in line}
    assert check(tmp_path) == wrong
