"""Compilation that takes long is reported once, by the logger "wrt"; settings of the user stay."""

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

from tests.command_line import without_compiling
from tests.data import ROOT
from tests.kernel_tools import cpu_only
from wrt.core.compiling import COMPILING, Watch
from wrt.core.device import start

pytestmark = cpu_only

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


def test_one_long_compilation_is_reported_while_it_runs(caplog: pytest.LogCaptureFixture) -> None:
    watch = Watch(delay=0.05)
    with watch.compiling():
        assert not watch.is_slow()
        wait_until(lambda: len(caplog.records) == 1)
        assert watch.is_slow()


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


# --- the kernel cache and the settings of a user ------------------------------------------------------------------------


QUERY = """
import numpy as np, wrt
print(wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "brute_force").closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t)
"""


def run(*arguments: str, path: Path = ROOT, **options) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(path)} | options.pop("env", {})
    return subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=300, **options)


def check_silent(done: subprocess.CompletedProcess[str]) -> None:
    assert (done.returncode, done.stdout, without_compiling(done.stderr)) == (0, "[0.33333334]\n", "")


def test_an_empty_name_of_the_cache_is_none(tmp_path: Path):
    home = tmp_path / "home"
    home.mkdir()
    environment = {"WARP_CACHE_PATH": "", "HOME": str(home), "XDG_CACHE_HOME": str(home / "cache")}
    check_silent(run("-c", QUERY, env=environment, cwd=tmp_path))
    assert list(tmp_path.iterdir()) == [home] and list(home.rglob("*.o"))


@pytest.mark.parametrize(("before", "after"), [("LOG_DEBUG", "LOG_DEBUG"), ("LOG_ERROR", "LOG_ERROR"), ("LOG_INFO", "LOG_WARNING")])
def test_the_log_level_of_a_user_stays(before: str, after: str):
    done = run("-c", f"import warp as wp; wp.config.log_level = wp.{before}\nimport wrt.core.device\n"
                     f"assert wp.config.log_level == wp.{after}")
    assert (done.returncode, done.stderr) == (0, "")
