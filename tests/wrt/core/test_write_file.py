"""Files are whole and on the disk; what a killed process leaves of them is removed, and nothing else."""

from __future__ import annotations

import contextlib
import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.data import ROOT
from tests.wrt.renderer.test_checkpoint import SCENE, same
from wrt.accel.build import build, build_cached
from wrt.core import write_file
from wrt.core.errors import InputError
from wrt.core.write_file import LONG_AGO, aside, check_writable, remove_leftovers, replacing, this_system
from wrt.lab.bench import timing
from wrt.picture.image import write_codes, write_image
from wrt.renderer import checkpoint
from wrt.renderer.animate import save_movie
from wrt.renderer.render import render
from wrt.scene.shapes import icosphere

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
PIXELS = np.full((4, 6, 3), 0.5, np.float32)
linux_only = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="looks at files by /proc")
with_locks = pytest.mark.skipif(write_file.fcntl is None, reason="without locks nothing is removed")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# --- on the disk ------------------------------------------------------------------------------------------------------


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """What is brought to the disk, renamed and removed, in order."""
    made: list[tuple[str, str]] = []

    def recorded(name: str, told: Callable[..., str]) -> None:
        original = getattr(os, name)

        def call(*arguments: Any, **rest: Any) -> Any:
            made.append((name, told(*arguments)))
            return original(*arguments, **rest)

        monkeypatch.setattr(os, name, call)

    recorded("fsync", lambda descriptor: os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}")))
    recorded("replace", lambda source, target: os.path.basename(target))
    recorded("unlink", lambda path, **rest: os.path.basename(path))
    return made


