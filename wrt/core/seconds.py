"""Seconds of building without those of loading kernels."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

_here = threading.local()  # loaded: seconds that this thread has spent on loading kernels


@contextmanager
def loading() -> Iterator[None]:
    """Around the loading of a kernel: compiling it, taking it from the cache, or waiting for another thread that does."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        _here.loaded = getattr(_here, "loaded", 0.0) + time.perf_counter() - begin


def build_clock() -> float:
    """Seconds of a clock that stands still while this thread loads kernels. Only differences mean something."""
    return time.perf_counter() - getattr(_here, "loaded", 0.0)
