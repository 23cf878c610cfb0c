"""Clock for the build time of acceleration structures, without the loading of kernels."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

_here = threading.local()  # loaded: seconds that this thread spent on loading kernels


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
