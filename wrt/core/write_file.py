"""Write files so that a name holds a whole file at any moment: into a temporary file beside it, synced to the disk, then renamed.

A link in the place of the file is replaced, never followed: in a folder that others can write to, a link of theirs could lead to
any file of the user. A process that is killed leaves its temporary file, `.wrt-*` (docs/long_renders.md).
"""

from __future__ import annotations

import contextlib
import errno
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from wrt.core.errors import InputError

_UNABLE = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)  # of file systems that cannot sync folders


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise the InputError that `replacing` this path would end in, before any work is done for it."""
    with _reported(path):
        file = _temporary(_target(path))
        file.close()
        os.unlink(file.name)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` as `replacing` does."""
    with replacing(path) as file:
        file.write(data)


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A new empty file in the folder of `path`, open for reading and writing; on success it is synced and renamed to `path`.

    On any failure the new file is removed and an existing `path` stays as it was. Raises InputError, which names `path`, where the
    system refuses.
    """
    with _reported(path):
        target = _target(path)
        file = _temporary(target)
        try:
            with file:  # closed before it is renamed, as Windows wants it
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
        raise InputError(f"cannot be written: {error.strerror or error}", path) from error


def _target(path: str | os.PathLike[str]) -> Path:
    """The path, if a file can be put there; raises InputError if not."""
    target = Path(path).absolute()  # whatever becomes the current folder meanwhile
    try:
        os.access(target, os.F_OK)
    except ValueError as error:  # a zero byte or a lone surrogate: Path.exists() says only that there is no such file
        raise InputError(f"cannot be written: {error}", path) from None
    if not target.parent.is_dir():
        raise InputError("its folder does not exist", path)
    if target.is_dir():
        raise InputError("is a folder", path)
    if target.exists() and not target.is_file():
        raise InputError("is no regular file", path)  # a device: replacing it would destroy its node
    if target.exists() and not os.access(target, os.W_OK):
        raise InputError("is write-protected", path)
    return target


def _temporary(target: Path) -> BinaryIO:
    """A new file beside `target`: mode x follows no link, and gives the usual permissions (tempfile's are for the user alone). It
    has the suffix of `target`, which tells OpenImageIO the format."""
    return open(target.with_name(f".wrt-{uuid.uuid4().hex}{target.suffix}"), "x+b")


def _sync_folder(folder: Path) -> None:
    """Sync the names in a folder: before that, a power cut can undo a rename. Windows has no call for it."""
    if os.name == "nt":
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
