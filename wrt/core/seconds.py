"""Seconds of work that runs at the same time in several threads, each counted once; and which of them went into kernels."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

Span = tuple[float, float]  # from and to, by time.perf_counter

_loads: list[tuple[int, Span]] = []  # the thread that compiled a kernel, or took it from the cache, and when


@contextmanager
def loading() -> Iterator[None]:
    """Around the loading of a kernel."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        _loads.append((threading.get_ident(), (begin, time.perf_counter())))


def loads_since(begin: float) -> list[Span]:
    """When kernels were loaded, by any thread; loads that began earlier are cut."""
    return [(max(start, begin), end) for _, (start, end) in tuple(_loads) if end > begin]


def seconds_without_loads(begin: float) -> float:
    """Seconds from then until now, without those in which this thread loaded kernels."""
    now, own = time.perf_counter(), threading.get_ident()
    return max(now - begin - sum(end - start for thread, (start, end) in tuple(_loads) if thread == own and start >= begin), 0.0)


def counted_once(phases: Mapping[str, Sequence[Span]]) -> dict[str, float]:
    """The seconds of each phase. Where several run at the same time, these seconds are the first one's, by the order of `phases`:
    the sum is at most the time from the first beginning to the last end."""
    taken: list[Span] = []
    out: dict[str, float] = {}
    for name, spans in phases.items():
        before = _length(taken)
        taken += spans
        out[name] = _length(taken) - before
    return out


def _length(spans: Sequence[Span]) -> float:
    """Seconds in at least one of the spans."""
    total, reached = 0.0, float("-inf")
    for start, end in sorted(spans):
        total += max(end - max(start, reached), 0.0)
        reached = max(reached, end)
    return total
