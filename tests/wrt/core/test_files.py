"""Only regular files are read. Others are refused at once, because pipes and devices may have no end."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.fuzz.seeds import scenes, side_files
from tests.gltf_files import one_triangle
from tests.refused import refused
from wrt.accel.scenes.build import load_accel
from wrt.core.errors import InputError
from wrt.core.files import read_file
from wrt.io.load import load_scene
from wrt.picture.image import read_image
from wrt.renderer.checkpoint import read
from wrt.scene.shapes import icosphere


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_bytes_come_whole(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\0\1\r\n" * 1000)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert read_file(tmp_path / "a") == read_file(tmp_path / "link") == b"\0\1\r\n" * 1000


@pytest.mark.parametrize(("path", "message"), [
    ("/dev/zero", "no regular file"), ("/dev/null", "no regular file"), (".", "Is a directory"), ("a\0b", "embedded null"),
    ("nowhere", "No such file"), ("x" * 5000, "name too long"), ("/proc/self/mem/x", "Not a directory"),
])
def test_what_is_no_file(path: str, message: str) -> None:
    with refused(None, message):
        read_file(path)


@pytest.mark.parametrize("suffix", [".toml", ".obj", ".ply"])
def test_a_name_too_long_for_the_system(suffix: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(f"materials.m = {{}}\n[[meshes]]\nmaterial = 'm'\nfile = '{'box.obj' * 1000}{suffix}'")
    with refused(None, "no mesh file" if suffix == ".toml" else "name too long"):
        load_scene(tmp_path / "a.toml")
    with refused(what="name too long"):
        load_scene(tmp_path / f"{'x' * 5000}{suffix}")


@pytest.mark.parametrize("suffix", [".toml", ".gltf", ".glb", ".obj", ".ply", ".stl", ".exr", ".hdr", ".png", ".accel",
                                    ".checkpoint"])
def test_no_reader_waits_for_a_pipe(suffix: str, pipe: Path) -> None:
    path = pipe.rename(pipe.with_suffix(suffix))
    readers = {".accel": lambda path: load_accel(path, icosphere(0)), ".checkpoint": read}
    readers |= dict.fromkeys((".exr", ".hdr", ".png"), read_image)
    with refused(None, "no regular file", path=path):
        readers.get(suffix, load_scene)(path)


@pytest.mark.parametrize("name", ["pipe", "/dev/zero", "a\\u0000b", "a.png/x"])
@pytest.mark.parametrize("old", ['file = "sky.hdr"', 'file = "a.png"', 'file = "box.obj"'])
def test_nor_does_a_scene_that_names_one(old: str, name: str, pipe: Path, tmp_path: Path) -> None:
    side_files(tmp_path)
    (tmp_path / "pipe.obj").symlink_to(pipe)
    (tmp_path / "pipe.hdr").symlink_to(pipe)
    new = f"{name}{old[-5:-1]}" if old[-4:-1] in ("obj", "hdr") and name[0] != "/" else name
    (tmp_path / "a.toml").write_text(scenes()[0].data.decode().replace(old, f'file = "{new}"'))
    with pytest.raises(InputError, match=r"a\.toml: "):
        load_scene(tmp_path / "a.toml")


@pytest.mark.parametrize("uri", ["pipe", "a%00b", "."])
def test_nor_does_a_gltf_file(uri: str, pipe: Path, tmp_path: Path) -> None:
    file = one_triangle()
    file.json["buffers"] = [{"byteLength": len(file.binary), "uri": uri}]
    with refused(path="a.gltf") as caught:
        load_scene(file.write(tmp_path, "a.gltf"))
    assert caught.value.place.endswith("buffers[0].uri")
