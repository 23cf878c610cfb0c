"""Tiles cover every pixel once, also after an interruption; LocalTracer: pauses between tiles, errors, and early ends."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wrt.renderer.film import Work, tiles
from wrt.renderer.schedule import LocalTracer, work_left


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


@given(st.integers(0, 9), st.integers(0, 9), st.integers(1, 40), st.integers(1, 40), st.integers(1, 50))
def test_tiles_cover_a_rectangle_once(x0: int, y0: int, width: int, height: int, step: int) -> None:
    times = np.zeros((60, 60), int)
    for x, y, w, h in tiles((x0, y0, x0 + width, y0 + height), step):
        assert 1 <= w <= step and 1 <= h <= step
        times[y : y + h, x : x + w] += 1
    assert (times[y0 : y0 + height, x0 : x0 + width] == 1).all() and times.sum() == width * height


@given(st.integers(1, 8), st.integers(1, 8), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_work_left_brings_every_pixel_to_the_goal_in_its_own_order(old: int, new: int, n: int, seed: int) -> None:
    crop = (3, 5, 24, 16)
    rng = np.random.default_rng(seed)
    samples = np.full((11, 21), 2)
    for x, y, w, h in tiles(crop, old):
        samples[y - 5 : y - 5 + h, x - 3 : x - 3 + w] += rng.integers(0, 6)
    expected = np.maximum(samples, 2 + n)
    for (x, y, w, h), first, count in work_left([Work(tile, 2, n) for tile in tiles(crop, new)], samples, crop):
        part = samples[y - 5 : y - 5 + h, x - 3 : x - 3 + w]
        assert (part == first).all() and count > 0  # each pixel continues with its first missing sample
        part += count
    assert np.array_equal(samples, expected)
