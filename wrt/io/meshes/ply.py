"""PLY files (Stanford polygon format), text and binary: positions, normals, texture coordinates, faces of any size, strips.

trimesh 5.2 is not used. It refuses binary files that mix triangles with other polygons ("unexpected length"). It puts the second halves
of all quads after all first halves, and recomputes the normals of files with texture coordinates.
"""

import io
import re
from array import array
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wrt.core.errors import InputError
from wrt.core.files import read_file, utf8
from wrt.io.mesh_file import RawMesh
from wrt.io.polygons import strip, triangulate
from wrt.io.text import as_number
from wrt.scene.values import near_zero

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float32": "f4", "float64": "f8",
}
_SIZES = [name for name, kind in _TYPES.items() if kind[0] != "f"]  # types of a list's length
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_UV_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))
_INDEX_NAMES = ("vertex_indices", "vertex_index")
BYTES_AT_ONCE = 1 << 18  # bytes of text that are read and converted together
_WORD = re.compile(rb"\S+")


class _Property(NamedTuple):
    name: str
    type: str  # NumPy's name without byte order
    count_type: str | None = None  # type of a list's length; None: not a list


@dataclass
class _Element:
    """An `element` of the header, such as "vertex", and its data."""

    name: str
    rows: int
    properties: list[_Property] = field(default_factory=list)
    values: dict[str, np.ndarray] = field(default_factory=dict)  # by property: the values of all rows in sequence
    counts: dict[str, np.ndarray] = field(default_factory=dict)  # by property: the number of values in each row


