"""Writing of files by a temporary file that is synced to the disk and then renamed, so that a path always holds a complete file.

A link at the path is replaced and never followed: in a shared folder, another user's link could lead to any file of this user. A
killed process leaves its temporary file, `.wrt-*` (docs/long_renders.md).
"""

import contextlib
import errno
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from wrt.core.errors import InputError

_UNABLE = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)  # errors of file systems that cannot sync folders


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise the InputError that `replacing(path)` would raise, so that it comes before the work on the file's content."""
    with _reported(path):
        file = _temporary(_target(path))
        file.close()
        os.unlink(file.name)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to a file by `replacing`."""
    with replacing(path) as file:
        file.write(data)


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a new file in the folder of `path` for reading and writing; after the block, sync it and rename it to `path`.

    After any failure the new file is removed, and an existing file at `path` is unchanged. Raises InputError if the system refuses."""
    with _reported(path):
        target = _target(path)
        file = _temporary(target)
        try:
            with file:  # Windows renames only closed files
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(file.name, target)
        except BaseException:
            with contextlib.suppress(OSError):  # its folder is gone, or the disk has become read-only
                os.unlink(file.name)
            raise
        _sync_folder(target.parent)


@contextlib.contextmanager
def _reported(path: str | os.PathLike[str]) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path=path) from error


def _target(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path. Raises InputError if a file cannot be written to it."""
    target = Path(path).absolute()  # the current folder may change
    try:
        os.access(target, os.F_OK)
    except ValueError as error:  # a zero byte or a lone surrogate, which Path.exists() hides
        raise InputError(f"cannot be written: {error}", path=path) from None
    if not target.parent.is_dir():
        raise InputError("its folder does not exist", path=path)
    if target.is_dir():
        raise InputError("is a folder", path=path)
    if target.exists() and not target.is_file():
        raise InputError("is no regular file", path=path)  # a device: replacing it would destroy its node
    if target.exists() and not os.access(target, os.W_OK):
        raise InputError("is write-protected", path=path)
    return target


def _temporary(target: Path) -> BinaryIO:
    """Create a file beside `target` with its suffix, by which OpenImageIO chooses the format.

    Mode x follows no link, and gives the usual permissions; files of tempfile are readable by the user alone."""
    return open(target.with_name(f".wrt-{uuid.uuid4().hex}{target.suffix}"), "x+b")


def _sync_folder(folder: Path) -> None:
    """Sync the names in a folder to the disk: until then, a power cut can undo a rename. Windows has no call for it."""
    if os.name == "nt":
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return  # the folder can be written to but not read
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNABLE:
            raise
    finally:
        os.close(descriptor)
