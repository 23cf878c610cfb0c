"""Files are complete and on the disk, no link is followed, and a killed process leaves one file with a known name."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.data import ROOT
from tests.refused import refused
from tests.wrt.renderer.test_checkpoint import SCENE
from wrt.accel.scenes.build import build
from wrt.cli.reporting import Reporting
from wrt.core.write_file import check_writable, replacing
from wrt.lab.bench import timing
from wrt.picture.image import write_codes, write_image
from wrt.renderer.animate import save_movie
from wrt.renderer.render import render
from wrt.scene.shapes import icosphere

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
PIXELS = np.full((4, 6, 3), 0.5, np.float32)
linux_only = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="looks at files by /proc")
WRITERS = {
    "a.png": lambda path: write_image(path, PIXELS), "a.exr": lambda path: write_image(path, PIXELS),
    "a.hdr": lambda path: write_image(path, PIXELS), "a.accel": lambda path: build(icosphere(0)).save(path),
    "a.gif": lambda path: save_movie(path, [np.zeros((4, 4, 3), np.uint8)] * 2, 10.0),
    "a.md": lambda path: Reporting(output=path).write("text" * 10),
    "a.checkpoint": lambda path: render(SCENE, spp=1, checkpoint=path, resume=True),
}
each_writer = pytest.mark.parametrize(("name", "write"), WRITERS.items())


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# --- on the disk ------------------------------------------------------------------------------------------------------


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Record which files are synced, renamed and removed, in order."""
    made: list[tuple[str, str]] = []

    def recorded(name: str, file_name: Callable[..., str]) -> None:
        original = getattr(os, name)

        def call(*arguments: Any, **rest: Any) -> Any:
            made.append((name, file_name(*arguments)))
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
    written = [(name, "(temporary)" if told.startswith(".wrt-") else told) for name, told in calls]
    synced, folder = ("fsync", "(temporary)"), ("fsync", tmp_path.name)
    pictures = [call for call in written[begin - 1:] if call != ("unlink", "(temporary)")]
    assert pictures == [synced, ("replace", "a.png"), folder, synced, ("replace", "a.depth.png"), folder,
                        ("unlink", "a.png.checkpoint")]
    saved = calls.index(("replace", "a.png.checkpoint"))
    assert written[saved - 1] == synced and written[saved + 1] == folder and saved < begin


@linux_only
@each_writer
def test_every_file_is_brought_to_the_disk(name: str, write: Callable[[Path], None], tmp_path: Path,
                                           calls: list[tuple[str, str]]) -> None:
    write(tmp_path / name)
    at = calls.index(("replace", name))
    assert calls[at - 1][0] == calls[at + 1][0] == "fsync" and calls[at - 1][1].startswith(".wrt-")
    assert calls[at + 1][1] == tmp_path.name and names(tmp_path) == {name} and (tmp_path / name).stat().st_size > 20


@linux_only
@each_writer
def test_into_a_folder_whose_name_is_no_utf_8(name: str, write: Callable[[Path], None], tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"b\xff")
    folder.mkdir()
    write(folder / name)
    assert names(folder) == {name}


