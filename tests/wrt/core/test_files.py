"""Files: only regular ones are read, a path always holds a complete file, and no link is followed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.data import ROOT
from tests.refused import refused
from tests.wrt.renderer.test_checkpoint import SCENE
from wrt.accel.scenes.build import build, load_accel
from wrt.core.errors import InputError
from wrt.core.files import check_writable, read_file, replacing, write_bytes
from wrt.io.load import load_scene
from wrt.picture.image import read_image, write_codes, write_image
from wrt.renderer.animate import save_movie
from wrt.renderer.checkpoint import read
from wrt.renderer.render import render
from wrt.scene.shapes import icosphere

PIXELS = np.full((4, 6, 3), 0.5, np.float32)
WRITERS = {
    "a.png": lambda path: write_image(path, PIXELS), "a.exr": lambda path: write_image(path, PIXELS),
    "a.hdr": lambda path: write_image(path, PIXELS), "a.accel": lambda path: build(icosphere(0)).save(path),
    "a.gif": lambda path: save_movie(path, [np.zeros((4, 4, 3), np.uint8)] * 2, 10.0),
    "a.md": lambda path: write_bytes(path, b"text" * 10),
    "a.checkpoint": lambda path: render(SCENE, spp=1, checkpoint=path, resume=True),
}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# --- reading ------------------------------------------------------------------------------------------------------------


def test_bytes_come_whole(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\0\1\r\n" * 1000)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert read_file(tmp_path / "a") == read_file(tmp_path / "link") == b"\0\1\r\n" * 1000 and read_file(tmp_path / "a", 3) == b"\0\1\r"


@pytest.mark.parametrize("path", ["/dev/zero", ".", "a\0b", "nowhere", "x" * 5000, "/proc/self/mem/x"])
def test_what_is_no_file(path: str) -> None:
    with refused(what="cannot be read"):
        read_file(path)


@pytest.mark.parametrize("suffix", [".toml", ".gltf", ".obj", ".ply", ".exr", ".png", ".accel", ".checkpoint"])
def test_no_reader_waits_for_a_pipe(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"pipe{suffix}"
    os.mkfifo(path)
    readers = {".accel": lambda path: load_accel(path, icosphere(0)), ".checkpoint": read, ".exr": read_image, ".png": read_image}
    with refused(None, "no regular file", path=path):
        readers.get(suffix, load_scene)(path)


# --- writing ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_is_written_and_nothing_beside_it(name: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path / name)
    assert names(tmp_path) == {name} and (tmp_path / name).stat().st_size > 20


@pytest.mark.parametrize(("name", "write"), [*WRITERS.items(), ("b.hdr", check_writable)])
def test_what_the_system_refuses_is_one_message(name: str, write: Callable[[Path], object], tmp_path: Path) -> None:
    for odd in ("a\0b", "\ud800"):
        with refused(what="cannot be written"):
            write(tmp_path / f"{odd}{name}")
    (tmp_path / name).mkdir()
    with refused(what="is a folder", path=tmp_path / name):
        write(tmp_path / name)
    with refused(what="its folder does not exist", path=tmp_path / "none" / name):
        write(tmp_path / "none" / name)
    assert names(tmp_path) == {name}


def test_an_error_in_the_middle_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    for error, told in ((OSError("full"), InputError), (KeyError("x"), KeyError), (InputError("y"), InputError)):
        with pytest.raises(told), replacing(path) as file:
            file.write(b"half")
            raise error
        assert path.read_bytes() == b"old" and names(tmp_path) == {"a.png"}


@pytest.mark.parametrize("target", ["diary.txt", "new.txt", "loop"])
@pytest.mark.parametrize("name", [name for name in WRITERS if name != "a.checkpoint"])
def test_a_link_is_replaced_and_not_followed(name: str, target: str, tmp_path: Path) -> None:
    path, home = tmp_path / name, tmp_path / "home"
    home.mkdir()
    (home / "diary.txt").write_text("my diary")
    path.symlink_to(path if target == "loop" else home / target)
    WRITERS[name](path)
    assert path.is_file() and not path.is_symlink() and names(tmp_path) == {"home", name}
    assert (home / "diary.txt").read_text() == "my diary" and names(home) == {"diary.txt"}


WRITING = """
import os, signal, sys
from wrt.core.files import replacing
with replacing(sys.argv[1]) as file:
    file.write(bytes(100_000))
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_process_leaves_the_old_file_and_one_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"old")
    killed = subprocess.run([sys.executable, "-c", WRITING, tmp_path / "a.png"], env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    assert killed.returncode < 0 and (tmp_path / "a.png").read_bytes() == b"old"
    (left,) = names(tmp_path) - {"a.png"}
    assert re.fullmatch(r"\.wrt-[0-9a-f]{32}\.png", left)  # as docs/long_renders.md says
    write_codes(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    assert names(tmp_path) == {"a.png", left}
