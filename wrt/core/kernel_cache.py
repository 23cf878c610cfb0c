"""Files in the kernel cache: precompiled headers that all processes share, and objects that tell whether they are damaged."""

from __future__ import annotations

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
_whole: set[Path] = set()  # folders of headers that this process has looked at


def shared_headers(key: str, precompile: Callable[[Path], None], leftover: re.Pattern[str]) -> Path:
    """Return the folder of precompiled headers of that name. Raises OSError where it cannot be made.

    All threads and processes of a user share it: Warp's headers take 1.3 s of processor time, and about six threads of a process
    compile. precompile: writes them to a folder. Headers that nobody has used for a day are removed, and so are
    other folders of the cache whose names match `leftover`.
    """
    folder = Path(wp.config.kernel_cache_dir) / f"precompiled-{key}"
    with _lock:
        if folder not in _whole or not folder.is_dir():  # the first that asks, or somebody has emptied the cache
            for path in folder.parent.iterdir():
                with suppress(OSError):  # another process was faster
                    if leftover.fullmatch(path.name) and path != folder and time.time() - path.lstat().st_mtime > DAY:
                        shutil.rmtree(path)
            if not _is_sealed(folder):
                _make_headers(folder, precompile)
            os.utime(folder)
            _whole.add(folder)
    return folder


def _make_headers(folder: Path, precompile: Callable[[Path], None]) -> None:
    """Make the folder aside, and rename it when it is whole. Threads wait for the first one; of processes that start at once each
    makes its own, and the first one's stays: it is in use."""
    aside = Path(mkdtemp(prefix=f"{folder.name}-", dir=folder.parent))
    try:
        precompile(aside)
        (aside / "seal").write_bytes(_digest(aside))
        try:
            aside.rename(folder)
        except OSError:
            if not _is_sealed(folder):  # a damaged one, or what is in the way
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
    """Remove a file, a link or a folder that may be there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def seal(path: Path) -> None:
    """Write the SHA-256 of an object file to its end, behind all that a linker reads."""
    with path.open("r+b") as file:
        file.write(sha256(file.read()).digest())


def is_whole(path: Path, sealed: bool) -> bool:
    """Whether a file is there and not empty; of an object that was sealed, whether its last bytes are the digest of the others."""
    data = path.read_bytes() if path.is_file() else b""
    return len(data) > 0 and not (sealed and path.suffix == ".o" and sha256(data[:-32]).digest() != data[-32:])
