"""Dask workers in processes of their own trace the picture of this process, bit for bit, and may be killed at it."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.wrt.test_checkpoint import SCENE, same
from wrt import cluster
from wrt.driver import Progress, render
from wrt.errors import InputError
from wrt.film import Film

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")

HOW: dict[str, Any] = {"tile_size": 16, "aov": "depth"}


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    """Two workers, each a process with one thread."""
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as started:
        yield started


@pytest.fixture
def client(local: Any) -> Iterator[Any]:
    with distributed.Client(local, set_as_default=False) as one:
        one.wait_for_workers(2, timeout=60)  # one that was killed is started anew
        yield one


@pytest.fixture(scope="module")
def whole() -> Film:
    return render(SCENE, aov="depth")


def dies_in_a_tile(flags: list[str]) -> None:
    """On a worker: one process for each flag is killed while it traces a tile."""
    from wrt.driver import Renderer

    trace = Renderer.trace_tile

    def deadly(self: Any, work: Any, *rest: Any) -> Any:
        arrays = trace(self, work, *rest)
        for flag in flags if work.first >= 4 else ():
            try:
                os.close(os.open(flag, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            os.kill(os.getpid(), signal.SIGKILL)
        return arrays

    Renderer.trace_tile = deadly  # type: ignore[method-assign]


def test_the_picture_is_the_same(client: Any, whole: Film) -> None:
    film = render(SCENE, executor=client, **HOW)
    assert same(film, whole)
    assert {int(name.split(":")[1]) for name in film.stats["workers"]} == set(client.run(os.getpid).values())
    again = render(SCENE, executor=client, target_error=0.02, crop=(3, 4, 50, 30), tile_size=16)
    assert same(again, render(SCENE, target_error=0.02, crop=(3, 4, 50, 30)))


@pytest.mark.parametrize("killed", [1, 2])
def test_killed_workers_cost_only_their_tiles(client: Any, whole: Film, tmp_path: Path, killed: int) -> None:
    """Of two: with both of them the scene is gone too, and is sent to those that come after."""
    flags = [str(tmp_path / str(i)) for i in range(killed)]
    before = set(client.run(os.getpid).values())
    client.run(dies_in_a_tile, flags)
    seen: list[int] = []
    film = render(SCENE, executor=client, progress=lambda progress: seen.append(progress.done), **HOW)
    assert sorted(os.listdir(tmp_path)) == [str(i) for i in range(killed)]
    assert same(film, whole) and seen == sorted(seen)
    assert len(before - set(client.run(os.getpid).values())) == killed