@pytest.mark.parametrize(("number", "fine"), [(errno.EIO, False), (errno.ENOSPC, False), (errno.EINVAL, True)])
def test_a_disk_that_does_not_take_a_picture_is_reported(number: int, fine: bool, tmp_path: Path,
                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system that cannot sync folders is no error."""
    fsync = os.fsync

    def failing(descriptor: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", failing)
    with contextlib.nullcontext() if fine else refused(None, os.strerror(number), path="a.png"):
        write_codes(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))


# --- what the system refuses ------------------------------------------------------------------------------------------


def refuse(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """No file can be made in a folder, or be removed from it: permissions do not bind the superuser, as which tests may run."""
    open_file, unlink = open, os.unlink

    def refused(path: Any, mode: str = "r", *arguments: Any, **rest: Any) -> Any:
        if isinstance(path, str | Path) and Path(path).parent == folder and mode[0] in "wx":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), path)
        return open_file(path, mode, *arguments, **rest)

    def kept(path: Any, **rest: Any) -> None:
        if Path(path).parent == folder:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), path)
        unlink(path, **rest)

    monkeypatch.setattr("builtins.open", refused)
    monkeypatch.setattr(os, "unlink", kept)


@pytest.mark.parametrize(("name", "write"), [*WRITERS.items(), ("b.hdr", check_writable)])
def test_a_read_only_folder_is_reported_by_the_given_name(name: str, write: Callable[[Path], None], tmp_path: Path,
                                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(monkeypatch, tmp_path)
    with refused(None, "Read-only file system", path=tmp_path / name):
        write(tmp_path / name)


@pytest.mark.parametrize("odd", ["a\0b", "\ud800"])
@pytest.mark.parametrize(("name", "write"), [*WRITERS.items(), ("b.hdr", check_writable)])
def test_a_name_that_no_system_takes_is_reported(name: str, write: Callable[[Path], None], odd: str, tmp_path: Path) -> None:
    with refused(what="written"):
        write(tmp_path / f"{odd}{name}")
    assert not names(tmp_path)


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
    with refused(None, "Read-only file system", path=tmp_path / "a.png"), replacing(tmp_path / "a.png") as file:
        file.write(b"half")
        refuse(monkeypatch, tmp_path)
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), file.name)
    with refused(what="written", path="a.exr"):
        write_image("/proc/a.exr", PIXELS)


def test_a_structure_for_a_folder_that_cannot_be_written_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (entry := tmp_path / "a.accel").write_bytes(b"before")
    refuse(monkeypatch, tmp_path)
    with refused(None, "Read-only file system", path=entry):
        build(icosphere(0), "bvh2").save(entry)
    assert entry.read_bytes() == b"before"


# --- links --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def diary(tmp_path: Path) -> Iterator[Path]:
    """A file of the user outside of the written folder. At the end it must be unchanged, and no file beside it."""
    home = tmp_path / "home"
    home.mkdir()
    (home / "diary.txt").write_text("my diary")
    yield home / "diary.txt"
    assert (home / "diary.txt").read_text() == "my diary" and names(home) == {"diary.txt"}


@pytest.mark.parametrize("target", ["diary.txt", "new.txt", "loop.png"])
@pytest.mark.parametrize("name", [name for name in WRITERS if name != "a.checkpoint"])
def test_a_link_is_replaced_and_not_followed(name: str, target: str, diary: Path, tmp_path: Path) -> None:
    path = tmp_path / name
    path.symlink_to(path if target == "loop.png" else diary.with_name(target))
    WRITERS[name](path)
    assert path.is_file() and not path.is_symlink() and names(tmp_path) == {"home", name}


def test_nor_is_one_of_the_names_that_wrt_makes(diary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a shared folder, another user can put links there before a render."""
    folder = tmp_path / "folder"
    (folder / "frames").mkdir(parents=True)
    (folder / "report").mkdir()
    monkeypatch.chdir(folder)
    Path("box.obj").write_text(BOX_OBJ)
    links = [".box.png.checkpoint.part", "box.png", "box.depth.png", "frames/frame_000.png", "report/profile.md",
             "report/counters.exr", "report/histograms.png", "report/nodes.png"]
    for link in links:
        Path(link).symlink_to(diary)
    small = ("--size", "16x9", "--spp", 1)
    assert command("render", "box.obj", *small, "--aov", "depth", "--checkpoint", "1s").code == 0
    assert command("animate", "box.obj", *small, "--frames", 2, "-o", "frames").code == 0
    assert command("profile", "box.obj", *small, "-o", "report").code == 0
    assert [link for link in links if Path(link).is_symlink()] == [links[0]]  # nothing is written to it


def test_a_checkpoint_follows_no_link(diary: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.checkpoint"
    path.symlink_to(diary.with_name("new.txt"))
    with refused(what="exists already"):
        render(SCENE, spp=1, checkpoint=path)
    path.unlink()

    def link(progress: wrt.Progress) -> None:
        path.unlink(missing_ok=True)
        path.symlink_to(diary)

    render(SCENE, spp=2, checkpoint=path, checkpoint_every=1e-9, progress=link)
    assert path.is_file() and not path.is_symlink()


@linux_only
@pytest.mark.parametrize("suffix", [".png", ".exr", ".hdr"])
def test_nor_does_a_temporary_file_that_is_exchanged_for_a_link(suffix: str, diary: Path, tmp_path: Path,
                                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    """Another user who may rename files in the folder does so right after the file is made."""
    open_file = open

    def exchanged(path: Any, mode: str = "r", *arguments: Any, **rest: Any) -> Any:
        file = open_file(path, mode, *arguments, **rest)
        if mode == "x+b":
            os.unlink(path)
            os.symlink(diary, path)
        return file

    monkeypatch.setattr("builtins.open", exchanged)
    write_image(tmp_path / f"a{suffix}", PIXELS)


# --- what a killed process leaves -------------------------------------------------------------------------------------

WRITING = """
import os, signal, sys
from wrt.core.write_file import replacing
with replacing(sys.argv[1]) as file:
    file.write(bytes(100_000))
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_process_leaves_the_old_file_and_one_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"old")
    killed = subprocess.run([sys.executable, "-c", WRITING, tmp_path / "a.png"], env=ENVIRONMENT, check=False)
    assert killed.returncode < 0 and (tmp_path / "a.png").read_bytes() == b"old"
    (left,) = names(tmp_path) - {"a.png"}
    assert re.fullmatch(r"\.wrt-[0-9a-f]{32}\.png", left)  # as docs/long_renders.md says
    write_codes(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    assert names(tmp_path) == {"a.png", left}


# --- Windows ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Imitate Windows: no open file is renamed, replaced or removed, and no folder is opened."""

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
        film.save(tmp_path / name)  # over an existing file
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
