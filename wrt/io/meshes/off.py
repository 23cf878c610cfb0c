"""OFF files: text, with the keyword OFF, or with colours (C), normals (N) and texture coordinates (ST) of vertices, which are not read."""

import io
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from wrt.core.checks import short
from wrt.core.errors import InputError
from wrt.core.files import read_file, utf8
from wrt.io.mesh_file import RawMesh
from wrt.io.polygons import triangulate
from wrt.io.text import as_number, without_comment

T = TypeVar("T", int, float)
Lines: TypeAlias = Iterator[tuple[int, list[str]]]  # number of a line, and its words
_KEYWORD = re.compile(r"(?:(?:ST|C|N)*OFF|off)?(\d*)")  # it may be missing; in ModelNet's files the first count follows without a space


def read(path: Path) -> RawMesh:
    """Read the vertices and faces of an OFF file in the order of the file. Colours, normals and texture coordinates are not read.

    Raises InputError with the line for a file that is truncated or no text, words that are no numbers, indices out of range and
    positions that are not finite."""
    texts = enumerate(io.TextIOWrapper(io.BytesIO(utf8(read_file(path))), "utf-8", "replace"), 1)
    lines = [(number, words) for number, line in texts if (words := without_comment(line).split())]
    keyword = _KEYWORD.fullmatch(lines[0][1][0]) if lines else None
    if keyword is None or "BINARY" in lines[0][1]:
        raise InputError("is no OFF file: its first word must be OFF", hint="binary OFF, 4OFF and nOFF are not read")
    number, words = lines[0][0], [*filter(None, keyword.groups()), *lines[0][1][1:]]
    rest = iter([*([(number, words)] if words else []), *lines[1:]])
    n_vertices, n_faces = _numbers(rest, 2, "the numbers of vertices and faces", int)
    if not (0 <= n_vertices and 0 <= n_faces and n_vertices + n_faces <= len(lines)):
        raise InputError(f"ends too early: {short(n_vertices)} vertices and {short(n_faces)} faces in {len(lines)} lines")
    vertices = np.array([_numbers(rest, 3, "a vertex", as_number) for _ in range(n_vertices)], np.float64).reshape(-1, 3)
    corners: list[int] = []
    counts: list[int] = []
    for _ in range(n_faces):
        face = _face(rest, n_vertices)
        corners += face
        counts.append(len(face))
    triangles, _ = triangulate(np.array(corners, np.int64), np.array(counts, np.int64), vertices)
    return RawMesh(vertices, np.array(corners, np.int64)[triangles], incomplete=sum(count < 3 for count in counts), positions=n_vertices)


def _numbers(lines: Lines, count: int, what: str, kind: Callable[[str], T]) -> list[T]:
    """Return the first `count` numbers of the next line."""
    number, words = _next(lines, what)
    try:
        values = [kind(word) for word in words[:count]]
    except ValueError:
        raise InputError(f"{what} must be numbers with a decimal point, got {short(' '.join(words))}", place=f"line {number}") from None
    if len(values) < count or not np.isfinite(np.asarray(values, np.float64).astype(np.float32)).all():
        raise InputError(f"{what} must be {count} finite numbers", place=f"line {number}")
    return values


def _face(lines: Lines, n_vertices: int) -> list[int]:
    """Return the corners of the face in the next line."""
    number, words = _next(lines, "a face")
    try:
        count, *corners = map(int, words[:1 + max(int(words[0]), 0)])
    except ValueError:
        raise InputError("the corners of a face must be whole numbers", place=f"line {number}") from None
    if len(corners) != count:
        raise InputError(f"a face needs {short(count)} corners, got {len(corners)}", place=f"line {number}")
    if corners and not 0 <= min(corners) <= max(corners) < n_vertices:
        raise InputError(f"a face has a corner that is none of the {n_vertices} vertices", place=f"line {number}")
    return corners


def _next(lines: Lines, what: str) -> tuple[int, list[str]]:
    """Return the number and the words of the next line."""
    line = next(lines, None)
    if line is None:
        raise InputError(f"ends too early: {what} is missing")
    return line