@linux_only
def test_a_picture_is_on_the_disk_before_its_checkpoint_goes(calls: list[tuple[str, str]], tmp_path: Path,
                                                             monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("box.obj").write_text(BOX_OBJ)
    done = command("render", "box.obj", "--size", "16x9", "--spp", 1, "--aov", "depth", "-o", "a.png", "--checkpoint", "60s")
    assert done.code == 0, done.err
    begin = calls.index(("replace", "a.png"))
    written = [(name, "(aside)" if told.startswith(".wrt-") else told) for name, told in calls[begin - 1:]]
    folder = ("fsync", tmp_path.name)
    pictures = [call for call in written if call != ("unlink", "(aside)")]
    assert pictures == [("fsync", "(aside)"), ("replace", "a.png"), folder, ("fsync", "(aside)"), ("replace", "a.depth.png"),
                        folder, ("unlink", "a.png.checkpoint")]
    saved = calls.index(("replace", "a.png.checkpoint"))
    assert calls[saved - 1] == ("fsync", ".a.png.checkpoint.part") and calls[saved + 1] == folder and saved < begin


@linux_only
@pytest.mark.parametrize(("name", "write"), [
    ("a.png", lambda path: write_image(path, PIXELS)), ("a.exr", lambda path: write_image(path, PIXELS)),
    ("a.hdr", lambda path: write_image(path, PIXELS)), ("a.accel", lambda path: build(icosphere(0)).save(path)),
    ("a.gif", lambda path: save_movie(path, [np.zeros((4, 4, 3), np.uint8)] * 2, 10.0)),
])
def test_every_file_is_brought_to_the_disk(name: str, write: Callable[[Path], None], tmp_path: Path,
                                           calls: list[tuple[str, str]]) -> None:
    write(tmp_path / name)
    at = calls.index(("replace", name))
    assert calls[at - 1][0] == calls[at + 1][0] == "fsync" and calls[at - 1][1].startswith(".wrt-")
    assert calls[at + 1][1] == tmp_path.name and names(tmp_path) == {name} and (tmp_path / name).stat().st_size > 20


@pytest.mark.parametrize(("number", "fine"), [(errno.EIO, False), (errno.ENOSPC, False), (errno.EINVAL, True)])
def test_a_disk_that_does_not_take_a_picture_is_told(number: int, fine: bool, tmp_path: Path,
                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    """That a file system cannot sync folders is none of its errors."""
    fsync = os.fsync

    def failing(descriptor: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", failing)
    with contextlib.nullcontext() if fine else pytest.raises(InputError, match=f"a.png: cannot be written: {os.strerror(number)}"):
        write_codes(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))


# --- what the system refuses ------------------------------------------------------------------------------------------


def refuse(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """No file can be made in a folder, or be removed from it: permissions do not bind the superuser, as which tests may run."""
    open_file, unlink = os.open, os.unlink

    def refused(path: Any, *arguments: Any, **rest: Any) -> Any:
        if isinstance(path, str | Path) and Path(path).parent == folder and (not arguments or arguments[0] & os.O_CREAT):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), path)
        return (open_file if arguments else unlink)(path, *arguments, **rest)

    monkeypatch.setattr(os, "open", refused)
    monkeypatch.setattr(os, "unlink", refused)


@pytest.mark.parametrize(("name", "write"), [
    ("a.png", lambda path: wrt.Film(PIXELS, PIXELS, np.ones((4, 6), np.int32)).save(path)),
    ("a.exr", lambda path: wrt.Film(PIXELS, PIXELS, np.ones((4, 6), np.int32)).save(path)),
    ("a.accel", lambda path: build(icosphere(0)).save(path)), ("a.hdr", check_writable),
    ("a.gif", lambda path: save_movie(path, [np.zeros((4, 4, 3), np.uint8)] * 2, 10.0)),
])
def test_a_read_only_folder_is_told_with_the_name_that_somebody_gave(name: str, write: Callable[[Path], None], tmp_path: Path,
                                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(monkeypatch, tmp_path)
    with pytest.raises(InputError) as caught:
        write(tmp_path / name)
    assert str(caught.value) == f"{tmp_path / name}: cannot be written: Read-only file system"


def test_on_the_command_line_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("box.obj").write_text(BOX_OBJ)
    Path("frames").mkdir()
    refuse(monkeypatch, tmp_path)
    refused = "cannot be written: Read-only file system"
    assert command("render", "box.obj", "-o", "a.png").errors == [f"error: a.png: {refused}"]
    assert command("render", "box.obj", "-o", "./b.exr", "--aov", "depth").errors == [f"error: b.exr: {refused}"]
    assert command("build", "box.obj", "-o", "a.accel").errors == [f"error: a.accel: {refused}"]
    refuse(monkeypatch, tmp_path / "frames")
    monkeypatch.setattr("wrt.renderer.animate.animate", lambda *arguments: pytest.fail("the work began"))
    assert command("animate", "box.obj", "-o", "frames").errors == [f"error: frames/frame_000.png: {refused}"]
    monkeypatch.undo()
    assert names(tmp_path) == {"box.obj", "frames"}


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a file system that takes no files from anybody")
def test_a_disk_that_becomes_read_only_in_the_middle_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=rf"^{tmp_path / 'a.png'}: cannot be written: Read-only file system$"), \
            replacing(tmp_path / "a.png") as temporary:
        temporary.write_bytes(b"half")
        refuse(monkeypatch, tmp_path)
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(temporary))
    with pytest.raises(InputError, match=r"^/proc/a\.exr: cannot be written: "):
        write_image("/proc/a.exr", PIXELS)
    with pytest.raises(InputError, match=r"^/proc/nowhere: cannot be made: No such file or directory$"):
        build_cached("/proc/nowhere", icosphere(0))


def test_a_damaged_entry_of_a_cache_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build_cached(tmp_path, icosphere(0), "bvh2")
    (entry,) = tmp_path.iterdir()
    entry.write_bytes(b"half")
    refuse(monkeypatch, tmp_path)
    with pytest.raises(InputError, match=rf"^{entry}: cannot be written: Read-only file system$"):
        build_cached(tmp_path, icosphere(0), "bvh2")


# --- what killed processes leave --------------------------------------------------------------------------------------

WRITING = """
import sys, time
from wrt.core.write_file import replacing
with replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    print(temporary.name, flush=True)
    time.sleep(600)
"""
SAVING = """
import sys, time, wrt
from tests.wrt.renderer.test_checkpoint import SCENE
def wait(progress):
    if progress.stage == "trace":  # before it there is no part
        print("runs", flush=True)
        time.sleep(600)
wrt.render(SCENE, checkpoint=sys.argv[1], checkpoint_every=float(sys.argv[2]), progress=wait)
"""
COMPILING = """
import numpy as np, wrt
wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "brute_force").closest_hit(np.zeros((1, 3)), np.ones((1, 3)))
"""


