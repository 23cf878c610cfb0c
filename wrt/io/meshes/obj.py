"""Wavefront OBJ text: positions, normals, texture coordinates and named groups of faces.

trimesh 5.2 is not used, because scene files refer to materials and to the order of faces. It sorts faces by material and loses the names
of materials without an .mtl file. It fails with an IndexError on relative indices (`f -4 -3 -2 -1`). If positions and normals have
separate indices, it keeps one normal for each position.
"""

import io
import re
from array import array
from collections import defaultdict
from itertools import count
from pathlib import Path
from typing import NoReturn

import numpy as np

from wrt.core.checks import short
from wrt.core.errors import InputError, warn
from wrt.core.files import read_file
from wrt.io.mesh_file import COMMENT, RawMesh, extend, triangulate
from wrt.scene.mesh import corner_normals
from wrt.scene.values import near_zero

# Keywords of the parts of a corner `v/vt/vn`, with the count of numbers that wrt reads from a line with that keyword.
_WIDTHS = {"v": 3, "vt": 2, "vn": 3}
_NAME_COMMENT = re.compile(r"\s#(?!\w).*", re.DOTALL)  # "Material #25" of 3ds Max and "#FF0000" are names
_GROUPS = ("usemtl", "g", "o")
_CORNER = "face corner {} is not v, v/vt, v//vn or v/vt/vn"


def _fail(line: int, message: str) -> NoReturn:
    raise InputError(message, place=f"line {line}")


