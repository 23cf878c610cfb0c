"""Reading of untrusted files."""

import codecs
import os
import stat
from io import BufferedReader
from pathlib import Path

from wrt.core.errors import InputError


def open_regular(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a regular file for reading.

    Raises InputError, without the path, for a folder, and for a pipe or a device, which may never end. Raises OSError like `open`."""
    try:
        # Without O_NONBLOCK, opening a pipe waits until something writes to it.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError as error:  # a name with a zero byte in it
        raise InputError(f"cannot be read: {error}") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise InputError(f"cannot be read: {'Is a directory' if stat.S_ISDIR(mode) else 'no regular file'}")
    return open(descriptor, "rb")


def require_file(path: Path, what: str = "") -> None:
    """Raise InputError if there is no file at the path, or if the system cannot tell. what: end of the message."""
    try:
        there = path.exists()
    except OSError as error:  # a name too long, a folder that may not be looked into
        raise InputError(f"cannot be read: {error.strerror or error}", path=path) from None
    if not there:
        raise InputError(f"no such file{what}", path=path)


def read_file(path: str | os.PathLike[str]) -> bytes:
    """Return all bytes of a regular file. Raises InputError, without the path, if it cannot be read."""
    try:
        with open_regular(path) as file:
            return file.read(os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}") from None


def utf8(text: bytes) -> bytes:
    """Return a text file's bytes as UTF-8 without a byte order mark; a mark of UTF-16 or UTF-32 tells the file's encoding.

    Raises InputError, without the path, for text that is damaged.
    """
    for marks, encoding in (((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE), "utf-32"), ((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE), "utf-16")):
        if text.startswith(marks):
            try:
                return text.decode(encoding).encode()
            except UnicodeError as error:
                raise InputError(f"is damaged {encoding.upper()} text ({error})", hint="save it as UTF-8") from None
    return text.removeprefix(codecs.BOM_UTF8)
