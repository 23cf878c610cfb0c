"""docs/gallery.md: each picture is the result of the code beside it."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.data import ROOT

MAKE: dict[str, Any] = runpy.run_path(str(ROOT / "docs" / "images" / "make.py"))
CODE: dict[str, str] = MAKE["gallery"]()
RENDERED = [name for name, code in CODE.items() if "wrt.render(" in code]
STORED = ROOT / "docs" / "images" / "gallery"


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(int)


def test_the_page_shows_each_stored_picture_above_its_code() -> None:
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert re.findall(r"\(images/gallery/(.*)\)", page) == list(CODE)
    assert {path.name for path in STORED.iterdir()} == set(CODE) and len(CODE) > 10
    assert 0 < len(RENDERED) < len(CODE)


@pytest.mark.parametrize("name", [name for name in CODE if name not in RENDERED])
def test_a_picture_of_hits_is_the_result_of_its_code(name: str, tmp_path: Path) -> None:
    MAKE["run"](CODE[name], tmp_path)
    assert np.abs(pixels(tmp_path / name) - pixels(STORED / name)).max() <= 1  # NumPy's cos and exp differ in last bits between CPUs


@pytest.mark.slow
@pytest.mark.parametrize("name", RENDERED)
def test_a_rendered_picture_is_the_result_of_its_code(name: str, tmp_path: Path) -> None:
    MAKE["run"](CODE[name], tmp_path)
    assert np.array_equal(pixels(tmp_path / name), pixels(STORED / name))
