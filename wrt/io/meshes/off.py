"""OFF files: text, with the keyword OFF, or with colours (C), normals (N) and texture coordinates (ST) of vertices, which are not read."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from wrt.core.checks import short
from wrt.core.errors import InputError, at
from wrt.core.files import read_file
from wrt.io.mesh_file import COMMENT, RawMesh, as_number, triangulate

T = TypeVar("T", int, float)
Row: TypeAlias = tuple[int, list[str]]  # number of a line, and its words
_KEYWORD = re.compile(r"(?:(?:ST|C|N)*OFF|off)?(\d*)")  # it may be missing; in ModelNet's files the first count follows without a space


def read(path: Path) -> RawMesh:
    """Read the vertices and faces of an OFF file in the order of the file. Colours, normals and texture coordinates are not read.

    Raises InputError with the line for words that are no numbers, indices out of range and positions that are not finite."""
    lines = enumerate(read_file(path).decode("utf-8-sig", "replace").splitlines(), 1)
    rows = [(number, words) for number, line in lines if (words := COMMENT.sub("", line).split())]
    keyword = _KEYWORD.fullmatch(rows[0][1][0]) if rows else None
    if keyword is None or "BINARY" in rows[0][1]:
        raise InputError("is no OFF file: its first word must be OFF", hint="binary OFF, 4OFF and nOFF are not read")
    number, words = rows[0]
    head = [*filter(None, keyword.groups()), *words[1:]]
    rows[:1] = [(number, head)] if head else []
    n_vertices, n_faces = _numbers(rows[0] if rows else (number, []), 2, _whole)
    if 1 + n_vertices + n_faces > len(rows):
        raise InputError(f"ends too early: {short(n_vertices)} vertices and {short(n_faces)} faces in {len(rows) - 1} lines")
    vertices = np.array([_numbers(row, 3, as_number) for row in rows[1:1 + n_vertices]], np.float64).reshape(-1, 3)
    faces = rows[1 + n_vertices:1 + n_vertices + n_faces]
    corners = [_numbers(row, 1 + _numbers(row, 1, _whole)[0], _whole)[1:] for row in faces]
    for (number, _), face in zip(faces, corners, strict=True):
        if max(face, default=-1) >= n_vertices:
            raise InputError(f"a face has a corner that is none of the {n_vertices} vertices", place=f"line {number}")
    with np.errstate(over="ignore"):
        finite = np.isfinite(vertices.astype(np.float32)).all(axis=1)
    if not finite.all():
        raise InputError("a vertex is not finite", place=f"line {rows[1 + int(np.argmin(finite))][0]}")
    counts, flat = np.array([len(face) for face in corners], np.int64), np.array([i for face in corners for i in face], np.int64)
    return RawMesh(vertices, flat[triangulate(flat, counts, vertices)[0]], incomplete=int((counts < 3).sum()), positions=n_vertices)


def _numbers(row: Row, count: int, kind: Callable[[str], T]) -> list[T]:
    """Return the first `count` numbers of a line."""
    line, words = row
    with at(f"line {line}"):
        if len(words) < count:
            raise InputError(f"needs {short(count)} numbers, got {len(words)}")
        return [kind(word) for word in words[:count]]


def _whole(word: str) -> int:
    if not word.isdecimal() or len(word) > 18:
        raise InputError(f"{short(word)} is no count or index")
    return int(word)
