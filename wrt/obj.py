"""Wavefront OBJ text: positions, normals, texture coordinates and named groups of faces.

Why not trimesh: measured with 5.2, it fails with an IndexError on relative indices (`f
-4 -3 -2 -1`), loses the names of materials whose .mtl is missing, sorts the faces by material, and where positions
and normals are indexed apart it keeps one normal for each position. A material's faces, and their order, are what a
scene file refers to.
"""

from __future__ import annotations

import os
from itertools import chain
from pathlib import Path
from typing import NoReturn

import numpy as np

from wrt.arguments import short
from wrt.errors import InputError
from wrt.mesh import RawMesh
from wrt.polygons import triangulate
from wrt.read_file import read_file

# What stands in a corner `v/vt/vn`, and how many numbers of a line of it are kept.
_KEEP = {"v": 3, "vt": 2, "vn": 3}
BYTES_OF_TEXT = 25.0  # of memory that a byte of the file takes, measured on meshes
_CORNER = "face corner {} is not v, v/vt, v//vn or v/vt/vn"


class _Text:
    """The lines of one OBJ file, sorted by what they are; indices are absolute from here on."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.numbers: dict[str, list[str]] = {key: [] for key in _KEEP}
        self.lines: dict[str, list[int]] = {key: [] for key in _KEEP}
        self.corners: list[str] = []
        self.counts: list[int] = []
        self.face_lines: list[int] = []
        # of each keyword: (number of the first polygon, name) of every span
        self.spans: dict[str, list[tuple[int, str]]] = {"usemtl": [], "g": [], "o": []}

    def fail(self, line: int, message: str) -> NoReturn:
        raise InputError(message, self.path, f"line {line}")

    def read(self, text: str) -> None:
        pending = ""
        for number, line in enumerate(text.split("\n"), 1):
            if pending:
                line, pending = pending + line, ""
            if line.endswith("\\"):
                pending = line[:-1] + " "
                continue
            words = line.partition("#")[0].split() if "#" in line else line.split()
            if not words:
                continue
            key = words[0]
            if key in _KEEP:
                self._numbers(key, words, number)
            elif key == "f":
                self._face(words[1:], number)
            elif key in self.spans:
                self.spans[key].append((len(self.counts), line.split(None, 1)[1].strip() if len(words) > 1 else ""))

    def _numbers(self, key: str, words: list[str], line: int) -> None:
        keep = _KEEP[key]
        given = words[1:keep + 1]
        if len(given) < keep:
            if key != "vt" or not given:
                self.fail(line, f"{key} needs {keep} numbers, got {len(given)}")
            given = [*given, "0"]  # a 1D texture coordinate
        self.numbers[key] += given
        self.lines[key].append(line)

    def _face(self, corners: list[str], line: int) -> None:
        if any("-" in corner for corner in corners):
            corners = [self._absolute(corner, line) for corner in corners]
        self.corners += corners
        self.counts.append(len(corners))
        self.face_lines.append(line)

    def _absolute(self, corner: str, line: int) -> str:
        """A corner with relative indices (-1 is the latest) in absolute ones (1 is the first)."""
        parts = corner.split("/")
        for i, (part, key) in enumerate(zip(parts, _KEEP, strict=False)):
            if part.startswith("-"):
                count = len(self.lines[key])
                index = self.integer(part, corner, line)
                if not -count <= index < 0:
                    self.fail(line, f"face corner {short(corner)}: {key} index {short(index)}, but only {count} {key} stand before")
                parts[i] = str(count + 1 + index)
        return "/".join(parts)

    def integer(self, part: str, corner: str, line: int) -> int:
        try:
            return int(part)
        except ValueError:
            self.fail(line, _CORNER.format(short(corner)))

    def array(self, key: str) -> np.ndarray:
        """(N, 2 or 3) float64 of all `key` lines."""
        try:
            values = np.fromiter(map(float, self.numbers[key]), np.float64, len(self.numbers[key]))
        except ValueError:
            keep = _KEEP[key]
            for i, number in enumerate(self.numbers[key]):
                try:
                    float(number)
                except ValueError:
                    self.fail(self.lines[key][i // keep], f"{key} holds {short(number)}, which is not a number")
            raise
        return values.reshape(-1, _KEEP[key])

    def line_of_corner(self, corner: int) -> int:
        return self.face_lines[int(np.searchsorted(np.cumsum(self.counts), corner, side="right"))]

    def triples(self) -> tuple[np.ndarray, np.ndarray]:
        """(U, 3) int64: every different corner as zero-based v, vt, vn (-1: not given); (C,) which one each corner is.

        They are sorted by v first, so that the vertices keep the order of the file.
        """
        place = {corner: i for i, corner in enumerate(dict.fromkeys(self.corners))}
        index = np.fromiter(map(place.__getitem__, self.corners), np.int64, len(self.corners))
        different = np.zeros((len(place), 3), dtype=np.int64)
        keys = list(_KEEP)
        for corner, i in place.items():
            for k, part in enumerate(corner.split("/")):
                if k > 2 or (k == 0 and not part):
                    self.fail(self._first_line(index, i), _CORNER.format(short(corner)))
                if part:
                    number = int(part) if part.isdecimal() and len(part) < 19 else 0
                    different[i, k] = number
                    if not 1 <= number <= len(self.lines[keys[k]]):
                        self.fail(self._first_line(index, i), f"face corner {short(corner)}: {keys[k]} index {part[:30]} is not "
                                                              f"in 1 to {len(self.lines[keys[k]])}")
        order = np.lexsort(different.T[::-1])
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        return different[order] - 1, rank[index]

    def _first_line(self, index: np.ndarray, corner: int) -> int:
        return self.line_of_corner(int(np.argmax(index == corner)))

    def groups(self) -> tuple[tuple[str, ...], np.ndarray | None]:
        """Names of the parts and the part of each polygon: by material, else by group, else by object; () where
        none."""
        spans = next((self.spans[key] for key in ("usemtl", "g", "o") if self.spans[key]), [])
        if not spans:
            return (), None
        starts = np.array([first for first, _ in spans])
        names = list(dict.fromkeys(chain([""], (name for _, name in spans))))
        number = {name: i for i, name in enumerate(names)}
        numbers = np.array([0, *(number[name] for _, name in spans)])
        polygon_group = numbers[np.searchsorted(starts, np.arange(len(self.counts)), side="right")]
        used, polygon_group = np.unique(polygon_group, return_inverse=True)
        return tuple(names[i] for i in used), polygon_group


def read_obj(path: str | os.PathLike[str]) -> RawMesh:
    """Read the faces of an OBJ file as it has them: nothing is merged or put in another order.

    Each different combination of position, texture coordinate and normal becomes one vertex. A corner without a
    normal gets a zero normal (flat there), one without a texture coordinate (0, 0). Faces with fewer than three
    corners are left out and counted. Groups are the spans of `usemtl`, else of `g`, else of `o`; faces before the
    first have the name "". Vertex colours, lines, points and curves are not read. Raises InputError with the line's
    number for numbers that are none, indices out of range and positions that are not finite.
    """
    text = _Text(Path(path))
    text.read(read_file(path, BYTES_OF_TEXT).decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n"))
    positions = text.array("v")
    corner_triples, corners = text.triples()
    counts = np.array(text.counts, dtype=np.int64)

    with np.errstate(over="ignore"):
        vertices = positions.astype(np.float32)[corner_triples[:, 0]]
    bad = np.nonzero(~np.isfinite(vertices).all(axis=1))[0]
    if len(bad):
        v = int(corner_triples[bad[0], 0])
        text.fail(text.lines["v"][v], f"position {positions[v].tolist()} is not finite ({len(bad)} in all)")

    triangles, polygon = triangulate(corners, counts, vertices)
    groups, polygon_group = text.groups()
    return RawMesh(
        vertices=vertices,
        faces=corners[triangles],
        normals=_gather(text.array("vn"), corner_triples[:, 2]),
        uvs=_gather(text.array("vt") * (1.0, -1.0) + (0.0, 1.0), corner_triples[:, 1]),
        groups=groups,
        face_group=polygon_group[polygon] if polygon_group is not None else None,
        incomplete=int(np.count_nonzero(counts < 3)),
        positions=len(positions),
    )


def _gather(values: np.ndarray, index: np.ndarray) -> np.ndarray | None:
    """values[index], with a row of zeros where the index is -1; None where that is everywhere."""
    if not (index >= 0).any():
        return None
    return np.where((index >= 0)[:, None], values[index], 0.0)
