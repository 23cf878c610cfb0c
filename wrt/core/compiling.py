"""Compiled kernels: reports that they are being compiled, and the precompiled headers in the kernel cache.

The report explains a slow first call. It is a message of the logger "wrt". If the program has not configured `logging`, Python writes
it to stderr. To switch it off: `logging.getLogger("wrt").setLevel(logging.ERROR)`. A caller that reports the progress of its work reads
`is_slow` instead.
"""

import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp

COMPILING = "compiling kernels (first time for this kind of scene or query) ..."
LOGGER = logging.getLogger("wrt")
_lock = threading.Lock()


class Watch:
    """The kernels that a process compiles. A series of compilations without a long pause is reported once.

    delay: seconds of a series after which it is reported. pause: seconds without compilation that end a series. Any thread may call
    the methods."""

    def __init__(self, delay: float = 0.5, pause: float = 2.0) -> None:
        self.delay, self.pause = delay, pause
        self._lock = threading.Lock()
        self._running = self._callers = 0  # kernels being compiled; callers that report by themselves
        self._begin, self._end, self._reported = 0.0, float("-inf"), False

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """Mark the compilation of a kernel."""
        with self._lock:
            now = time.monotonic()
            first = not self._running and now - self._end > self.pause
            if first:
                self._begin, self._reported = now, False
            self._running += 1
        if first:
            timer = threading.Timer(self.delay, self._report)
            timer.daemon = True
            timer.start()
        try:
            self._report()  # runs the handlers of the program, which may raise
            yield
        finally:
            with self._lock:
                self._running -= 1
                self._end = time.monotonic()

    def is_slow(self) -> bool:
        """Return True while kernels are being compiled in a series that has lasted for `delay`."""
        return self._running > 0 and time.monotonic() - self._begin >= self.delay

    @contextmanager
    def reported_by_caller(self) -> Iterator[None]:
        """Log nothing while the block runs, because its caller reports by itself."""
        with self._lock:
            self._callers += 1
        try:
            yield
        finally:
            with self._lock:
                self._callers -= 1

    def _report(self) -> None:
        with self._lock:
            due = self.is_slow() and not self._reported
            self._reported |= due
            silent = self._callers > 0
        if due and not silent:
            LOGGER.warning(COMPILING)


WATCH = Watch()


def shared_headers(cache: Path, key: str, precompile: Callable[[Path], None]) -> Path:
    """Return the folder of the precompiled headers `key` in the kernel cache; `precompile` writes them if necessary, or raises OSError.

    All threads and processes of a user share the folder, because precompiling Warp's headers takes 1.3 s of processor time. It is made
    under another name, and renamed when it is complete; if several processes make it, the first folder stays, because it is in use."""
    folder = cache / f"precompiled-{key}"
    with _lock:
        if not folder.is_dir():
            aside = Path(mkdtemp(prefix=f"{folder.name}-", dir=cache))
            try:
                precompile(aside)
                with suppress(OSError):  # another process was faster
                    aside.rename(folder)
            finally:
                shutil.rmtree(aside, ignore_errors=True)
    return folder
