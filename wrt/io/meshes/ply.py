"""PLY files (Stanford polygon format), text and binary: positions, normals, texture coordinates, faces of any size, strips.

trimesh 5.2 is not used. It refuses binary files that mix triangles with other polygons ("unexpected length"). It puts the second halves
of all quads after all first halves, and recomputes the normals of files with texture coordinates.
"""

import codecs
import io
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wrt.core.errors import InputError
from wrt.core.files import read_file
from wrt.io.mesh_file import RawMesh, extend, strip, triangulate
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
    elements = {element.name: element for element in _Source(read_file(path).removeprefix(codecs.BOM_UTF8)).elements}
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


class _Source:
    """Reader of a PLY file's header and elements."""

    def __init__(self, data: bytes) -> None:
        form, self.elements, self.at, lines = _header(data)
        self.data, self.order = data, _ORDERS[form]
        if form == "ascii":  # converted to a binary file of float64, which represents every index exactly
            self.data, self.at = _numbers(data[self.at:], lines + 1), 0
            for element in self.elements:
                element.properties = [p._replace(type="f8", count_type=p.count_type and "f8") for p in element.properties]
        for element in self.elements:
            if element.rows and element.properties:
                self._read(element)

    def _read(self, element: _Element) -> None:
        """Read the rows of an element in runs: rows whose lists have the lengths of the first of them (nearly always, that is all rows)."""
        parts = [(p.name, list[np.ndarray](), list[np.ndarray]()) for p in element.properties]  # name, values, counts
        row, most = 0, element.rows
        while row < element.rows:
            sizes = self._sizes(element, row)
            fields: list[tuple[str, str, tuple[int, ...]]] = []
            for i, (p, size) in enumerate(zip(element.properties, sizes, strict=True)):
                fields += [(f"count{i}", self.order + p.count_type, ())] if p.count_type else []
                fields.append((f"value{i}", self.order + p.type, (size,)))
            record = np.dtype(fields)
            rows = min(element.rows - row, most, (len(self.data) - self.at) // record.itemsize)
            table = np.frombuffer(self.data, record, rows, self.at)
            same = np.ones(rows, dtype=bool)
            for i, size in enumerate(sizes):
                if f"count{i}" in record.fields:  # type: ignore[operator]
                    same &= table[f"count{i}"] == size
            run = rows if same.all() else int(np.argmin(same))
            for i, (_, values, counts) in enumerate(parts):
                values.append(table[f"value{i}"][:run].reshape(-1))
                counts.append(np.broadcast_to(np.int64(sizes[i]), run))
            most = 2 * most if run == rows else 16  # in a mix of lengths, few rows are compared in vain
            row, self.at = row + run, self.at + run * record.itemsize
        for name, values, counts in parts:
            element.values[name], element.counts[name] = np.concatenate(values), np.concatenate(counts)

    def _sizes(self, element: _Element, row: int) -> list[int]:
        """Return the number of values of each property in the row that begins at `at`."""
        sizes, at = [], self.at
        for p in element.properties:
            size = 1
            if p.count_type:
                kind = np.dtype(self.order + p.count_type)
                count = np.frombuffer(self.data[at:at + kind.itemsize].ljust(kind.itemsize, b"\0"), kind)[0]
                if not (0 <= count < np.inf and count == int(count)):
                    raise InputError(f"has a list of {count:g} values", place=f"{element.name} {row}")
                size, at = int(count), at + kind.itemsize
            sizes.append(size)
            at += size * np.dtype(p.type).itemsize
        if at > len(self.data):
            what = f"is truncated: the header announces {element.rows} rows, but the file ends in row {row}"
            raise InputError(what, place=f"element {element.name}")
        return sizes


def _header(data: bytes) -> tuple[str, list[_Element], int, int]:
    """Return the format, the elements without their values, the offset of the data in bytes, and the number of lines before it."""
    if not data.startswith(b"ply"):
        raise InputError("is not a PLY file: it does not begin with 'ply'")
    elements: list[_Element] = []
    form, begin = "", 0
    for number, line in enumerate(data[:1 << 20].splitlines(keepends=True), 1):
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
    return form, elements, begin, number


def _numbers(text: bytes, first: int) -> bytes:
    """Return the words of a text as the bytes of float64 numbers. first: the number of its first line in the file."""
    numbers = array("d")
    for line, words in enumerate(io.BytesIO(text), first):
        try:
            extend(numbers, words.split())
        except InputError as error:
            raise error.at(place=f"line {line}") from None
    return numbers.tobytes()
