"""Seconds: those of threads that run at the same time are counted once, in every report of a render."""

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
from wrt.core.seconds import counted_once
from wrt.renderer.distributed.renderer import _waited_for

SCENE = ROOT / "scenes" / "conductor.toml"


@pytest.mark.parametrize(("phases", "expected"), [
    ({}, {}),
    ({"compile": [], "build": []}, {"compile": 0.0, "build": 0.0}),
    ({"compile": [(0, 5)], "upload": [(0, 1)], "build": [(1, 3)]}, {"compile": 5.0, "upload": 0.0, "build": 0.0}),
    ({"compile": [(0, 2)], "upload": [(0, 1)], "build": [(1, 7)]}, {"compile": 2.0, "upload": 0.0, "build": 5.0}),
    # The builder compiles a kernel of its own, and waits for the compiler to do so.
    ({"compile": [(0, 4), (1, 6)], "build": [(0.5, 8)]}, {"compile": 6.0, "build": 2.0}),
    ({"compile": [(3, 4), (0, 1)], "build": [(0, 5)]}, {"compile": 2.0, "build": 3.0}),
    ({"compile": [(1, 2), (1, 2), (1.25, 1.5)], "build": [(2, 3), (1, 2)]}, {"compile": 1.0, "build": 1.0}),
], ids=str)
def test_each_second_is_counted_once(phases: dict[str, list[tuple[float, float]]], expected: dict[str, float]) -> None:
    assert counted_once(phases) == expected
    spans = [span for each in phases.values() for span in each]
    whole = max((end for _, end in spans), default=0.0) - min((begin for begin, _ in spans), default=0.0)
    assert sum(counted_once(phases).values()) <= whole


class Clock:
    """A clock that stands still until it is told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_what_a_thread_loads_is_not_what_it_builds(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(seconds, "_loads", [])
    monkeypatch.setattr(time, "perf_counter", clock)

    def load(duration: float) -> None:
        with seconds.loading():
            clock.now += duration

    load(1.0)
    begin = clock.now
    load(2.0)
    clock.now += 0.5
    other = threading.Thread(target=load, args=(4.0,))
    other.start()
    other.join()
    assert seconds.seconds_without_loads(begin) == 0.5 + 4.0  # another's load is no excuse
    assert seconds.loads_since(begin) == [(101.0, 103.0), (103.5, 107.5)]
    assert seconds.loads_since(102.0)[0] == (102.0, 103.0)
    with pytest.raises(OSError), seconds.loading():
        clock.now += 1.0
        raise OSError
    assert seconds.loads_since(begin)[-1] == (107.5, 108.5)  # in vain, but spent


@pytest.mark.parametrize("aov", [(), "depth"])
def test_the_seconds_of_a_render_are_no_more_than_it_took(aov: str | tuple[str, ...]) -> None:
    for _ in range(2):  # compiled, or from the cache of an earlier run; then kept by this process
        begin = time.perf_counter()
        film = wrt.render(SCENE, spp=1, size=(16, 9), aov=aov, tile_size=3)
        whole = time.perf_counter() - begin
        parts = film.stats["seconds"]
        assert parts.keys() >= {"compile", "upload", "build", "trace"} and min(parts.values()) >= 0.0
        assert sum(parts.values()) <= whole and film.stats["accel"]["build_seconds"] <= whole


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
        assert sum(told["seconds"].values()) <= whole, (state, told["seconds"], whole)
        line = done.stderr.splitlines()[-1]
        shown = [part.split() for part in line.removeprefix("seconds: ").split(", ")]
        assert [name for name, *_ in shown] == list(told["seconds"])
        assert sum(float(part[1]) for part in shown) <= whole + 0.005 * len(shown)  # each is rounded


def test_a_worker_that_was_ready_already_took_no_more_than_was_waited_for_it() -> None:
    with ThreadPoolExecutor(1) as pool:
        for _ in range(2):
            begin = time.perf_counter()
            film = wrt.render(SCENE, spp=1, size=(17, 9), executor=pool)
            assert sum(film.stats["seconds"].values()) <= time.perf_counter() - begin
    assert film.stats["seconds"].keys() >= {"compile", "upload", "build", "trace"}


def test_of_several_workers_the_one_that_took_longest_is_told() -> None:
    replies = [("a", "cpu", {"seconds": {"compile": 1.0, "build": 0.5}}), ("b", "cpu", {"seconds": {"compile": 6.0, "build": 2.0}})]
    assert _waited_for(replies, 9.0) == {"compile": 6.0, "build": 2.0}
    assert _waited_for(replies, 2.0) == {"compile": 1.5, "build": 0.5}
    assert _waited_for([("a", "cpu", {"seconds": {"compile": 0.0, "build": 0.0}})], 0.0) == {"compile": 0.0, "build": 0.0}
