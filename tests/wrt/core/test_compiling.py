"""Compilation that takes long is reported once, by the logger "wrt"."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
import warp as wp

from tests.data import ROOT
from wrt.core.compiling import COMPILING, LOGGER, Watch
from wrt.core.device import start

LOAD = """
import wrt
from wrt.core.compiling import WATCH
WATCH.delay = 0.0
mesh = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]
wrt.build(mesh, "brute_force").closest_hit([[0.2, 0.2, 1]], [[0, 0, -1]])
"""


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_compilation_that_takes_long_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """Also if several threads compile, and if each kernel of a series is quick."""
    watch = Watch(delay=0.1)
    start = threading.Barrier(4)

    def compile_kernels() -> None:
        start.wait(60.0)
        for _ in range(20):
            with watch.compiling():
                time.sleep(0.01)

    threads = [threading.Thread(target=compile_kernels) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [(each.name, each.getMessage()) for each in caplog.records] == [("wrt", COMPILING)]
    assert not watch.is_slow()


def test_a_filter_that_raises_leaves_no_compilation_behind() -> None:
    def refuse(record: logging.LogRecord) -> bool:
        raise OSError("the log is full")

    watch = Watch(delay=2.0)
    with watch.compiling():
        pass
    watch.delay = 0.0  # the next compilation belongs to a series that lasts too long
    LOGGER.addFilter(refuse)
    try:
        with pytest.raises(OSError, match="full"), watch.compiling():
            pass
    finally:
        LOGGER.removeFilter(refuse)
    assert not watch.is_slow()


def test_one_long_compilation_is_reported_while_it_runs(caplog: pytest.LogCaptureFixture) -> None:
    watch = Watch(delay=0.05)
    with watch.compiling():
        assert not watch.is_slow()
        wait_until(lambda: len(caplog.records) == 1)
        assert watch.is_slow()


def test_after_a_pause_the_next_series_is_reported_anew(caplog: pytest.LogCaptureFixture) -> None:
    watch = Watch(delay=0.0, pause=0.0)
    for count in (1, 2):
        with watch.compiling():
            wait_until(lambda: len(caplog.records) == count)  # noqa: B023
        time.sleep(0.01)


def test_quick_compilation_and_what_the_caller_reports_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    for watch, told in ((Watch(delay=60.0), False), (Watch(delay=0.0), True)):
        with ExitStack() as stack:
            if told:
                stack.enter_context(watch.reported_by_caller())
            with watch.compiling():
                assert watch.is_slow() == told
        with pytest.raises(ZeroDivisionError), watch.reported_by_caller(), watch.compiling():
            raise ZeroDivisionError
    assert not caplog.records


def test_logging_switches_it_off(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR, LOGGER.name), Watch(delay=0.0).compiling():
        time.sleep(0.05)
    assert not caplog.records


def test_a_program_without_logging_gets_a_line_on_stderr(tmp_path: Path) -> None:
    """If it compiles: kernels in the cache are loaded without a word."""
    start("cpu")
    for headers in Path(wp.config.kernel_cache_dir).glob("precompiled-*"):
        (tmp_path / headers.parent.name).mkdir(exist_ok=True)
        (tmp_path / headers.parent.name / headers.name).symlink_to(headers)
    for expected in (f"{COMPILING}\n", ""):
        done = subprocess.run([sys.executable, "-c", LOAD], cwd=ROOT, capture_output=True, text=True, check=True, timeout=300,
                              env=os.environ | {"WARP_CACHE_PATH": str(tmp_path)})
        assert (done.stdout, done.stderr) == ("", expected)
