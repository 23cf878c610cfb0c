"""Checked files of arrays: a line with the kind of file, a line of JSON, the bytes of the arrays, and a checksum of all these bytes.

The checksum is a CRC-32, which finds damage in a third of the time of a hash. Nothing in such a file is evaluated or unpickled."""

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import BinaryIO
from zlib import crc32

import numpy as np

from wrt.core.errors import InputError, at
from wrt.core.files import read_file
from wrt.core.types import JsonObject

CHECKSUM_BYTES = 4
MAX_HEADER = 1 << 16


def write_checked(file: BinaryIO, magic: bytes, header: JsonObject, parts: Iterable[bytes | np.ndarray]) -> None:
    """Write a checked file. magic: the first line with its line end; header: at most MAX_HEADER bytes as JSON."""
    checksum = 0
    for part in (magic, json.dumps(header).encode() + b"\n", *parts):
        view = part if isinstance(part, bytes) else np.ascontiguousarray(part).reshape(-1).view(np.uint8).data
        checksum = crc32(view, checksum)
        file.write(view)
    file.write(checksum.to_bytes(CHECKSUM_BYTES, "big"))


def is_whole(data: memoryview) -> bool:
    """Return whether a file's content matches its checksum."""
    return crc32(data[:-CHECKSUM_BYTES]) == int.from_bytes(data[-CHECKSUM_BYTES:], "big")


@contextmanager
def read_checked(path: str | os.PathLike[str], magic: bytes, what: str) -> Iterator[tuple[JsonObject, memoryview]]:
    """Yield the header and the bytes of the arrays. Raises InputError if the file is missing, damaged, or not of the kind `what`."""
    with at(path=path):
        data = memoryview(read_file(path))
        if not data[:len(magic)] == magic:
            raise InputError(f"is no {what} of this version")
        if not is_whole(data):
            raise InputError("is damaged: its checksum does not match its content")
        end = bytes(data[:len(magic) + MAX_HEADER]).find(b"\n", len(magic))
        try:
            header = json.loads(bytes(data[len(magic):end]))
        except (ValueError, RecursionError):
            header = None
        if not isinstance(header, dict):
            raise InputError(f"is no {what} of this version")
    yield header, data[end + 1:-CHECKSUM_BYTES]