class _Text:
    """Content of an OBJ file by keyword, with absolute indices."""

    def __init__(self) -> None:
        self.numbers = {key: array("d") for key in _WIDTHS}
        self.lines = {key: array("q") for key in _WIDTHS}
        self.counts, self.face_lines = array("q"), array("q")
        # Index of each distinct corner text, in the order of the file; and the index of every corner's text.
        self.distinct: dict[str, int] = defaultdict(count().__next__)
        self.corners = array("i")
        # For each keyword: the index of each distinct name ("" is 0); and for each span of polygons the first polygon and the index of
        # its name. If several spans begin at one polygon, the last one counts.
        self.names: dict[str, dict[str, int]] = {
            key: defaultdict(count(1).__next__, {"": 0}) for key in (*_GROUPS, "s")}
        self.spans = {key: (array("q"), array("i")) for key in self.names}
        self.absent: dict[str, None] = {}  # vt or vn, if faces refer to it and the file has no such lines

    def read(self, data: bytes) -> None:
        pending, number = "", 0  # pending: the lines before that end in a backslash
        for number, line in enumerate(io.TextIOWrapper(io.BytesIO(data), "utf-8-sig", "replace"), 1):
            line = pending + line.rstrip("\n")
            if "#" in line:
                line = (_NAME_COMMENT if line.split(None, 1)[0] in self.names else COMMENT).sub(" ", line)
            if line.endswith("\\"):
                pending = line[:-1] + " "
            else:
                self._line(line, number)
                pending = ""
        self._line(pending, number)

    def _line(self, line: str, number: int) -> None:
        words = line.split()
        if not words:
            return
        key = words[0]
        if key in _WIDTHS:
            self._numbers(key, words, number)
        elif key == "f":
            self._corners(words[1:], number)
        elif key in self.names:
            name = line.split(None, 1)[1].strip() if len(words) > 1 else ""
            self._span(key, "" if key == "s" and name.lower() in ("off", "0") else name)

    def _numbers(self, key: str, words: list[str], line: int) -> None:
        width = _WIDTHS[key]
        values = words[1:width + 1]
        if len(values) < width:
            if key != "vt" or not values:
                _fail(line, f"{key} needs {width} numbers, got {len(values)}")
            values.append("0")  # a 1D texture coordinate
        self.lines[key].append(line)
        try:
            extend(self.numbers[key], values)
        except InputError as error:
            raise error.at(place=f"line {line}") from None

    def _corners(self, corners: list[str], line: int) -> None:
        if "-" in "".join(corners):
            corners = [self._absolute(corner, line) for corner in corners]
        self.counts.append(len(corners))
        self.face_lines.append(line)
        self.corners.extend(map(self.distinct.__getitem__, corners))

    def _span(self, key: str, name: str) -> None:
        starts, name_index = self.spans[key]
        starts.append(len(self.counts))
        name_index.append(self.names[key][name])

    def _absolute(self, corner: str, line: int) -> str:
        """Replace relative indices in a corner (-1 is the latest element) by absolute indices (1 is the first element)."""
        parts = corner.split("/")
        for i, (part, key) in enumerate(zip(parts, _WIDTHS, strict=False)):
            if part.startswith("-"):
                count = len(self.lines[key])
                try:
                    index = int(part)
                except ValueError:
                    _fail(line, _CORNER.format(short(corner)))
                if not count and key != "v":
                    continue  # lines may follow; if none does, `triples` leaves the index out
                if not -count <= index < 0:
                    _fail(line, f"face corner {short(corner)}: {key} index {short(index)}, but only {count} {key} lines before it")
                parts[i] = str(count + 1 + index)
        return "/".join(parts)

    def array(self, key: str) -> np.ndarray:
        """Return the numbers of all `key` lines, (N, 2 or 3) float64."""
        return np.frombuffer(self.numbers[key], np.float64).reshape(-1, _WIDTHS[key])

    def triples(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the distinct corners (U, 3) int64, as zero-based v, vt, vn (-1: none), and each corner's row in that array, (C,) int32.

        The rows are sorted by v first, so that the vertices keep the order of the file."""
        index = np.frombuffer(self.corners, np.int32)
        triples = np.zeros((len(self.distinct), 3), dtype=np.int64)
        keys = list(_WIDTHS)
        for i, corner in enumerate(self.distinct):
            for k, part in enumerate(corner.split("/")):
                if k > 2 or (k == 0 and not part):
                    _fail(self._first_line(index, i), _CORNER.format(short(corner)))
                if part and k and not self.lines[keys[k]] and part.removeprefix("-").isdecimal():
                    self.absent[keys[k]] = None
                elif part:
                    number = int(part) if part.isdecimal() and len(part) < 19 else 0
                    triples[i, k] = number
                    if not 1 <= number <= len(self.lines[keys[k]]):
                        _fail(self._first_line(index, i), f"face corner {short(corner)}: {keys[k]} index {part[:30]} is not "
                                                              f"in 1 to {len(self.lines[keys[k]])}")
        order = np.lexsort(triples.T[::-1])
        rank = np.empty(len(order), dtype=np.int32)
        rank[order] = np.arange(len(order))
        return triples[order] - 1, rank[index]

    def _first_line(self, index: np.ndarray, corner: int) -> int:
        face = np.searchsorted(np.cumsum(self.counts), np.argmax(index == corner), side="right")
        return self.face_lines[int(face)]

    def groups(self) -> tuple[tuple[str, ...], np.ndarray | None]:
        """Return the groups by `usemtl`, else by `g`, else by `o`: their names, and the group's index of each polygon (None: no groups)."""
        key = next((key for key in _GROUPS if self.spans[key][0]), None)
        if key is None:
            return (), None
        names = list(self.names[key])
        used, polygon_group = np.unique(self.of_polygon(key), return_inverse=True)
        return tuple(names[i] for i in used), polygon_group

    def of_polygon(self, key: str) -> np.ndarray:
        """Return the index of each polygon's name by `key` lines, (P,); 0 if there is none."""
        starts, name_index = self.spans[key]
        of_span = np.concatenate([np.zeros(1, np.int32), np.frombuffer(name_index, np.int32)])
        return of_span[np.searchsorted(starts, np.arange(len(self.counts)), side="right")]


def read(path: Path) -> RawMesh:
    """Read the faces of an OBJ file in the order of the file; nothing is merged.

    Each distinct combination of position, texture coordinate and normal becomes a vertex. A corner without a normal in a smoothing group
    (`s 1`) gets the average normal of the group's faces at its position, weighted by their angle; others get a zero normal (flat
    shading). A corner without a texture coordinate gets (0, 0). If faces refer to vt or vn lines and the file has none, these indices are
    left out with a SceneWarning. Groups are the spans of `usemtl`, else of `g`, else of `o`; faces before the first span
    are in the group "". Vertex colours, lines, points and curves are not read. Raises InputError with the line for words that are no
    numbers, indices out of range and positions that are not finite."""
    text = _Text()
    text.read(read_file(path))
    positions = text.array("v")
    corner_triples, corners = text.triples()
    text.distinct.clear()
    if text.absent:
        warn(f"{path}: the indices of {' and '.join(text.absent)} in its faces are left out: the file has no such lines")
    counts = np.array(text.counts, dtype=np.int64)

    vertices, origin = near_zero(positions[corner_triples[:, 0]])
    bad = np.nonzero(~np.isfinite(vertices).all(axis=1))[0]
    if len(bad):
        v = int(corner_triples[bad[0], 0])
        _fail(text.lines["v"][v], f"position {positions[v].tolist()} is not finite ({len(bad)} in all)")

    triangles, polygon = triangulate(corners, counts, vertices)
    vn = text.array("vn")
    if len(text.names["s"]) > 1 and (corner_triples[:, 2] < 0).any():
        smoothing = np.repeat(text.of_polygon("s"), counts)
        source, corners, corner_triples, vn = _smoothed(smoothing, corners, corner_triples, triangles, vertices[corners[triangles]], vn)
        vertices = vertices[source]
    groups, polygon_group = text.groups()
    uvs, flipped = _gather(text.array("vt"), corner_triples[:, 1]), corner_triples[:, 1] >= 0
    if uvs is not None:
        uvs[flipped] = uvs[flipped] * (1.0, -1.0) + (0.0, 1.0)
    return RawMesh(
        vertices=vertices,
        faces=corners[triangles],
        normals=_gather(vn, corner_triples[:, 2]),
        uvs=uvs,
        groups=groups,
        face_group=polygon_group[polygon] if polygon_group is not None else None,
        incomplete=int(np.count_nonzero(counts < 3)),
        positions=len(positions),
        origin=origin,
    )


def _smoothed(group: np.ndarray, corners: np.ndarray, triples: np.ndarray, triangles: np.ndarray, points: np.ndarray,
              vn: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Give corners of smoothing groups without a normal the normal of their position in their group.

    group: (C,), 0 is none; triangles: (T, 3) indices of corners; points: their positions. Returns the old index of each new vertex, the
    corners as indices of these vertices, the triples of these vertices, and the normals."""
    places, place = np.unique(group.astype(np.int64) * (triples[:, 0].max(initial=0) + 1) + triples[corners, 0], return_inverse=True)
    normal = triples[corners, 2]
    normal = np.where((normal < 0) & (group > 0), len(vn) + place, normal)
    vn = np.concatenate([vn, corner_normals(points, place[triangles], len(places))])
    _, first, renumbered = np.unique(corners.astype(np.int64) * (len(vn) + 1) + normal, return_index=True, return_inverse=True)
    triples = np.column_stack([triples[corners[first], :2], normal[first]])
    return corners[first], renumbered, triples, vn


def _gather(values: np.ndarray, index: np.ndarray) -> np.ndarray | None:
    """Return values[index], with zeros for an index of -1; None if all are -1."""
    if not (index >= 0).any():
        return None
    return np.where((index >= 0)[:, None], values[index], 0.0)
