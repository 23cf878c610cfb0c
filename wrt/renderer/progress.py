"""Progress of a render on stderr: a bar on a terminal, otherwise a line every ten seconds."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING

from wrt.core.compiling import COMPILING
from wrt.core.packages import needed_by

if TYPE_CHECKING:
    from wrt.renderer.options import Progress

BUILDING = "building the structure"
LINE_EVERY = 10.0  # seconds between lines, if stderr is no terminal


def describe(progress: Progress) -> str:
    """Return a text with the rays per second, the time left, and the note."""
    note = f"; {progress.note}" if progress.note else ""
    return f"{progress.rays_per_second / 1e6:.1f} Mray/s, {time_left(progress.seconds_left)}{note}"


def time_left(seconds: float) -> str:
    """Return a time as text in minutes and seconds; "?" if it is unknown (inf)."""
    return f"{int(seconds // 60)}:{int(seconds % 60):02d} left" if seconds < 1e6 else "?"


class TimeLeft:
    """Estimate of the time left, at the mean speed so far. total: amount of work, in any unit. The caller sets `done` in this unit."""

    def __init__(self, total: float) -> None:
        self.total, self.done, self.begin = total, 0.0, time.perf_counter()

    def __str__(self) -> str:
        """Return a text to append to a line, such as ", about 1:30 left"; empty while `done` is 0."""
        if self.done <= 0.0:
            return ""
        seconds = (time.perf_counter() - self.begin) * max(self.total - self.done, 0.0) / self.done
        return f", about {time_left(seconds)}"


@contextmanager
def progress_reporter(quiet: bool) -> Iterator[Callable[[Progress], None] | None]:
    """Yield a callback for `wrt.render(progress=...)` that writes to stderr; None if quiet, or if stderr is closed."""
    if quiet or sys.stderr is None:  # print would then write to stdout
        yield None
        return
    with _bar() if sys.stderr.isatty() else nullcontext(_lines()) as report:
        yield report


@contextmanager
def _bar() -> Iterator[Callable[[Progress], None]]:
    with needed_by("a progress bar"):
        from rich.console import Console
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn
        from rich.progress import Progress as RichProgress

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[note]}"))
    bar = RichProgress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task("render", total=None, note="")

    def report(progress: Progress) -> None:
        if progress.stage == "compile":
            bar.update(task, description=COMPILING)
            return
        what, note = (BUILDING, "") if progress.stage == "build" else ("render", describe(progress))
        bar.update(task, description=what, completed=progress.done, total=progress.total, note=note)

    bar.start()
    try:
        yield report
    finally:
        with suppress(OSError):  # a closed terminal (SIGHUP) must not end the render before its picture is saved
            bar.stop()


def _lines() -> Callable[[Progress], None]:
    due = {"build": LINE_EVERY, "trace": LINE_EVERY}

    def report(progress: Progress) -> None:
        with suppress(OSError):  # of a pipe whose reader has ended
            if progress.stage == "compile":
                print(COMPILING, file=sys.stderr, flush=True)
            elif progress.seconds >= due[progress.stage]:
                due[progress.stage] = progress.seconds + LINE_EVERY
                text = BUILDING if progress.stage == "build" else describe(progress)
                print(f"{100.0 * progress.done / progress.total:.0f} %, {text}", file=sys.stderr, flush=True)

    return report
