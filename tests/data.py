"""Where the meshes and scenes by others are: never in this project, so a test that wants one may have to skip."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("WRT_DATA", ROOT.parent / "shared" / "data"))


def data_path(name: str) -> Path:
    """The path of a file or folder of the data set; skips the test where it is missing."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"needs {name} from the data set (set WRT_DATA to its folder)")
    return path
