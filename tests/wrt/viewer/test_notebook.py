"""Output in notebooks: pictures side by side, and tables."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

import wrt
from tests.wrt.renderer.test_checkpoint import SCENE
from wrt.core.errors import InputError
from wrt.core.tables import html_table


def test_pictures_side_by_side_keep_their_pixels() -> None:
    film = wrt.render(SCENE, spp=2)
    codes = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    sheet = np.asarray(wrt.side_by_side({"film": film, "codes": codes, "": codes}, scale=2))
    height, width = film.samples.shape
    assert sheet.shape == (2 * (22 + 2 * height + 8) - 8, 2 * (2 * width + 8) - 8, 3)
    np.testing.assert_array_equal(sheet[22:22 + 2 * height:2, 1:2 * width:2], film.to_srgb8())
    x = 2 * width + 8
    np.testing.assert_array_equal(sheet[23:30:2, x:x + 10:2], codes)
    y = 22 + 2 * height + 8
    assert (sheet[y:y + 22] == 255).all() and (sheet[:22] < 128).any()  # white where a name is empty, dark text in the other titles
    np.testing.assert_array_equal(wrt.side_by_side({"": codes}), codes)
    for wrong in ({}, {"x": codes[..., 0]}, {"x": film.pixels}):
        with pytest.raises(InputError, match=r"side_by_side|x must be a Film"):
            wrt.side_by_side(wrong)


# --- tables -----------------------------------------------------------------------------------------------------------


class Tables(HTMLParser):
    """Collects the text of all cells, row by row; fails on a tag that wrt's tables do not use."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.open: list[str] = []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        assert tag in ("b", "table", "tr", "td", "th", "p") and dict(attrs).keys() <= {"style"}
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


EVIL = "<script>alert('\"&')</script>"


def test_nothing_in_a_table_is_markup() -> None:
    assert Tables(html_table(EVIL, (EVIL,), [(EVIL,), (1,)])).rows == [[EVIL], [EVIL], ["1"]]


def test_reports_are_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    from wrt.lab.hard_cases.conformance import Report, Result
    from wrt.lab.rtcore.profiler import Profile

    report = Report((Result(EVIL, rays=1),))
    assert Tables(report._repr_html_()).rows[1][0] == EVIL
    monkeypatch.setattr(Profile, "by_depth", lambda self: [{"depth": 0, "kind": "primary", "nodes": 1234}])
    profile = Profile(EVIL, (16, 9), 1, np.zeros((9, 16, 3)), rays=(), accel=None)  # type: ignore[arg-type]
    assert Tables(profile._repr_html_()).rows == [["depth", "kind", "nodes"], ["0", "primary", "1,234"]]