def read(path: Path) -> RawMesh:
    """Read the vertices and faces of a PLY file in the order of the file; faces of more than three corners are triangulated.

    The triangles of `tristrips` follow the faces; the index -1 begins a new strip. Vertex normals are nx, ny, nz. Texture coordinates
    are a vertex's u, v (or s, t, or with the prefix texture_ or texcoord_), else the `texcoord` lists of faces. A vertex becomes several
    if these lists disagree. Colours and other properties are not read. Raises InputError with the header's line, or with the
    element and row of a value that is missing, not a number, or out of range."""
    elements = {element.name: element for element in _Source(path).elements}
    if "vertex" not in elements or not {"x", "y", "z"} <= elements["vertex"].values.keys():
        raise InputError(f"has no vertices with x, y and z (its elements: {', '.join(elements) or 'none'})")
    vertex = elements["vertex"].values
    positions = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    corners, counts, texcoord = _faces(elements.get("face"), len(positions))
    if "tristrips" in elements:
        strips = _strips(elements["tristrips"], len(positions))
        corners, counts = np.concatenate([corners, strips]), np.concatenate([counts, np.full(len(strips) // 3, 3)])
        texcoord = None  # strips have none

    vertices, shifted = near_zero(positions, corners)
    finite = np.isfinite(vertices)
    if not finite.all() and len(bad := np.intersect1d(np.flatnonzero(~finite.all(axis=1)), corners)):
        raise InputError(f"position {vertices[bad[0]].tolist()} is not finite ({len(bad)} in all)", place=f"vertex {bad[0]}")

    normals = _columns(vertex, ("nx", "ny", "nz"))
    uvs = next((uv for names in _UV_NAMES if (uv := _columns(vertex, names)) is not None), None)
    if uvs is None and texcoord is not None:
        origin, corners, uvs = _split(corners, texcoord)
        vertices, normals = vertices[origin], normals[origin] if normals is not None else None
    return RawMesh(
        vertices=vertices,
        faces=corners.reshape(-1, 3) if (counts == 3).all() else corners[triangulate(corners, counts, vertices)[0]],
        normals=normals,
        uvs=np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1) if uvs is not None else None,
        incomplete=int(np.count_nonzero(counts < 3)),
        positions=len(vertices),
        origin=shifted,
    )


def _columns(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    if not all(name in columns for name in names):
        return None
    return np.stack([columns[name] for name in names], axis=1).astype(np.float64)


def _faces(face: _Element | None, vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the corners of all faces (C,), the corner count of each face (P,), and texture coordinates (C, 2) or None."""
    if face is None or face.rows == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), None
    corners, counts = _indices(face)
    corners = _within(corners, counts, vertices, "face")
    texcoord = None
    if "texcoord" in face.values and (face.counts["texcoord"] == 2 * counts).all():
        texcoord = face.values["texcoord"].reshape(-1, 2).astype(np.float64)
    return corners, counts, texcoord


def _strips(strips: _Element, vertices: int) -> np.ndarray:
    """Return the corners (3 T,) of the triangles of all strips."""
    if strips.rows == 0:
        return np.zeros(0, np.int64)
    indices, counts = _indices(strips)
    ends = indices == -1
    indices = _within(np.where(ends, 0, indices), counts, vertices, "tristrips")
    begin = np.union1d(np.cumsum(counts), np.flatnonzero(ends))
    runs = zip(np.split(indices, begin), np.split(ends, begin), strict=True)
    return np.concatenate([strip(run[~end]).reshape(-1) for run, end in runs])


def _indices(element: _Element) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertex indices of all rows of an element in sequence, and the number of indices in each row."""
    name = next((name for name in _INDEX_NAMES if name in element.values), None)
    if name is None:
        raise InputError(f"has no list {' or '.join(_INDEX_NAMES)}", place=f"element {element.name}")
    return element.values[name], element.counts[name]


def _within(values: np.ndarray, counts: np.ndarray, vertices: int, element: str) -> np.ndarray:
    """Return values as integers. Raises InputError, with the element and the row, for a value that is no index of a vertex."""
    with np.errstate(invalid="ignore"):
        indices: np.ndarray = values.astype(np.int32 if vertices < 1 << 31 else np.int64)
    if values.dtype.kind in "iu" and values.itemsize <= 4 and indices.min(initial=0) >= 0 and indices.max(initial=-1) < vertices:
        return indices
    wrong = (indices < 0) | (indices >= vertices) | (indices != values)
    if wrong.any():
        where = int(np.argmax(wrong))
        row = int(np.searchsorted(np.cumsum(counts), where, side="right"))
        raise InputError(f"index {values[where]:g}, but there are {vertices} vertices", place=f"{element} {row}")
    return indices


def _split(corners: np.ndarray, texcoord: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make a vertex of each distinct (vertex, u, v). Returns the old index of each new vertex, the new corners, and the new uvs."""
    rows, renumbered = np.unique(np.column_stack([corners, texcoord]), axis=0, return_inverse=True)
    return rows[:, 0].astype(np.int64), renumbered.reshape(-1), rows[:, 1:]


def _truncated(element: _Element, row: int) -> InputError:
    what = f"is truncated: the header announces {element.rows} rows, but the file ends in row {row}"
    return InputError(what, place=f"element {element.name}")


class _Source:
    """Reader of a PLY file's header and elements."""

    def __init__(self, path: Path) -> None:
        self.data = utf8(read_file(path))
        form, self.elements, self.at = self._header()
        self.order = _ORDERS[form]
        if form == "ascii":  # converted to a binary file of float64, which represents every index exactly
            self.data, self.at = self._numbers(), 0
            for element in self.elements:
                element.properties = [p._replace(type="f8", count_type=p.count_type and "f8") for p in element.properties]
        for element in self.elements:
            if element.rows and element.properties:
                self._read(element)

    def _header(self) -> tuple[str, list[_Element], int]:
        """Return the format, the elements without their values, and the offset of the data in bytes."""
        if not self.data.startswith(b"ply"):
            raise InputError("is not a PLY file: it does not begin with 'ply'")
        elements: list[_Element] = []
        form, begin = "", 0
        for number, line in enumerate(self.data[:1 << 20].splitlines(keepends=True), 1):
            begin += len(line)
            words = line.decode("latin-1").split()
            match words:
                case ["end_header"]:
                    break
                case [] | ["ply" | "comment" | "obj_info", *_]:
                    pass
                case ["format", name, *_] if name in _ORDERS:
                    form = name
                case ["element", name, rows] if rows.isdecimal() and len(rows) < 19:
                    elements.append(_Element(name, int(rows)))
                case ["property", "list", count, kind, name] if elements and count in _SIZES and kind in _TYPES:
                    elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count]))
                case ["property", kind, name] if elements and kind in _TYPES:
                    elements[-1].properties.append(_Property(name, _TYPES[kind]))
                case _:
                    raise InputError(f"cannot read {line[:60].decode('latin-1').strip()!r} in the header", place=f"line {number}")
        else:
            raise InputError("the header has no end_header", place=f"line {number}")
        if not form:
            raise InputError("the header has no line `format`")
        return form, elements, begin

    def _read(self, element: _Element) -> None:
        """Read all rows of an element at once if every list is as long as in the first row (nearly always), else row by row."""
        begin = self.at
        sizes = [len(part) for part in self._row(element, 0)]
        self.at = begin
        fields: list[tuple[str, int]] = []
        for p, size in zip(element.properties, sizes, strict=True):
            fields += [(p.count_type, 1), (p.type, size)] if p.count_type else [(p.type, 1)]
        table = self._table(fields, element.rows)
        if table is None or not self._take_table(element, table, sizes):
            self.at = begin
            rows = [self._row(element, row) for row in range(element.rows)]
            for i, p in enumerate(element.properties):
                element.values[p.name] = np.concatenate([row[i] for row in rows])
                element.counts[p.name] = np.array([len(row[i]) for row in rows], dtype=np.int64)

    def _take_table(self, element: _Element, table: list[np.ndarray], sizes: list[int]) -> bool:
        """Store the columns of a table in the element. Return False if a list has another length than in `sizes`."""
        columns = iter(table)
        for p, size in zip(element.properties, sizes, strict=True):
            if p.count_type and (next(columns) != size).any():
                return False
            element.values[p.name] = next(columns).reshape(-1)
            element.counts[p.name] = np.broadcast_to(np.int64(size), element.rows)
        return True

    def _row(self, element: _Element, row: int) -> list[np.ndarray]:
        """Return the values of each property in the next row."""
        parts = []
        for p in element.properties:
            size = 1
            if p.count_type:
                count = self._take(p.count_type, 1)
                if count is None:
                    raise _truncated(element, row)
                if not (0 <= count[0] < np.inf and count[0] == int(count[0])):
                    raise InputError(f"has a list of {count[0]:g} values", place=f"{element.name} {row}")
                size = int(count[0])
            values = self._take(p.type, size)
            if values is None:
                raise _truncated(element, row)
            parts.append(values)
        return parts

    def _take(self, kind: str, count: int) -> np.ndarray | None:
        """Return the next `count` values of a type, or None if the file ends before."""
        dtype = np.dtype(self.order + kind)
        if self.at + count * dtype.itemsize > len(self.data):
            return None
        self.at += count * dtype.itemsize
        return np.frombuffer(self.data, dtype, count, self.at - count * dtype.itemsize)

    def _table(self, fields: list[tuple[str, int]], rows: int) -> list[np.ndarray] | None:
        """Return an array (rows, n) for each field (type, n) of the next `rows` records, or None if the file ends before."""
        record = np.dtype([(f"f{i}", self.order + kind, (n,)) for i, (kind, n) in enumerate(fields)])
        if self.at + rows * record.itemsize > len(self.data):
            return None
        table = np.frombuffer(self.data, record, rows, self.at) if record.itemsize else np.zeros(rows, record)
        self.at += rows * record.itemsize
        return [table[f"f{i}"] for i in range(len(fields))]

    def _numbers(self) -> bytes:
        """Return the words of a text file as the bytes of float64 numbers."""
        numbers, stream = array("d"), io.BytesIO(self.data)
        stream.seek(self.at)
        while text := b"".join(stream.readlines(BYTES_AT_ONCE)):
            before, words = len(numbers), text.split()
            try:
                try:
                    numbers.extend(map(float, words))
                except ValueError:  # the numbers before the first odd word were appended
                    numbers.extend(map(as_number, words[len(numbers) - before:]))
            except InputError as error:
                bad = next(islice(_WORD.finditer(text), len(numbers) - before, None))
                line = self.data.count(b"\n", 0, stream.tell() - len(text) + bad.start()) + 1
                raise error.at(place=f"line {line}") from None
        return numbers.tobytes()
