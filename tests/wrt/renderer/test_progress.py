"""Progress of a render on stderr."""

from __future__ import annotations

import io
import os
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.command_line import BOX_OBJ, wrt
from wrt.core.compiling import COMPILING
from wrt.renderer.options import Progress
from wrt.renderer.progress import BUILDING, LINE_EVERY, describe, progress_reporter


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


def test_a_process_without_stderr_prints_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """If stderr is closed, `print` would write to stdout, which is for data."""
    with progress_reporter(quiet=True) as report:
        assert report is None
    monkeypatch.setattr(sys, "stderr", None)
    with progress_reporter(False) as report:
        assert report is None


def test_compiling_and_building_are_reported_too(monkeypatch: pytest.MonkeyPatch) -> None:
    stderr = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stderr)
    with progress_reporter(False) as report:
        assert report is not None
        report(Progress(0, 200, 0, 0.0, stage="compile"))
        for second in range(1, 15):
            report(Progress(2 * second, 100, 0, float(second), stage="build"))
        for second in range(1, 11):
            report(at(float(second)))
    assert stderr.getvalue().splitlines() == [COMPILING, f"20 %, {BUILDING}", "25 %, 4.0 Mray/s, 0:30 left"]


def test_a_closed_terminal_does_not_end_a_render(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(text: str) -> int:
        raise OSError("Input/output error")

    stderr = io.StringIO()
    monkeypatch.setattr(stderr, "write", gone)
    monkeypatch.setattr(sys, "stderr", stderr)
    with progress_reporter(False) as report:
        assert report is not None
        report(at(LINE_EVERY))


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo terminals")
def test_on_a_terminal_there_is_a_bar_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    main, terminal = os.openpty()
    seen: list[bytes] = []

    def read() -> None:
        try:
            while data := os.read(main, 65536):
                seen.append(data)
        except OSError:  # Linux raises OSError when the other side is closed
            pass

    reader = threading.Thread(target=read)
    reader.start()
    with open(terminal, "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        with progress_reporter(False) as report:
            assert report is not None
            report(Progress(0, 200, 0, 0.0, stage="compile"))
            time.sleep(0.3)  # the bar is drawn ten times per second
            report(at(10.0))
    reader.join()
    os.close(main)
    text = b"".join(seen).decode()
    assert COMPILING in text and text.index(COMPILING) < text.index("25%")
    assert "render" in text and "25%" in text and "4.0 Mray/s, 0:30 left" in text
    assert "\x1b[?25h" in text and text.rindex("\x1b[?25h") > text.rindex("25%")  # the cursor is back
    assert text.endswith("\x1b[2K")  # and the line is empty again


def test_a_short_render_shows_no_bar_where_stderr_is_no_terminal(tmp_path: Path) -> None:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    result = wrt("render", tmp_path / "box.obj", "-o", tmp_path / "a.png", "--size", "16x9", "--spp", 2)
    assert result.code == 0 and "━" not in result.err and "left" not in result.err
