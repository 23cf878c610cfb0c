"""Progress of a render on stderr."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from tests.command_line import BOX_OBJ, wrt
from wrt.renderer.options import Progress
from wrt.renderer.progress import LINE_EVERY, describe, progress_reporter


def at(seconds: float, done: int = 50) -> Progress:
    return Progress(done=done, total=200, rays=int(4e6 * seconds), seconds=seconds)


@pytest.mark.parametrize(("progress", "expected"), [
    (at(10.0), "4.0 Mray/s, 0:30 left"),
    (at(1000.0), "4.0 Mray/s, 50:00 left"),
    (at(3.0, done=200), "4.0 Mray/s, 0:00 left"),
    (at(3.0, done=0), "4.0 Mray/s, ?"),
    (at(0.0, done=0), "0.0 Mray/s, ?"),
])
def test_rays_a_second_and_time_left(progress: Progress, expected: str) -> None:
    assert describe(progress) == expected


def test_without_a_terminal_there_is_a_line_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    stderr = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stderr)
    with progress_reporter(False) as report:
        assert report is not None
        reported = []
        for second in range(35):
            report(at(float(second)))
            reported.append(stderr.getvalue().count("\n"))
    assert reported == [int(second // LINE_EVERY) for second in range(35)]
    assert set(stderr.getvalue().splitlines()[0]) & set("\x1b\r") == set()
    assert stderr.getvalue().startswith("25 %, 4.0 Mray/s, 0:30 left\n")


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo terminals")
def test_a_terminal_that_closes_does_not_end_a_render(monkeypatch: pytest.MonkeyPatch) -> None:
    """After SIGHUP, the picture so far is saved when the bar has ended."""
    monkeypatch.setenv("TERM", "xterm")
    main, terminal = os.openpty()
    ended = False
    with suppress(OSError), open(terminal, "w") as stderr:  # closing stderr fails, too
        monkeypatch.setattr(sys, "stderr", stderr)
        with progress_reporter(False) as report:
            assert report is not None
            report(at(10.0))
            os.close(main)
            report(at(20.0))
        ended = True
    assert ended


def test_a_short_render_shows_no_bar_where_stderr_is_no_terminal(tmp_path: Path) -> None:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    result = wrt("render", tmp_path / "box.obj", "-o", tmp_path / "a.png", "--size", "16x9", "--spp", 2)
    assert result.code == 0 and "━" not in result.err and "left" not in result.err
