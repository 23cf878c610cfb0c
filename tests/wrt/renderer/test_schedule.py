"""LocalTracer: order of tiles, pauses between tiles, errors, and early ends."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from wrt.renderer.schedule import LocalTracer


class Jobs:
    """Stand-in for a Prepared scene: `trace` counts the running tiles."""

    def __init__(self, threads: int, fails_at: int | None = None) -> None:
        self.fails_at, self.lock = fails_at, threading.Lock()
        self.running, self.most, self.done = 0, 0, list[int]()
        self.prepared: Any = SimpleNamespace(
            threads=threads, plan=None, device=SimpleNamespace(is_cuda=False), seconds={}, facts=None, tiles=None,
            launch=lambda film: self.trace)

    def trace(self, job: int) -> int:
        with self.lock:
            self.running += 1
            self.most = max(self.most, self.running)
        time.sleep(0.005)
        with self.lock:
            self.running -= 1
            self.done.append(job)
        if job == self.fails_at:
            raise KeyError(job)
        return 10


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("every", [1, 2, 1000])
def test_tiles_pause_when_due_and_each_is_traced_once(threads: int, every: int) -> None:
    jobs, asked, steps = Jobs(threads), [0], list[tuple[int, bool]]()

    def due() -> bool:
        asked[0] += 1
        return asked[0] % every == 0

    work: Any = list(range(100))
    for done, at_rest in LocalTracer(jobs.prepared).trace(None, work, due):  # type: ignore[arg-type]
        steps.append((done, at_rest))
        if at_rest:
            assert jobs.running == 0 and done == 10 * len(jobs.done)
    assert sorted(jobs.done) == work and jobs.most <= threads
    assert steps[-1] == (1000, True) and [done for done, _ in steps] == sorted(done for done, _ in steps)
    assert not every == 1 or all(at_rest for _, at_rest in steps)


def test_a_tile_that_fails_ends_the_others() -> None:
    jobs = Jobs(2, fails_at=3)
    work: Any = list(range(10_000))
    with pytest.raises(KeyError, match="3"):
        list(LocalTracer(jobs.prepared).trace(None, work, lambda: False))  # type: ignore[arg-type]
    assert jobs.running == 0 and len(jobs.done) < 1000


def test_closing_early_waits_for_the_running_tiles() -> None:
    jobs = Jobs(2)
    work: Any = list(range(10_000))
    steps = LocalTracer(jobs.prepared).trace(None, work, lambda: False)  # type: ignore[arg-type]
    next(steps)
    steps.close()
    assert jobs.running == 0 and len(jobs.done) < 1000
