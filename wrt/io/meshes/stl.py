"""STL files, text and binary.

trimesh 5.2 is not used. It leaves out the triangles before a missing `endsolid`, and logs a traceback for each facet normal that is no
number. It lets NumPy warn of positions that are not finite.
"""

import codecs
import re
from array import array
from pathlib import Path

import numpy as np

from wrt.core.errors import InputError, warn
from wrt.core.files import read_file
from wrt.io.mesh_file import RawMesh, extend

# Line breaks may stand between any two words. What is between these statements is not read: loops, normals, colours, comments.
_STATEMENT = re.compile(rb"""
    \bvertex\s+(\S+)\s+(\S+)\s+(\S+) | \b(facet)\b | \b(end\s*facet)\b | \b(end\s*solid)\b[^\r\n]*
  | \bsolid\b([^\r\n]*?)(?=\sfacet\b|[\r\n]|\Z) | \#[^\r\n]*""", re.IGNORECASE | re.VERBOSE)
_LINE_END = re.compile(rb"\r\n?|\n")
_BLANK = b"\0\t\n\r\x1a "  # what may follow a file's content
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(path: Path) -> RawMesh:
    """Read the triangles of an STL file in the order of the file. Triangles share no vertices.

    The solids of a text file become groups by their names. Facet normals are not read, because the winding gives the same direction. A
    missing endsolid, and a binary file that is longer than its header announces, get a SceneWarning. Raises InputError for a file that is
    truncated or no STL file, and for a position that is not finite."""
    data = read_file(path)
    groups: dict[str, int] = {}
    group = np.zeros(0, np.int64)
    fits = len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
    if fits or b"\0" in data[80:134]:  # a text has no zero byte; in a binary file, the count and the first triangle do
        vertices = np.frombuffer(data, _RECORD, _count(data, path), 84)["corners"].reshape(-1, 3)
    else:
        vertices, groups, group = _read_text(data.removeprefix(codecs.BOM_UTF8), path)
    with np.errstate(over="ignore"):
        bad = np.nonzero(~np.isfinite(vertices.astype(np.float32)).all(axis=1))[0]
    if len(bad):
        raise InputError(f"position {vertices[bad[0]].tolist()} is not finite ({len(bad)} in all)", place=f"triangle {bad[0] // 3}")
    named = len(groups) > 1
    return RawMesh(vertices, np.arange(len(vertices)).reshape(-1, 3), groups=tuple(groups) if named else (),
                   face_group=group if named else None, positions=len(vertices))


def _count(data: bytes, path: Path) -> int:
    """Return the number of triangles of a binary file: those announced, or more if whole triangles follow."""
    count, whole = int.from_bytes(data[80:84], "little"), (len(data) - 84) // 50
    size = 84 + 50 * count
    if len(data) < size or data[size:].strip(_BLANK):
        says = f"announces {count} triangles ({size} bytes), but has {len(data)} bytes"
        count = count if whole < count or data[84 + 50 * whole:].strip(_BLANK) else whole
        if whole < count or not count:
            raise InputError(f"is truncated or no STL file: as a binary STL file it {says}")
        warn(f"{path}: {says}; {count} triangles are read")
    return count


def _read_text(data: bytes, path: Path) -> tuple[np.ndarray, dict[str, int], np.ndarray]:
    """Return positions (3 T, 3) float64, the indices of the solids by name, and the index of each triangle's solid."""
    numbers, owners = array("d"), array("q")
    names: dict[str, int] = {}
    solid, unclosed, is_open = -1, 0, False  # solid: index of the open one, -1: none; is_open: a facet begins and does not end
    for found in _STATEMENT.finditer(data):
        if found.lastindex is None:  # a comment
            continue
        x, y, z, facet, end_facet, end_solid, name = found.groups()
        try:
            if x and solid < 0:
                raise InputError("a vertex is outside of a solid")
            if x:
                extend(numbers, (x, y, z))
            elif len(numbers) - 9 * len(owners) != (9 if end_facet else 0):
                raise InputError("a facet must have three vertices")
        except InputError as error:
            raise error.at(place=f"line {len(_LINE_END.findall(data, 0, found.start())) + 1}") from None
        is_open = bool(facet or (x and is_open))
        if end_facet:
            owners.append(solid)
        elif end_solid:
            solid = -1
        elif name is not None:
            unclosed += solid >= 0
            solid = names.setdefault(b" ".join(name.split()).decode("utf-8", "replace"), len(names))
    if not names or is_open or len(numbers) != 9 * len(owners):
        raise InputError("is truncated: it ends in a facet" if names else "is no STL file: it has no solid")
    if owners and (solid >= 0 or unclosed):
        warn(f"{path}: endsolid is missing {unclosed + (solid >= 0)} times; the file may be truncated")
    return np.frombuffer(numbers, np.float64).reshape(-1, 3), names, np.frombuffer(owners, np.int64)
