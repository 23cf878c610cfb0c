"""The kernel cache: after any damage, a kernel gives the right answer, or one message says what is wrong."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command_line import without_compiling
from tests.data import ROOT

from tests.kernel_tools import cpu_only, launch, zeros  # isort: skip
import warp as wp

from wrt.core import device, kernel_cache
from wrt.core.device import load_kernel, start
from wrt.core.errors import InputError
from wrt.kernels.structs import kernel

pytestmark = cpu_only


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


def zero_blocks(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for first in range(0, len(data), 1536):
        data[first : first + 512] = bytes(len(data[first : first + 512]))
    path.write_bytes(data)


def flip_one_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def replaced_by(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        remove(path)
        make(path)

    return damage


def elsewhere(path: Path) -> None:
    moved = path.with_name(f"{path.name}.moved")
    path.rename(moved)
    path.symlink_to(moved)


DAMAGE = {
    "empty": cut(lambda size: 0), "3 bytes": cut(lambda size: 3), "100 bytes": cut(lambda size: min(size, 100)),
    "half": cut(lambda size: size // 2), "without its last byte": cut(lambda size: size - 1),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)), "zeroed blocks": zero_blocks, "one bit": flip_one_bit,
    "removed": remove, "a folder": replaced_by(Path.mkdir), "a file": replaced_by(Path.touch), "a pipe": replaced_by(os.mkfifo),
    "a link to nothing": replaced_by(lambda path: path.symlink_to("nothing")),
    "a link to itself": replaced_by(lambda path: path.symlink_to(path)), "moved, with a link": elsewhere,
    "locked": lambda path: path.chmod(0),
    "of 1971": lambda path: os.utime(path, (4e7, 4e7)), "of 2035": lambda path: os.utime(path, (2e9, 2e9)),
}
OF_FOLDERS = ("removed", "a link to nothing", "a link to itself", "a file", "a pipe", "moved, with a link", "of 1971", "of 2035")


@pytest.mark.skipif(os.name == "nt", reason="makes links and pipes as POSIX does")
@pytest.mark.parametrize(("what", "damage"), [(what, damage) for what in ("*.o", "*.meta", "*.cpp") for damage in DAMAGE]
                         + [(".", damage) for damage in OF_FOLDERS])
def test_a_damaged_file_is_compiled_again_once(what: str, damage: str, filled: Path, cache: Path,
                                                   capfd: pytest.CaptureFixture[str]):
    shutil.copytree(filled, cache)
    assert answer() == RIGHT
    (folder,) = cache.glob("wp_*")
    (path,) = folder.glob(what) if what != "." else (folder,)
    DAMAGE[damage](path)
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


def test_a_removed_cache_is_made_again(cache: Path):
    assert answer() == RIGHT
    shutil.rmtree(cache.parent)
    assert answer() == RIGHT


def test_leftovers_of_killed_processes_are_removed_after_a_day(cache: Path, monkeypatch: pytest.MonkeyPatch):
    names = ("precompiled-1.19.0-Linux-x86_64-9e3c5285", "precompiled-abc", "wp_x_0123abc_p12_t345", "wp_x_p1_t2_0123abc", "lto")
    for day in ("old", "new"):
        for name in names:
            (cache / f"{name}{'' if day == 'old' else '9'}" / "content").mkdir(parents=True)
    for name in names:
        os.utime(cache / name, (1.6e9, 1.6e9))
    (cache / "precompiled-link").symlink_to(cache / "lto")
    monkeypatch.setattr(kernel_cache, "_checked", set())
    assert answer() == RIGHT
    left = {path.name for path in cache.iterdir()}
    assert not left & set(names[:3]) and left >= {*names[3:], *(f"{name}9" for name in names)}
    assert (cache / "lto" / "content").is_dir()


# --- as processes ---------------------------------------------------------------------------------------------------------


QUERY = """
import numpy as np, wrt
print(wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "brute_force").closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t)
"""
ANSWER = "[0.33333334]\n"


def run(*arguments: str, python: str = sys.executable, path: Path = ROOT, **options) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(path)} | options.pop("env", {})
    return subprocess.run([python, *arguments], env=environment, capture_output=True, text=True, timeout=300, **options)


def check_silent(done: subprocess.CompletedProcess[str]) -> None:
    assert (done.returncode, done.stdout, without_compiling(done.stderr)) == (0, ANSWER, "")


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


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes")
def test_a_name_that_is_not_utf8_is_one_message(tmp_path: Path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    done = run("-m", "wrt", "render", "a.obj", "--spp", "1", "--size", "8x8", cwd=tmp_path,
               env={"WARP_CACHE_PATH": os.fsdecode(bytes(tmp_path) + b"/c\xff")})
    assert (done.returncode, done.stdout, done.stderr.count("error: ")) == (2, "", 1)
    assert done.stderr.endswith(": kernels cannot be compiled: its name is not UTF-8; set WARP_CACHE_PATH to another folder\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="has no /dev/full")
def test_a_full_disk_under_stderr_does_no_harm(tmp_path: Path):
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", QUERY], stdout=subprocess.PIPE, stderr=full, text=True, timeout=300,
                              env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert (done.returncode, done.stdout) == (0, ANSWER)


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
