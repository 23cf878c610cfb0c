"""Compiled kernels: reports that they are being compiled, and their files in the kernel cache.

The report explains a slow first call. It is a message of the logger "wrt". If the program has not configured `logging`, Python writes
it to stderr. To switch it off: `logging.getLogger("wrt").setLevel(logging.ERROR)`. A caller that reports the progress of its work reads
`is_slow` instead. The cache has precompiled headers that all processes share, and objects with checksums.
"""

import logging
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from tempfile import mkdtemp

COMPILING = "compiling kernels (first time for this kind of scene or query) ..."
LOGGER = logging.getLogger("wrt")
DAY = 86400.0  # seconds: no kernel takes so long to compile
_lock = threading.Lock()
_checked: set[Path] = set()  # folders of headers that this process has checked


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


def shared_headers(cache: Path, key: str, precompile: Callable[[Path], None], leftover: re.Pattern[str]) -> Path:
    """Return the folder of the precompiled headers `key` in the kernel cache; `precompile` writes them if necessary, or raises OSError.

    All threads and processes of a user share the folder, because precompiling Warp's headers takes 1.3 s of processor time. Folders of
    the cache that match `leftover` and were not used for a day are removed."""
    folder = cache / f"precompiled-{key}"
    with _lock:
        if folder not in _checked or not folder.is_dir():  # the first call, or the cache was emptied
            for path in cache.iterdir():
                with suppress(OSError):  # another process was faster
                    if leftover.fullmatch(path.name) and path != folder and time.time() - path.lstat().st_mtime > DAY:
                        shutil.rmtree(path)
            if not _is_sealed(folder):
                _make_headers(folder, precompile)
            os.utime(folder)
            _checked.add(folder)
    return folder


def _make_headers(folder: Path, precompile: Callable[[Path], None]) -> None:
    """Make the folder under another name, and rename it when it is complete.

    One thread of a process makes the folder; others wait. If several processes make it, the first folder stays, because it is in use."""
    aside = Path(mkdtemp(prefix=f"{folder.name}-", dir=folder.parent))
    try:
        precompile(aside)
        (aside / "seal").write_bytes(_digest(aside))
        try:
            aside.rename(folder)
        except OSError:
            if not _is_sealed(folder):  # damaged, or not a folder of headers
                folder.rename(folder.with_name(f"{aside.name}-old"))
                aside.rename(folder)
    finally:
        for path in folder.parent.glob(f"{aside.name}*"):
            remove(path)


def _digest(folder: Path) -> bytes:
    return sha256(b"".join(path.read_bytes() for path in sorted(folder.glob("*.pch")))).digest()


def _is_sealed(folder: Path) -> bool:
    try:
        return not folder.is_symlink() and (folder / "seal").read_bytes() == _digest(folder)
    except OSError:
        return False


def remove(path: Path) -> None:
    """Remove a file, a link or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def seal(path: Path) -> None:
    """Append to an object file the SHA-256 of its content. Linkers ignore bytes after the object."""
    with path.open("r+b") as file:
        file.write(sha256(file.read()).digest())


def is_intact(path: Path, sealed: bool) -> bool:
    """Return True if a file is not empty, and if the SHA-256 of a sealed object file matches its content."""
    data = path.read_bytes() if path.is_file() else b""
    return len(data) > 0 and not (sealed and path.suffix == ".o" and sha256(data[:-32]).digest() != data[-32:])
