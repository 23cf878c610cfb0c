"""Files: reading of untrusted files, and writing that replaces a file only by a complete one.

A new file is written beside its target and renamed to it, so that a link at the target is replaced and never followed. A killed process
leaves its temporary file, `.wrt-*` (docs/long_renders.md)."""

import contextlib
import json
import os
import stat
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from zlib import crc32

from wrt.core.errors import InputError, at
from wrt.core.types import JsonObject

if TYPE_CHECKING:
    import numpy as np

BAD_NAMES = OSError, ValueError  # of names that the system does not have, and of names that no system takes


def require_file(path: Path, what: str = "") -> None:
    """Raise InputError if there is no file at the path. what: end of the message."""
    with _reported(path, "read"):
        if not path.exists():
            raise InputError(f"no such file{what}", path=path)


def read_file(path: str | os.PathLike[str], most: int = -1) -> bytes:
    """Return the bytes of a regular file, or the first `most` of them.

    Raises InputError, without the path, for a folder, and for a pipe or a device, which may never end."""
    with _reported(None, "read", BAD_NAMES):
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise InputError("cannot be read: it is no regular file")
        with open(path, "rb") as file:
            return file.read(most)


def checksum_of(*arrays: "np.ndarray") -> int:
    """Return the CRC-32 of arrays: of their shapes, types and bytes."""
    import numpy as np  # not at the top, because it would delay the help of commands

    checksum = 0
    for array in arrays:
        head = f"{array.shape}{array.dtype.str}".encode()
        checksum = crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data, crc32(head, checksum))
    return checksum


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path. Raises InputError if `replacing` cannot write a file there: callers ask before long work."""
    target = Path(path).absolute()  # the current folder may change
    with _reported(path, "written", BAD_NAMES):
        is_there = os.access(target, os.F_OK)  # raises ValueError for names that no system takes; Path.exists() hides it
        wrong = ("its folder does not exist" if not target.parent.is_dir() else "is a folder" if target.is_dir()
                 else "is no regular file" if is_there and not target.is_file()  # a device: replacing it would destroy its node
                 else "is write-protected" if is_there and not os.access(target, os.W_OK)
                 else "its folder is write-protected" if not os.access(target.parent, os.W_OK) else "")
    if wrong:
        raise InputError(wrong, path=path)
    return target


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to a file by `replacing`."""
    with replacing(path) as file:
        file.write(data)


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a new file in the folder of `path` for reading and writing; after the block, rename it to `path`.

    After any failure the new file is removed, and an existing file at `path` is unchanged. Raises InputError if the system refuses."""
    target = check_writable(path)
    # With the suffix of the target, by which OpenImageIO chooses the format. Files of tempfile would be readable by the user alone.
    temporary = target.with_name(f".wrt-{uuid.uuid4().hex}{target.suffix}")
    with _reported(path, "written"):
        try:
            with open(temporary, "x+b") as file:  # Windows renames only closed files
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def _reported(path: str | os.PathLike[str] | None, what: str, kinds: tuple[type[Exception], ...] = (OSError,)) -> Iterator[None]:
    """Turn an error of the system in the block into an InputError. what: "read" or "written"."""
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        raise InputError(f"cannot be {what}: {getattr(error, 'strerror', None) or error}", path=path) from error


# --- checked files of arrays: a line with the kind of file, a line of JSON, the bytes of the arrays, and a CRC-32 of all these bytes. -
# The CRC-32 finds damage in a third of the time of a hash. Nothing in such a file is evaluated or unpickled.

CHECKSUM_BYTES = 4
MAX_HEADER = 1 << 16


def write_checked(file: BinaryIO, magic: bytes, header: JsonObject, parts: Iterable["bytes | np.ndarray"]) -> None:
    """Write a checked file. magic: the first line with its line end; header: at most MAX_HEADER bytes as JSON."""
    import numpy as np

    checksum = 0
    for part in (magic, json.dumps(header).encode() + b"\n", *parts):
        view = part if isinstance(part, bytes) else np.ascontiguousarray(part).reshape(-1).view(np.uint8).data
        checksum = crc32(view, checksum)
        file.write(view)
    file.write(checksum.to_bytes(CHECKSUM_BYTES, "big"))


@contextlib.contextmanager
def read_checked(path: str | os.PathLike[str], magic: bytes, what: str) -> Iterator[tuple[JsonObject, memoryview]]:
    """Yield the header and the bytes of the arrays. Raises InputError if the file is missing, damaged, or not of the kind `what`."""
    with at(path=path):
        data = memoryview(read_file(path))
        if not data[:len(magic)] == magic:
            raise InputError(f"is no {what} of this version")
        if crc32(data[:-CHECKSUM_BYTES]) != int.from_bytes(data[-CHECKSUM_BYTES:], "big"):
            raise InputError("is damaged: its checksum does not match its content")
        end = bytes(data[:len(magic) + MAX_HEADER]).find(b"\n", len(magic))
        try:
            header = json.loads(bytes(data[len(magic):end]))
        except (ValueError, RecursionError):
            header = None
        if not isinstance(header, dict):
            raise InputError(f"is no {what} of this version")
    yield header, data[end + 1:-CHECKSUM_BYTES]
