"""What is kept of `wrt.tune`: for whom, in which file, and what becomes of a file that is none of ours."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from wrt.core import tuned
from wrt.core.errors import InputError
from wrt.core.tuned import BLOCK_DIMS, DEFAULT, STACKS, STRUCTURES, Choice, cache_folder, choice_for, keep, kept, using

OTHER = Choice("bvh2", 128, "local")


def gpu(name: str = "A", arch: int = 75, alias: str = "cuda:0") -> Any:
    return SimpleNamespace(name=name, arch=arch, alias=alias, is_cuda=True)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WRT_CACHE_PATH", str(tmp_path / "a" / "b"))
    return tmp_path / "a" / "b"


def test_a_choice_is_kept_for_devices_of_a_kind() -> None:
    assert kept(gpu()) is None and choice_for(gpu()) == DEFAULT == Choice("bvh8", 64, "shared")
    keep(gpu(), OTHER)
    assert kept(gpu()) == OTHER == choice_for(gpu(alias="cuda:1"))
    for device in (gpu("B"), gpu(arch=90), SimpleNamespace(name="A", alias="cpu", is_cuda=False)):
        assert kept(device) is None and choice_for(device) == DEFAULT
    keep(gpu(), Choice("bvh4", 32))
    assert kept(gpu()) == Choice("bvh4", 32)


@pytest.mark.parametrize("module", ["wrt", "warp"])
def test_another_version_has_nothing_kept(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    keep(gpu(), OTHER)
    monkeypatch.setattr(*{"wrt": ("wrt.core.tuned.VERSION", "9.9"), "warp": ("warp.__version__", "9.9")}[module])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kept(gpu()) is None


def test_the_file_is_small_and_says_what_it_is_for(folder: Path) -> None:
    path = keep(gpu(), OTHER)
    assert list(folder.iterdir()) == [path] and path.stat().st_size < 300
    expected = {"device": "A, sm_75", "accel": "bvh2", "block_dim": 128, "stack": "local"}
    assert json.loads(path.read_text()).items() >= expected.items()


def test_it_is_written_whole_or_not_at_all(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = keep(gpu(), OTHER)
    before = path.read_bytes()

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        keep(gpu(), Choice("bvh4", 32))
    assert list(folder.iterdir()) == [path] and path.read_bytes() == before


@pytest.mark.parametrize("content", [
    "", "{", "[]", "7", "[" * 100_000, '{"accel": "bvh4", "block_dim": 64}', {"accel": "grid"}, {"accel": ["bvh4"]},
    {"block_dim": 96}, {"block_dim": 64.0}, {"block_dim": None}, {"stack": "heap"}, {"stack": 0}, {"device": "B, sm_75"},
    {"more": 1}],
    ids=lambda content: str(content)[:24])
def test_a_file_that_is_no_choice_is_told_once_and_not_used(content: Any) -> None:
    """content: all of it, or what is different in it."""
    path = keep(gpu(), OTHER)
    path.write_text(content if isinstance(content, str) else json.dumps({**json.loads(path.read_text()), **content}))
    tuned._read.cache_clear()
    with pytest.warns(UserWarning) as told:
        assert kept(gpu()) is None and choice_for(gpu()) == DEFAULT
    assert len(told) == 1 and str(path) in str(told[0].message) and "--tune" in str(told[0].message)
    keep(gpu(), OTHER)
    assert kept(gpu()) == OTHER


def test_a_folder_in_its_place_is_told(folder: Path) -> None:
    path = keep(gpu(), OTHER)
    path.unlink()
    path.mkdir()
    tuned._read.cache_clear()
    with pytest.warns(UserWarning, match="Is a directory"):
        assert kept(gpu()) is None


def test_a_folder_that_cannot_be_made_is_told(folder: Path) -> None:
    folder.parent.write_text("a file")
    with pytest.raises(InputError, match="WRT_CACHE_PATH names another folder"):
        keep(gpu(), OTHER)
    assert kept(gpu()) is None


def test_a_block_may_use_another(folder: Path) -> None:
    keep(gpu(), OTHER)
    with pytest.raises(KeyError), using(gpu(), Choice("bvh4", 32)):
        with using(gpu(), Choice("bvh8c", 256)):
            assert choice_for(gpu()) == Choice("bvh8c", 256)
        assert choice_for(gpu()) == Choice("bvh4", 32) and choice_for(gpu(alias="cuda:1")) == OTHER
        raise KeyError
    assert choice_for(gpu()) == OTHER


def test_where_caches_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("WRT_CACHE_PATH")
    monkeypatch.setattr(tuned.sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "wrt"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "me"))
    assert cache_folder() == tmp_path / "me" / ".cache" / "wrt"


def test_the_default_is_among_what_is_measured() -> None:
    from wrt.accel.structures import ACCELERATORS, meant
    from wrt.kernels.traverse.stack import PLACES

    assert DEFAULT == Choice(STRUCTURES[0], BLOCK_DIMS[0], STACKS[0]) and set(STACKS) == set(PLACES)
    assert ACCELERATORS["bvh"] is ACCELERATORS[meant("bvh")] and set(STRUCTURES) <= ACCELERATORS.keys()
