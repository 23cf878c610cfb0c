"""The way out for files: each is written aside, brought to the disk and renamed, so that its name holds a whole file at any moment.

A process that is killed leaves what it wrote aside. The next one that writes in that folder removes it, if its maker is certainly
dead: a process holds a lock on its file, which ends with the process. The name tells on which system it ran: over a network, a lock
may not be seen, so that what another system left must also be a month old. Where there are no such locks (Windows, some file
systems), nothing is removed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import time
import uuid
from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path

from wrt.core.errors import InputError

try:
    import fcntl
except ImportError:  # no POSIX
    fcntl = None  # type: ignore[assignment]

WINDOWS = os.name == "nt"  # renames and removes no open file
LONG_AGO = 30 * 24 * 3600.0  # seconds: nobody writes a file for so long
_ASIDE = re.compile(r"\.wrt-([0-9a-f]{16})-[0-9a-f]{16}(\.[^/]*)?")
_MARK = ".compiling"  # a file aside whose content names a folder that goes with it
_BUILD = re.compile(r"wp_\w+_p\d+_t\d+")  # of Warp's, for one compilation
_UNABLE = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)  # what file systems say that cannot do what they are asked for
_cleaned: set[Path] = set()


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise the InputError that `replacing` this path would end in, before any work is done for it."""
    with _told(path), aside(_target(path).parent):
        pass


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A new empty file in the folder of `path`, to write to; on success it takes the place of `path`, and is on the disk.

    On any failure the new file is removed and an existing `path` stays as it was. A link is followed, not replaced.
    Raises InputError, which names `path`, where the system refuses.
    """
    with _told(path):
        target = _target(path)
        with aside(target.parent, target.suffix) as temporary:  # OpenImageIO takes the format from the suffix
            yield temporary
            _sync_file(temporary)
            os.replace(temporary, target)
            sync_folder(target.parent)


@contextlib.contextmanager
def _told(path: str | os.PathLike[str]) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path) from error


def _target(path: str | os.PathLike[str]) -> Path:
    """Where a file of that name is to be; raises InputError where none can be."""
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputError("its folder does not exist", path)
    if target.is_dir():
        raise InputError("is a folder", path)
    if target.exists() and not target.is_file():
        raise InputError("is no regular file", path)  # a device: replacing it would destroy its node
    if target.exists() and not os.access(target, os.W_OK):
        raise InputError("is write-protected", path)
    return target


def _sync_file(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)  # Windows flushes only what is open for writing
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk: before that, a power cut can undo a rename. Windows has no call for it."""
    if WINDOWS:
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return  # a folder that can be written to but not read
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNABLE:
            raise
    finally:
        os.close(descriptor)


# --- files aside, and what is left of them ----------------------------------------------------------------------------


@contextlib.contextmanager
def aside(folder: Path, suffix: str = "") -> Iterator[Path]:
    """A new empty file in `folder`, under a name of ours; what is still there of it when the block ends is removed.

    Leftovers of dead processes in that folder are removed first. OSError comes through.
    """
    remove_leftovers(folder)
    path, descriptor = _created(folder, suffix)
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):  # it has been renamed, or the disk has become read-only
            path.unlink()
        if descriptor is not None:
            os.close(descriptor)  # and with it goes the lock


def _created(folder: Path, suffix: str) -> tuple[Path, int | None]:
    """The file, and the descriptor that holds its lock."""
    while True:
        path = folder / f".wrt-{this_system()}-{uuid.uuid4().hex[:16]}{suffix}"
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if WINDOWS:
            os.close(descriptor)
            return path, None
        if try_lock(descriptor) and is_file_of(path, descriptor):
            return path, descriptor
        os.close(descriptor)  # somebody who looked for leftovers was faster than the lock


@contextlib.contextmanager
def compiling(cache: Path, name: str) -> Iterator[None]:
    """While Warp compiles in the folder of that name in its cache, say whose folder it is: Warp leaves it where it is killed, or
    where the compiler fails."""
    with aside(cache, _MARK) as mark:
        mark.write_text(name, encoding="utf-8")
        try:
            yield
        finally:
            shutil.rmtree(cache / name, ignore_errors=True)


def remove_leftovers(folder: Path) -> None:
    """Remove what dead processes of wrt have left in a folder; a process looks once."""
    if fcntl is None or folder in _cleaned:
        return
    _cleaned.add(folder)
    with contextlib.suppress(OSError), os.scandir(folder) as entries:  # what cannot be looked at or removed is left
        for path in [Path(entry) for entry in entries if entry.name.startswith(".")]:
            with contextlib.suppress(OSError):
                _remove_if_dead(path)


def _remove_if_dead(path: Path) -> None:
    if not (_ASIDE.fullmatch(path.name) or path.name.endswith(".part")):
        return
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        status = os.fstat(descriptor)
        maker = _maker(path.name, descriptor)
        if maker is None or not stat.S_ISREG(status.st_mode):
            return
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if is_file_of(path, descriptor) and (maker == this_system() or time.time() - status.st_mtime > LONG_AGO):
            if path.suffix == _MARK and _BUILD.fullmatch(name := os.pread(descriptor, 1000, 0).decode("ascii", "replace")):
                shutil.rmtree(path.with_name(name), ignore_errors=True)
            path.unlink()
    finally:
        os.close(descriptor)


def _maker(name: str, descriptor: int) -> str | None:
    """The system where a file of ours was made; None of anybody else's."""
    if match := _ASIDE.fullmatch(name):
        return match[1]
    begin = re.match(rb'wrt checkpoint \d+\n\{"maker": "([0-9a-f]{16})"', os.pread(descriptor, 100, 0))
    return begin[1].decode() if begin else None


def try_lock(descriptor: int) -> bool:
    """Lock an open file, until it is closed; False where another has done so. Where there are no locks, everybody has one."""
    if fcntl is not None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass  # a file system without locks
    return True


def is_file_of(path: Path, descriptor: int) -> bool:
    """Whether the open file is still the one of that name."""
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    return False


@cache
def this_system() -> str:
    """A name for the kernel that runs, from its start to its end, containers included; where it has none, one for nobody."""
    try:
        return sha256(Path("/proc/sys/kernel/random/boot_id").read_bytes()).hexdigest()[:16]
    except OSError:
        return uuid.uuid4().hex[:16]
