"""Seconds of the stages of a render, and of a build without its kernels."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.data import ROOT
from wrt.core import seconds
from wrt.renderer.distributed.renderer import _waited_for

SCENE = ROOT / "scenes" / "conductor.toml"


class Clock:
    """A clock that stands still until a test moves it."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_seconds_of_loading_do_not_count_as_building(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)

    def load(duration: float) -> None:
        with seconds.loading():
            clock.now += duration

    load(1.0)
    begin = seconds.build_clock()
    load(2.0)
    clock.now += 0.5
    other = threading.Thread(target=load, args=(4.0,))
    other.start()
    other.join()
    assert seconds.build_clock() - begin == 0.5 + 4.0  # loads of other threads do not count
    with pytest.raises(OSError), seconds.loading():
        clock.now += 1.0
        raise OSError
    assert seconds.build_clock() - begin == 0.5 + 4.0  # a failed load counts, too


@pytest.mark.parametrize("aov", [(), "depth"])
def test_the_seconds_of_a_render_are_no_more_than_it_took(aov: str | tuple[str, ...]) -> None:
    for _ in range(2):  # compiled, or from the cache of an earlier run; then kept by this process
        begin = time.perf_counter()
        film = wrt.render(SCENE, spp=1, size=(16, 9), aov=aov, tile_size=3)
        whole = time.perf_counter() - begin
        parts = film.stats["seconds"]
        assert parts.keys() >= {"compile", "upload", "build", "trace"} and min(parts.values()) >= 0.0
        assert max(parts.values()) <= whole and film.stats["accel"]["build_seconds"] <= parts["build"]
        assert sum(parts[name] for name in parts if name != "compile") <= whole  # which runs beside upload and build


def test_the_seconds_of_a_process_are_no_more_than_it_took(tmp_path: Path) -> None:
    """With an empty cache, where compiling and building compete, and with a warm one."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(tmp_path / "cache")}
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    command = [sys.executable, "-m", "wrt", "render", "box.obj", "--size", "16x9", "--spp", "1", "--json"]
    for state in ("cold", "warm"):
        begin = time.perf_counter()
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        whole = time.perf_counter() - begin
        told = json.loads(done.stdout)
        assert sum(told["seconds"].values()) - told["seconds"]["compile"] <= whole, (state, told["seconds"], whole)
        assert told["seconds"]["compile"] <= whole and told["accel"]["build_seconds"] <= told["seconds"]["build"]
        line = done.stderr.splitlines()[-1]
        shown = [part.split() for part in line.removeprefix("seconds: ").split(", ")]
        assert [name for name, *_ in shown] == list(told["seconds"])
        assert [float(part[1]) for part in shown] == [round(value, 2) for value in told["seconds"].values()]


def test_a_worker_that_was_ready_already_took_no_more_than_was_waited_for_it() -> None:
    with ThreadPoolExecutor(1) as pool:
        for _ in range(2):
            begin = time.perf_counter()
            film = wrt.render(SCENE, spp=1, size=(17, 9), executor=pool)
            assert max(film.stats["seconds"].values()) <= time.perf_counter() - begin
    assert film.stats["seconds"].keys() >= {"compile", "upload", "build", "trace"}


def test_the_worker_that_took_longest_is_reported() -> None:
    replies = [("a", "cpu", {"seconds": {"compile": 1.0, "build": 0.5}}), ("b", "cpu", {"seconds": {"compile": 6.0, "build": 2.0}})]
    assert _waited_for(replies, 9.0) == {"compile": 6.0, "build": 2.0}
    assert _waited_for(replies, 1.0) == {"compile": 1.0, "build": 1.0}
    assert _waited_for([("a", "cpu", {"seconds": {"compile": 0.0, "build": 0.0}})], 0.0) == {"compile": 0.0, "build": 0.0}
