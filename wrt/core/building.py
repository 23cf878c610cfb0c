"""Progress and time of a build: builders report the finished share to the function that the caller of `wrt.build` gave."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")
_report: ContextVar[Callable[[float], None]] = ContextVar("report", default=lambda done: None)
_here = threading.local()  # loaded: seconds that this thread spent on loading kernels


@contextmanager
def reported_to(progress: Callable[[float], None]) -> Iterator[None]:
    """Call `progress` with 0 at the begin of the block, with 1 at its end, and between with what builders in this thread report."""
    token = _report.set(progress)
    try:
        progress(0.0)
        yield
        progress(1.0)
    finally:
        _report.reset(token)


def report(done: float) -> None:
    """Report that the share `done`, 0 to 1, of the build is finished."""
    _report.get()(done)


def report_parts(items: Sequence[T], work: Callable[[T], R]) -> list[R]:
    """Return work(item) of each item. What `work` reports is the share of its item, and not of the whole build."""
    whole, out = _report.get(), []
    for i, item in enumerate(items):
        token = _report.set(lambda done, i=i: whole((i + done) / len(items)))  # type: ignore[misc]
        try:
            out.append(work(item))
        finally:
            _report.reset(token)
        whole((i + 1) / len(items))
    return out


def tally(total: int) -> Callable[[int], None]:
    """Return a function for any thread that adds finished work, and reports its share of `total`."""
    whole, lock, done = _report.get(), threading.Lock(), 0

    def add(size: int) -> None:
        nonlocal done
        with lock:
            done += size
            whole(done / max(total, 1))

    return add


@contextmanager
def loading() -> Iterator[None]:
    """Mark the loading of a kernel: compiling it, reading it from the cache, or waiting for another thread that does."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        _here.loaded = getattr(_here, "loaded", 0.0) + time.perf_counter() - begin


def build_clock() -> float:
    """Return the seconds of a clock that stops while this thread loads kernels. Only differences are meaningful."""
    return time.perf_counter() - getattr(_here, "loaded", 0.0)
