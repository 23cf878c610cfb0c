"""Paths of meshes and scenes by others. The project does not contain them; a test that needs a missing file skips."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("WRT_DATA", ROOT.parent / "shared" / "data"))


def data_path(name: str) -> Path:
    """Return the path of a file or folder of the data set; skip the test if it is missing."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"needs {name} from the data set (set WRT_DATA to its folder)")
    return path
