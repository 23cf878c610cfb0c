"""STL files, text and binary.

trimesh 5.2 is not used. It leaves out the triangles before a missing `endsolid`, and logs a traceback for each facet normal that is no
number. It lets NumPy warn of positions that are not finite.
"""

import re
from array import array
from pathlib import Path
from typing import NoReturn

import numpy as np

from wrt.core.errors import InputError, warn
from wrt.core.files import read_file, utf8
from wrt.io.mesh_file import RawMesh
from wrt.io.text import as_number

# Line breaks may stand between any two words. Programs differ in `end loop` and in lines of colours.
_STATEMENT = re.compile(rb"""
    vertex\s+(?P<x>\S+)\s+(?P<y>\S+)\s+(?P<z>\S+)
  | (?P<begin>facet\b(?:\s+normal\b)?(?:[^\r\no]|o(?!uter\b))*+ | outer(?:\s+loop)?\b)
  | (?P<end>end\s*(?:loop|facet)\b) | end\s*(?P<endsolid>solid)\b[^\r\n]* | (?:colou?r\b|\#)[^\r\n]*
  | solid\b(?P<solid>(?:(?!\s+facet\s+normal\b)[^\r\n])*+) | (?P<other>\S[^\r\n]{0,59})""", re.IGNORECASE | re.VERBOSE)
_BLANK = b"\0\t\n\r\x1a "  # what may follow a file's content
_LINE_END = re.compile(rb"\r\n?|\n")
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(path: Path) -> RawMesh:
    """Read the triangles of an STL file in the order of the file. Triangles share no vertices.

    The solids of a text file become groups. Facet normals are not read, because the winding gives the same direction. A missing
    endsolid, and a binary file that is longer than its header announces, get a SceneWarning. Raises InputError for a file that is
    truncated or no STL file, and for a position that is not finite."""
    data = read_file(path)
    groups: tuple[str, ...] = ()
    sizes: list[int] = []
    fits = len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
    text = b"" if fits else utf8(data)
    if fits or b"\0" in text[80:134]:  # a text has no zero byte; in a binary file, the count and the first triangle do
        vertices = np.frombuffer(data, _RECORD, _count(data, path), 84)["corners"].reshape(-1, 3)
    else:
        vertices, groups, sizes = _read_text(text, path)
    with np.errstate(over="ignore"):
        bad = np.nonzero(~np.isfinite(vertices.astype(np.float32)).all(axis=1))[0]
    if len(bad):
        raise InputError(f"position {vertices[bad[0]].tolist()} is not finite ({len(bad)} in all)", place=f"triangle {bad[0] // 3}")
    return RawMesh(
        vertices=vertices,
        faces=np.arange(len(vertices)).reshape(-1, 3),
        groups=groups if len(groups) > 1 else (),
        face_group=np.repeat(np.arange(len(groups)), sizes) if len(groups) > 1 else None,
        positions=len(vertices),
    )


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


def _read_text(data: bytes, path: Path) -> tuple[np.ndarray, tuple[str, ...], list[int]]:
    """Return positions (3 T, 3) float64, and names and triangle counts of the solids. Repeated names become name_1, name_2 ..."""

    def fail(offset: int, message: str, hint: str | None = "a solid holds facets, each with a loop of three vertices") -> NoReturn:
        raise InputError(message, place=f"line {len(_LINE_END.findall(data, 0, offset)) + 1}", hint=hint)

    numbers = array("d")
    names: list[str] = []
    begins: list[int] = []  # count of the numbers before each solid
    first, inside, unclosed, kind = 0, False, 0, None  # first: the number of a loop's first coordinate
    for found in _STATEMENT.finditer(data):
        if found.lastgroup is None:  # a colour or a comment
            continue
        kind = found.lastgroup
        if kind == "other" or (kind == "endsolid" and not inside):
            fail(found.start(), f"cannot read {found[0][:60].decode('latin-1').strip()!r}")
        if kind in ("end", "endsolid", "solid"):
            if len(numbers) - first not in (0, 9):
                fail(found.start(), "a loop must have three vertices")
            first = len(numbers)
            if kind == "solid":
                unclosed += inside
                begins.append(first)
                names.append(b" ".join(found["solid"].split()).decode("utf-8", "replace"))
            inside = kind == "solid" or (inside and kind == "end")
        elif kind == "z":
            if not inside:
                fail(found.start(), "a vertex is outside of a solid")
            words = found.group("x", "y", "z")
            try:
                numbers.extend(map(float, words))
            except ValueError:  # the numbers before the first odd word were appended
                try:
                    numbers.extend(map(as_number, words[len(numbers) % 3:]))
                except InputError as error:
                    fail(found.start(), error.what, error.hint)
    if not names or (inside and kind != "end"):
        fail(len(data), "is truncated: it ends in a facet" if names else "is no STL file: it has no solid")
    if inside or unclosed:
        warn(f"{path}: endsolid is missing {inside + unclosed} times; the file may be truncated")
    sizes = np.diff([*begins, len(numbers)]) // 9
    return np.frombuffer(numbers, np.float64).reshape(-1, 3), _each_once(names), sizes.tolist()


def _each_once(names: list[str]) -> tuple[str, ...]:
    known: dict[str, int] = {}  # the last suffix of each name
    for name in names:
        unique = name
        while unique in known:
            known[name] += 1
            unique = f"{name}_{known[name]}"
        known[unique] = 0
    return tuple(known)
