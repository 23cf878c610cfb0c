"""Files in the kernel cache: precompiled headers that all processes share, and objects with checksums."""

import os
import re
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from tempfile import mkdtemp

import warp as wp

DAY = 86400.0  # seconds: no kernel takes so long to compile
_lock = threading.Lock()
_checked: set[Path] = set()  # folders of headers that this process has checked


def shared_headers(key: str, precompile: Callable[[Path], None], leftover: re.Pattern[str]) -> Path:
    """Return the folder of the precompiled headers `key`; `precompile` writes them if necessary. Raises OSError if it cannot.

    All threads and processes of a user share the folder, because precompiling Warp's headers takes 1.3 s of processor time. Folders of
    the cache that match `leftover` and were not used for a day are removed."""
    folder = Path(wp.config.kernel_cache_dir) / f"precompiled-{key}"
    with _lock:
        if folder not in _checked or not folder.is_dir():  # the first call, or the cache was emptied
            for path in folder.parent.iterdir():
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
    """Return True if a file exists and is not empty, and if the SHA-256 of a sealed object file matches its content."""
    data = path.read_bytes() if path.is_file() else b""
    return len(data) > 0 and not (sealed and path.suffix == ".o" and sha256(data[:-32]).digest() != data[-32:])
