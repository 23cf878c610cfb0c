"""Compilation that takes long is reported once, by the logger "wrt"; after damage to the kernel cache, a kernel gives the right answer."""

import logging
import os
import shutil
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
import warp as wp

from tests.command_line import without_compiling
from tests.data import ROOT
from tests.kernel_tools import cpu_only, launch, zeros
from wrt.core import compiling, device
from wrt.core.compiling import COMPILING, LOGGER, Watch
from wrt.core.device import load_kernel, start
from wrt.core.errors import InputError
from wrt.kernels.structs import kernel

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


# --- the kernel cache ---------------------------------------------------------------------------------------------------


def count_up(numbers: wp.array(dtype=float)):
    i = wp.tid()
    numbers[i] = float(i) + 0.25


count_up.__module__ = "wrt.kernels.pretended"  # objects of wrt's own kernels are sealed
COUNT_UP = kernel(count_up)


def answer() -> list[float]:
    """Return what the kernel writes, after loading it from the cache as in a new process."""
    COUNT_UP.module.unload()
    device._loaded.clear()
    numbers = zeros(3)
    load_kernel(COUNT_UP, start("cpu"))
    launch(COUNT_UP, 3, numbers)
    return numbers.numpy().tolist()


RIGHT = [0.25, 1.25, 2.25]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty kernel cache for one test."""
    start("cpu")
    folder = tmp_path / "new" / "cache"
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    return folder


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A kernel cache with the kernel and the precompiled headers."""
    start("cpu")
    folder = tmp_path_factory.mktemp("filled") / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp.config, "kernel_cache_dir", str(folder))
        assert answer() == RIGHT
    return folder


def cut(to: Callable[[int], int]) -> Callable[[Path], None]:
    return lambda path: os.truncate(path, to(path.stat().st_size))


def flip_one_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


DAMAGE = {"empty": cut(lambda size: 0), "half": cut(lambda size: size // 2), "without its last byte": cut(lambda size: size - 1),
          "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)), "one bit": flip_one_bit, "removed": Path.unlink}


@pytest.mark.parametrize(("what", "damage"), [*(("*.o", each) for each in DAMAGE), ("*.meta", "half"), ("*.cpp", "removed"), (".", "")])
def test_a_damaged_file_is_compiled_again_once(what: str, damage: str, filled: Path, cache: Path, capfd: pytest.CaptureFixture[str]):
    shutil.copytree(filled, cache)
    assert answer() == RIGHT
    (folder,) = cache.glob("wp_*")
    if damage:
        DAMAGE[damage](*folder.glob(what))
    else:
        shutil.rmtree(cache.parent)
    assert answer() == RIGHT
    (compiled,) = folder.glob("*.o")
    before = compiled.stat()
    assert answer() == RIGHT
    after = compiled.stat()
    assert (before.st_ino, before.st_mtime_ns) == (after.st_ino, after.st_mtime_ns)  # nothing is left to mend
    assert capfd.readouterr() == ("", "")


def test_a_kernel_that_cannot_be_loaded_is_one_message_after_a_second_try(cache: Path, monkeypatch: pytest.MonkeyPatch):
    assert answer() == RIGHT
    tried = []
    monkeypatch.setattr(type(COUNT_UP.module), "load", lambda *args, **options: tried.append(1) or _raise())
    with pytest.raises(InputError) as told:
        answer()
    assert told.value.path == str(cache) and "kernels cannot be compiled: Failed to load CPU module; set WARP" in str(told.value)
    assert len(tried) == 2


def _raise():
    raise Exception("Failed to load CPU module")  # as Warp does


def test_leftovers_of_killed_processes_are_removed_after_a_day(cache: Path, monkeypatch: pytest.MonkeyPatch):
    names = ("precompiled-1.19.0-Linux-x86_64-9e3c5285", "precompiled-abc", "wp_x_0123abc_p12_t345", "wp_x_p1_t2_0123abc", "lto")
    for day in ("old", "new"):
        for name in names:
            (cache / f"{name}{'' if day == 'old' else '9'}" / "content").mkdir(parents=True)
    for name in names:
        os.utime(cache / name, (1.6e9, 1.6e9))
    (cache / "precompiled-link").symlink_to(cache / "lto")
    monkeypatch.setattr(compiling, "_checked", set())
    assert answer() == RIGHT
    left = {path.name for path in cache.iterdir()}
    assert not left & set(names[:3]) and left >= {*names[3:], *(f"{name}9" for name in names)}
    assert (cache / "lto" / "content").is_dir()


QUERY = """
import numpy as np, wrt
print(wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "brute_force").closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t)
"""


def run(*arguments: str, path: Path = ROOT, **options) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(path)} | options.pop("env", {})
    return subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=300, **options)


def check_silent(done: subprocess.CompletedProcess[str]) -> None:
    assert (done.returncode, done.stdout, without_compiling(done.stderr)) == (0, "[0.33333334]\n", "")


def test_after_a_power_cut_a_process_is_right_and_silent(tmp_path: Path):
    """LLVM would crash on an object of zeros."""
    environment = {"WARP_CACHE_PATH": str(tmp_path)}
    check_silent(run("-X", "dev", "-W", "error", "-c", QUERY, env=environment))
    for path in tmp_path.rglob("*.*"):
        if path.is_file():
            path.write_bytes(bytes(path.stat().st_size))
    check_silent(run("-c", QUERY, env=environment))
    check_silent(run("-c", QUERY, env=environment))
    assert len(list(tmp_path.glob("*/precompiled-*"))) == 1


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


def test_in_a_zip_file_the_import_says_what_to_do(tmp_path: Path):
    archive = tmp_path / "wrt.zip"
    with zipfile.ZipFile(archive, "w") as zipped:
        for path in ("wrt/__init__.py", "wrt/core/__init__.py", "wrt/core/version.py"):
            zipped.write(ROOT / path, path)
    done = run("-c", "import wrt", path=archive, cwd=tmp_path)
    assert done.returncode == 1 and done.stderr.splitlines()[-1].startswith("ImportError: wrt cannot be imported from a zip file")