@contextlib.contextmanager
def running(program: str, *arguments: object, **environment: str) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen([sys.executable, "-c", program, *map(str, arguments)], env={**ENVIRONMENT, **environment}, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def told(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@with_locks
def test_what_a_killed_process_was_writing_is_removed_by_the_next_one(tmp_path: Path) -> None:
    with running(WRITING, tmp_path / "a.png") as killed, running(WRITING, tmp_path / "b.png") as other:
        left, writing = told(killed), told(other)
        killed.kill()
        killed.wait()
        assert names(tmp_path) == {left, writing}
        write_codes(tmp_path / "c.png", np.zeros((2, 2, 3), np.uint8))
        assert names(tmp_path) == {writing, "c.png"}  # who writes still is left alone


def left_by(system: str, folder: Path, age: float, suffix: str = ".exr") -> Path:
    path = folder / f".wrt-{system}-0123456789abcdef{suffix}"
    path.write_bytes(b"half")
    os.utime(path, (time.time() - age,) * 2)
    return path


@with_locks
def test_of_other_systems_only_what_is_old_is_removed(tmp_path: Path) -> None:
    young, old = left_by("0" * 16, tmp_path, 0.9 * LONG_AGO), left_by("1" * 16, tmp_path, 1.1 * LONG_AGO)
    locked = left_by("2" * 16, tmp_path, 1.1 * LONG_AGO)
    with open(locked, "rb+") as file:
        assert write_file.try_lock(file.fileno())
        remove_leftovers(tmp_path)
    assert young.exists() and locked.exists() and not old.exists()


@with_locks
def test_nothing_of_a_stranger_s_is_removed(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    kept = outside / f".wrt-{this_system()}-0123456789abcdef.exr"
    kept.write_bytes(b"somebody's")
    folder = tmp_path / "folder"
    folder.mkdir()
    ours = f".wrt-{this_system()}-"
    for name in (".d1d8d1d8d1d8d1d8d1d8d1d8d1d8d1d8.exr", ".wrt-notes", ours, ours + "0123456789abcdef0.exr",
                 ours.upper() + "0" * 16, "x" + ours + "0123456789abcdef.exr", ".film.part",
                 ".a.checkpoint.part", "wp_closest_hit_0a1b2c3d_p1_t2"):
        (folder / name).write_bytes(b"somebody's")
    (folder / ".b.part").write_bytes(checkpoint.MAGIC + b"{}\n")
    (folder / (ours + "0123456789abcde1.exr")).symlink_to(kept)
    (folder / (ours + "0123456789abcde2.exr")).mkdir()
    os.mkfifo(folder / (ours + "0123456789abcde3.exr"))
    for i, name in enumerate(("../outside", "/", str(outside), "wp_a_p1_t2/../../outside", "", "wp_\0_p1_t2")):
        (folder / f"{ours}012345678900000{i}.compiling").write_text(name)  # which goes, but takes nothing with it
    before = names(folder)
    remove_leftovers(folder)
    assert {name for name in before - names(folder)} == {f"{ours}012345678900000{i}.compiling" for i in range(6)}
    assert names(outside) == {kept.name}


@with_locks
def test_a_file_that_is_removed_before_it_is_locked_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By somebody who takes it for a leftover: its maker has made it, and has no lock yet."""
    open_file, removed = os.open, []

    def slow(path: Any, *arguments: Any, **rest: Any) -> int:
        descriptor = open_file(path, *arguments, **rest)
        if arguments[0] & os.O_EXCL and len(removed) < 3:
            removed.append(path)
            Path(path).unlink()
        return descriptor

    monkeypatch.setattr(os, "open", slow)
    with aside(tmp_path) as path:
        assert path.exists() and len(removed) == 3 and path not in removed


@with_locks
@pytest.mark.parametrize("every", [600.0, 1e-9], ids=["reserved", "written"])
def test_the_part_of_a_killed_render_is_removed_by_others(every: float, tmp_path: Path) -> None:
    """By whoever writes there, whatever its own name: nobody may ever resume it."""
    with running(SAVING, tmp_path / "a", every) as killed, running(SAVING, tmp_path / "b", every) as other:
        assert told(killed) == told(other) == "runs"
        assert {".a.part", ".b.part"} <= names(tmp_path)
        killed.kill()
        killed.wait()
        before = names(tmp_path)
        write_codes(tmp_path / "c.png", np.zeros((2, 2, 3), np.uint8))
        assert names(tmp_path) == before - {".a.part"} | {"c.png"}
    write_file._cleaned.discard(tmp_path)
    film = render(SCENE, checkpoint=tmp_path / "a", resume=True, device="cpu")  # as the processes' own
    assert same(film, render(SCENE, device="cpu")) and ".b.part" not in names(tmp_path)


@with_locks
def test_what_a_kill_leaves_in_the_kernel_cache_is_removed(tmp_path: Path) -> None:
    def compilations() -> list[Path]:
        return list(tmp_path.glob("*/wp_*_p*_t*"))

    with running(COMPILING, WARP_CACHE_PATH=str(tmp_path)) as killed:
        while not compilations() and killed.poll() is None:
            time.sleep(0.01)
        assert killed.poll() is None, killed.communicate()
        killed.kill()
    (left,) = compilations()
    stranger = left.with_name("wp_closest_hit_0a1b2c3d_p1_t2")
    stranger.mkdir()  # of a Warp program without wrt, which says nothing of it
    with running(COMPILING, WARP_CACHE_PATH=str(tmp_path)) as next_one:
        assert next_one.wait() == 0, next_one.communicate()
    assert compilations() == [stranger] and not list(tmp_path.glob("*/.wrt-*"))
    assert list(tmp_path.glob("*/wp_*/*.o"))


# --- Windows ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """As far as wrt can tell: no file that is open is renamed, replaced or removed, no folder is opened, nothing is locked."""

    def check(path: Any) -> None:
        for descriptor in os.listdir("/proc/self/fd"):
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.stat(f"/proc/self/fd/{descriptor}"), os.stat(path)):
                    raise PermissionError(errno.EACCES, "The process cannot access the file", path)

    def guarded(name: str) -> None:
        original = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *paths, **rest: ([check(path) for path in paths], original(*paths, **rest))[1])

    for name in ("replace", "rename", "unlink", "remove"):
        guarded(name)
    open_file = os.open

    def opened(path: Any, *arguments: Any, **rest: Any) -> int:
        if os.path.isdir(path) and "dir_fd" not in rest:
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return open_file(path, *arguments, **rest)

    monkeypatch.setattr(os, "open", opened)
    monkeypatch.delattr(os, "posix_fallocate", raising=False)
    monkeypatch.setattr(write_file, "fcntl", None)
    for module in (write_file, checkpoint):
        monkeypatch.setattr(module, "WINDOWS", True)


@linux_only
@pytest.mark.usefixtures("windows")
def test_checkpoints_and_pictures_on_windows(tmp_path: Path) -> None:
    path = tmp_path / "a.checkpoint"

    def stop(progress: wrt.Progress) -> None:
        if progress.done > progress.total // 3:
            raise KeyboardInterrupt

    first = render(SCENE, checkpoint=path, checkpoint_every=1e-9, progress=stop)  # a warning is an error: none of them failed
    assert first.stats["checkpoint"] == str(path) and names(tmp_path) == {path.name}
    film = render(SCENE, checkpoint=path, checkpoint_every=1e-9, resume=True)
    assert film.stats["resumed"] and film.stats["checkpoint"] == str(path) and names(tmp_path) == {path.name}
    for name in ("a.png", "a.exr", "a.hdr"):
        film.save(tmp_path / name)
        film.save(tmp_path / name)  # over what is there
    build(icosphere(0)).save(tmp_path / "a.accel")
    assert names(tmp_path) == {path.name, "a.png", "a.exr", "a.hdr", "a.accel"}


@linux_only
@pytest.mark.usefixtures("windows")
def test_windows_here_is_as_strict_as_windows(tmp_path: Path) -> None:
    with open(tmp_path / "a", "wb"):
        for refused in (lambda: os.replace(tmp_path / "a", tmp_path / "b"), (tmp_path / "a").unlink, lambda: os.open(tmp_path, 0)):
            with pytest.raises(PermissionError):
                refused()


def test_memory_is_measured_where_there_is_no_c_library_without_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_name(name: Any) -> Any:
        raise TypeError("argument of type 'NoneType' is not iterable")  # as on Windows

    monkeypatch.setattr(timing.ctypes, "CDLL", no_name)
    assert timing.peak_bytes(lambda: 7)[0] == 7
