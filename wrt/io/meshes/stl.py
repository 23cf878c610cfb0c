"""STL files, text and binary.

trimesh 5.2 is not used. It leaves out the triangles before a missing `endsolid`, and logs a traceback for each facet normal that is no
number. It lets NumPy warn of positions that are not finite.
"""

import re
from array import array
from pathlib import Path
from typing import NoReturn

import numpy as np

from wrt.core.errors import InputError
from wrt.core.files import read_file, utf8
from wrt.io.mesh_file import RawMesh

_LINE = re.compile(rb"[^\r\n]++(?:\r\n|[\r\n]|\Z)|\r\n|[\r\n]")
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(path: Path) -> RawMesh:
    """Read the triangles of an STL file in the order of the file. Triangles share no vertices.

    The solids of a text file become groups. Facet normals are not read, because the winding gives the same direction. Raises InputError
    for a file that is truncated or no STL file, and for a position that is not finite."""
    data = read_file(path)
    groups: tuple[str, ...] = ()
    sizes: list[int] = []
    if len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):  # a binary file
        vertices = np.frombuffer(data, _RECORD, (len(data) - 84) // 50, 84)["corners"].reshape(-1, 3)
    else:
        vertices, groups, sizes = _read_text(utf8(data))
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


def _read_text(data: bytes) -> tuple[np.ndarray, tuple[str, ...], list[int]]:
    """Return positions (3 T, 3) float64, and names and triangle counts of the solids. Repeated names become name_1, name_2 ..."""

    def fail(number: int, message: str) -> NoReturn:
        raise InputError(f"is truncated or no STL file: {message}, and the length does not fit a binary STL file", place=f"line {number}")

    numbers = array("d")
    names: list[str] = []
    ends: list[int] = []  # vertices up to the end of each solid
    number, inside = 1, False
    for number, found in enumerate(_LINE.finditer(data), 1):
        line = found[0]
        words = line.split()
        key = words[0].lower() if words else b""
        if key == b"vertex":
            try:
                x, y, z = map(float, words[1:])
            except ValueError:
                fail(number, f"cannot read {line[:60].decode('latin-1').strip()!r}")
            numbers.extend((x, y, z))
        elif key == b"solid" and not inside:
            names.append(b" ".join(words[1:]).decode("utf-8", "replace"))
            inside = True
        elif key == b"endsolid" and inside:
            ends.append(len(numbers) // 3)
            inside = False
        elif key not in (b"", b"facet", b"outer", b"endloop", b"endfacet"):
            fail(number, f"cannot read {line[:60].decode('latin-1').strip()!r}")
        if key in (b"solid", b"endloop", b"endfacet", b"endsolid") and len(numbers) % 9:
            fail(number, "a loop must have three vertices")
    if inside or not names or ends[-1] * 3 != len(numbers):
        fail(number, "endsolid is missing" if inside else "vertices outside of a solid" if names else "there is no solid")
    vertices = np.frombuffer(numbers, np.float64).reshape(-1, 3)
    sizes = [(end - begin) // 3 for begin, end in zip([0, *ends], ends, strict=False)]
    return vertices, _each_once(names), sizes


def _each_once(names: list[str]) -> tuple[str, ...]:
    known: dict[str, int] = {}  # the last suffix of each name
    for name in names:
        unique = name
        while unique in known:
            known[name] += 1
            unique = f"{name}_{known[name]}"
        known[unique] = 0
    return tuple(known)
