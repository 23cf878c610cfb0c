"""Dask workers in other processes render the same bits as this process, even if one of them is killed."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.command_line import wrt as run
from tests.data import ROOT
from tests.refused import refused
from tests.wrt.renderer.test_checkpoint import SCENE, same
from wrt.picture.film import Film
from wrt.picture.image import read_channels
from wrt.renderer import workers
from wrt.renderer.render import render

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")
dask = pytest.importorskip("dask", reason="needs the extra cluster")

HOW: dict[str, Any] = {"tile_size": 24, "pass_size": 8, "aov": "depth"}  # few tiles, since each call takes a hundredth of a second


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    """Start two workers, each a process with one thread."""
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50) as started:
        yield started


@pytest.fixture
def client(local: Any) -> Iterator[Any]:
    with distributed.Client(local, set_as_default=False) as one:
        one.wait_for_workers(2, timeout=60)  # a killed worker is restarted
        yield one


@pytest.fixture
def threads() -> Iterator[Any]:
    """Start a scheduler and a worker in this process, which takes no time."""
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, protocol="tcp://", silence_logs=50,
                                  dashboard_address=":0") as started:
        yield started


@pytest.fixture(scope="module")
def whole() -> Film:
    return render(SCENE, aov="depth")


def test_the_picture_is_the_same(client: Any, whole: Film) -> None:
    film = render(SCENE, executor=client, **HOW)
    assert same(film, whole)
    assert {int(name.split(":")[1]) for name in film.stats["workers"]} == set(client.run(os.getpid).values())
    again = render(SCENE, executor=client, target_error=0.02, crop=(3, 4, 50, 30), tile_size=24)
    assert same(again, render(SCENE, target_error=0.02, crop=(3, 4, 50, 30)))


def dies_in_a_tile(flag: str) -> None:
    """Run on a worker: the first process that traces a tile is killed."""
    from wrt.renderer.prepare import Prepared

    trace = Prepared.trace_tile

    def deadly(self: Any, work: Any, *rest: Any) -> Any:
        arrays = trace(self, work, *rest)
        if work.first >= 4:
            try:
                os.close(os.open(flag, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return arrays
            os.kill(os.getpid(), signal.SIGKILL)
        return arrays

    Prepared.trace_tile = deadly  # type: ignore[method-assign]


def test_a_killed_worker_costs_only_its_tiles(client: Any, whole: Film, tmp_path: Path) -> None:
    before = set(client.run(os.getpid).values())
    client.run(dies_in_a_tile, str(tmp_path / "flag"))
    seen: list[int] = []
    film = render(SCENE, executor=client, progress=lambda progress: seen.append(progress.done), **HOW)
    assert os.listdir(tmp_path) == ["flag"]
    assert same(film, whole) and seen == sorted(seen)
    assert len(before - set(client.run(os.getpid).values())) == 1


def test_a_scheduler_that_goes_away_leaves_a_checkpoint(threads: Any, tmp_path: Path, whole: Film) -> None:
    path = tmp_path / "a.checkpoint"

    def progress(progress: Any) -> None:
        if progress.done > 4 * 61 * 34:
            threads.close()

    with distributed.Client(threads, set_as_default=False, timeout=1) as one, refused("executor", "workers are lost"):
        render(SCENE, executor=one, checkpoint=path, progress=progress, **HOW)
    film = render(SCENE, checkpoint=path, resume=True, aov="depth")
    assert film.stats["resumed"]["samples"] >= 1 and same(film, whole)


# --- errors -----------------------------------------------------------------------------------------------------------


def test_a_worker_with_another_installation_is_refused(client: Any) -> None:
    def set_version(version: str) -> None:
        from wrt.renderer.workers import INSTALLED

        INSTALLED["Warp"] = version

    first = next(iter(client.scheduler_info()["workers"]))
    client.run(set_version, "0.9", workers=[first])
    try:
        with refused(what=f"worker {first} has Warp 0.9 (here {workers.INSTALLED['Warp']})"):
            render(SCENE, executor=client)
    finally:
        client.run(set_version, workers.INSTALLED["Warp"], workers=[first])


# --- the command line -------------------------------------------------------------------------------------------------


@pytest.fixture
def mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "box.obj"
    path.write_text(BOX_OBJ)
    return path


def test_commands(threads: Any, mesh: Path) -> None:
    address = threads.scheduler_address
    for name, where in (("here", ()), ("there", ("--cluster", address))):
        done = run("render", mesh, "-o", f"{name}.exr", "--size", "64x36", "--spp", 4, "--json", "-q", *where)
        assert done.code == 0 and json.loads(done.out)["samples"] == 64 * 36 * 4, done.err
    here, there = read_channels("here.exr"), read_channels("there.exr")
    assert here.keys() == there.keys() and all(np.array_equal(here[layer], there[layer]) for layer in here)
    page = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
    block = page.split("```python\n")[1].split("```")[0]
    assert block.count("tcp://scheduler:8786") == 1
    names: dict[str, Any] = {"wrt": wrt, "scene": SCENE}
    exec(block.replace("tcp://scheduler:8786", address).replace("spp=4096", "spp=2"), names)
    names["Client"].current().close()


def test_wrong_addresses(mesh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 0.3)
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        for address in (f"tcp://127.0.0.1:{closed.getsockname()[1]}", "nonsense", "", "ftp://127.0.0.1:1"):
            done = run("render", mesh, "--cluster", address)
            assert done.code == 2 and len(done.errors) == 1 and "no Dask scheduler at" in done.err, (address, done)
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = run("render", mesh, "--cluster", "tcp://127.0.0.1:1")
    assert done.code == 2 and len(done.errors) == 1 and "pip install 'wrt[cluster]'" in done.err
    assert not list(mesh.parent.glob("*.png"))


def test_a_scheduler_without_workers(mesh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "WORKER_SECONDS", 0.3)
    with distributed.LocalCluster(n_workers=0, protocol="tcp://", dashboard_address=":0", silence_logs=50) as empty:
        done = run("render", mesh, "--cluster", empty.scheduler_address)
    assert done.code == 2 and len(done.errors) == 1 and "no worker at tcp://" in done.err and "dask worker tcp://" in done.err
