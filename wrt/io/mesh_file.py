"""Reading of mesh files: MESH_FORMATS has a reader for each suffix; and what readers share: numbers of text, polygons as triangles."""

from __future__ import annotations

import math
import os
import re
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wrt.core.checks import as_path, short, shown
from wrt.core.errors import InputError, at, warn
from wrt.core.files import require_file
from wrt.core.packages import needed_by
from wrt.core.registry import Registry
from wrt.core.types import PathLike
from wrt.io.meshes import PLACES
from wrt.scene.clean import Cleaned, clean
from wrt.scene.mesh import Mesh, unit_rows
from wrt.scene.values import near_zero, warn_if_far


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Arrays of a mesh file, with the meaning of `Mesh`'s fields: triangulated, every index in range, but not yet cleaned."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    groups: tuple[str, ...] = ()
    face_group: np.ndarray | None = None
    incomplete: int = 0  # number of faces with fewer than three corners
    positions: int = 0  # number of positions in the file
    exact: bool = False  # the arrays are those of a Mesh, and stay as they are
    origin: np.ndarray | None = None  # which positions far from 0 lack


Reader = Callable[[Path], RawMesh]
MESH_FORMATS: Registry[Reader] = Registry("mesh format", PLACES)
COMMENT = re.compile(r"(?<!\d\.)#.*", re.DOTALL)  # of a line of numbers; the # of 1.#IND begins none
# NaN and infinity, as C libraries print them: nan(ind), NaNQ, 1.#IND, 1.#INF00e+000.
_NOT_FINITE = re.compile(r"[+-]?(?:nan\w*(?:\(\w*\))?|\d\.#[a-z].*)", re.IGNORECASE)


def register_mesh_format(suffix: str, read: Reader) -> None:
    """Register the reader of a mesh format, so that wrt reads its files wherever it takes the path of a mesh.

    Parameters
    ----------
    suffix
        Suffix of the files, in small letters, such as ".shape".
    read
        Function that returns the RawMesh of a path, which wrt then checks and cleans. It raises InputError, without the path, for a
        file that it cannot read.
    """
    if not suffix.startswith(".") or suffix != suffix.lower():
        raise InputError(f"must begin with a dot and be in small letters, got {shown(suffix)}", argument="suffix")
    MESH_FORMATS[suffix] = read


def load_mesh(path: PathLike, parts: Sequence[tuple[int, int]] = ()) -> Mesh:
    """Read a mesh file, with faces and vertices in the order of the file.

    Polygons become triangles. Faces without area and vertices without a face are dropped (`Mesh.dropped` counts the faces); nothing is
    merged. Normals are scaled to unit length, and v is flipped so that (0, 0) is the top left of an image. Normals and uvs that are
    not finite become zero, with one SceneWarning. Corners without a normal get one if they are in a smoothing group of an .obj file.
    An .npz file of `Mesh.save` is read bit by bit instead.

    Parameters
    ----------
    path
        A file with a suffix of `wrt.io.mesh_file.MESH_FORMATS`: .npz, .obj, .off, .ply or .stl.
    parts
        Ranges (first, count) of the file's triangles, counted before any is dropped. They become the groups "0", "1" ... in place of the
        file's groups; triangles outside of all ranges become the last group, "rest".

    Raises
    ------
    InputError
        If the file is missing, truncated or without triangles, if an index is out of range or a position not finite. The message names
        the file and the place.
    """
    path = as_path(path, "path")
    if path.suffix.lower() not in MESH_FORMATS:
        hint = ("wrt.load_scene and wrt.build read scene files" if path.suffix.lower() in (".toml", ".gltf", ".glb")
                else "docs/compat.md has meshes of MuJoCo's models" if path.suffix.lower() in (".xml", ".urdf", ".usd", ".usda") else None)
        raise InputError(f"is no mesh file: its suffix must be one of {', '.join(MESH_FORMATS)}", path=path, hint=hint)
    require_file(path)
    with at(path=path):
        raw = MESH_FORMATS[path.suffix.lower()](path)
        if len(raw.faces) == 0:
            raise InputError(f"has no triangles ({raw.positions} positions, {raw.incomplete} faces with fewer than 3 corners)")
        groups, face_group = _part_groups(parts, len(raw.faces)) if parts else (raw.groups, raw.face_group)
    vertices, origin = (raw.vertices, raw.origin) if raw.exact or raw.origin is not None else near_zero(np.asarray(raw.vertices), raw.faces)
    arrays = vertices, raw.faces, raw.normals, raw.uvs, face_group
    cleaned = Cleaned(*arrays, 0) if raw.exact else clean(*arrays)
    if len(cleaned.faces) == 0:
        raise InputError(f"none of its {len(raw.faces)} triangles has an area", path=path)
    normals = _finite(cleaned.normals, "normals", path)
    mesh = Mesh(
        vertices=cleaned.vertices,
        faces=cleaned.faces,
        normals=normals if normals is None or raw.exact else unit_rows(normals),
        uvs=_finite(cleaned.uvs, "uvs", path),
        groups=groups,
        face_group=cleaned.face_group,
        dropped=cleaned.dropped + raw.incomplete,
        name=os.fspath(path),
        origin=origin,
    )
    if not raw.exact:
        mesh.note_clean()
    warn_if_far(mesh.vertices, mesh.name, mesh.origin)
    return mesh


def as_number(word: str | bytes) -> float:
    """Return the number that a word of a text file of meshes stands for, perhaps with Fortran's 1.0D+00. Raises InputError for others."""
    text = word if isinstance(word, str) else word.decode("latin-1")
    try:
        return float(text.lower().replace("d", "e"))
    except ValueError:
        if _NOT_FINITE.fullmatch(text):
            return math.nan
    raise InputError(f"{short(text)} is not a number", hint="numbers need a decimal point, not a comma" if "," in text else None)


def extend(numbers: array[float], words: Sequence[str] | Sequence[bytes]) -> None:
    """Append the numbers that words stand for, as `as_number` does, but in a tenth of the time."""
    before = len(numbers)
    try:
        numbers.extend(map(float, words))
    except ValueError:  # the numbers before the first odd word were appended
        numbers.extend(map(as_number, words[len(numbers) - before:]))


def as_mesh(value: Mesh | PathLike) -> Mesh:
    """Return a Mesh unchanged, or read the mesh file of a path. Raises InputError for other values, and for a mesh without triangles."""
    if not isinstance(value, Mesh | str | os.PathLike):
        raise InputError(f"must be a Mesh or the path of a mesh file, got {shown(value)}", argument="mesh")
    mesh = value if isinstance(value, Mesh) else load_mesh(value)
    if not len(mesh.faces):
        raise InputError("the mesh has no triangles", path=None if isinstance(value, Mesh) else value)
    return mesh


def _part_groups(parts: Sequence[tuple[int, int]], faces: int) -> tuple[tuple[str, ...], np.ndarray]:
    group = np.full(faces, len(parts), dtype=np.int32)
    for index, (first, count) in enumerate(parts):
        if first < 0 or count < 0 or first + count > faces:
            last = short(first + count - 1)
            raise InputError(f"has triangles {short(first)} to {last}, but the file has {faces} (the first is 0)", place=f"part {index}")
        group[first:first + count] = index
    return (*(str(index) for index in range(len(parts))), "rest"), group


def _finite(array: np.ndarray | None, attribute: str, path: Path) -> np.ndarray | None:
    """Convert to float32 and set rows that are not finite to zero, with a warning, so that a bad normal does not spoil the mesh."""
    if array is None:
        return None
    with np.errstate(over="ignore"):
        array = np.asarray(array, dtype=np.float32)
    finite = np.isfinite(array)
    if not finite.all():
        bad = ~finite.all(axis=1)
        warn(f"{path}: {int(bad.sum())} {attribute} are not finite and are read as zero")
        array = np.where(bad[:, None], np.float32(0.0), array)
    return array


def triangulate(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons into triangles, in the order of the polygons and with their winding.

    corners: (C,) integers, the vertex indices of all polygons in sequence; counts: (P,), the number of corners of each polygon;
    vertices: (V, 3). Returns (T, 3) integers, indices into `corners`, and (T,), the index of each triangle's polygon. A polygon of n
    corners gives n - 2 triangles, or none for n < 3. Convex polygons become the fan about their first corner. A polygon is concave if
    a triangle of its fan faces against its area vector. It is then projected along that vector and cut by ear clipping (mapbox-earcut).
    Self-intersecting polygons have no right answer; they also give n - 2 triangles."""
    counts, corners = np.asarray(counts, dtype=np.int64), np.asarray(corners)
    fan = np.maximum(counts - 2, 0)
    small = np.int32 if max(len(corners), len(counts)) < 1 << 31 else np.int64
    if len(counts) and counts.min() == counts.max() == 3:  # as in most large files
        return np.arange(len(corners), dtype=small).reshape(-1, 3), np.arange(len(counts), dtype=small)
    start = (np.cumsum(counts) - counts).astype(small)
    polygon = np.repeat(np.arange(len(counts), dtype=small), fan)
    step = np.arange(len(polygon), dtype=small) - np.repeat((np.cumsum(fan) - fan).astype(small), fan)
    first = start[polygon]
    triangles = np.stack([first, first + step + 1, first + step + 2], axis=1)
    if len(polygon) == 0 or counts.max() == 3:
        return triangles, polygon

    area, against = _areas(corners, counts, np.asarray(vertices, dtype=np.float64), triangles, polygon)
    for concave in against:
        begin, n = int(start[concave]), int(counts[concave])
        outline = np.asarray(vertices, dtype=np.float64)[np.asarray(corners)[begin:begin + n]]
        row = int(np.searchsorted(polygon, concave))
        triangles[row:row + n - 2] = begin + _ears(outline, area[concave])
    return triangles, polygon


def strip(indices: np.ndarray) -> np.ndarray:
    """Return the triangles (N - 2, 3) of a triangle strip of N vertex indices: each vertex with the two before it."""
    i = np.arange(max(len(indices) - 2, 0), dtype=indices.dtype)
    odd = i & 1  # every second triangle swaps two corners, so that all triangles face the same side
    return indices[np.stack([i, i + 1 + odd, i + 2 - odd], axis=1)]


def _areas(corners: np.ndarray, counts: np.ndarray, vertices: np.ndarray, triangles: np.ndarray,
           polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return area vectors (P, 3), of length 2 * area (0 for polygons of up to three corners), and the indices of the concave polygons."""
    area, against = np.zeros((len(counts), 3)), np.zeros(len(counts), dtype=bool)
    large = counts > 3  # triangles are convex
    size, several = counts[large] - 2, large[polygon]
    a, b, c = (vertices.take(corners.take(triangles[several, i]), axis=0) for i in range(3))
    with np.errstate(invalid="ignore", over="ignore"):
        normal = np.cross(b - a, c - a)
        area[large] = np.add.reduceat(normal, np.cumsum(size) - size)
        against[polygon[several][np.einsum("ij,ij->i", normal, np.repeat(area[large], size, axis=0)) < 0.0]] = True
    return area, np.flatnonzero(against)


def _ears(outline: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return triangles (n - 2, 3) of one polygon's outline (n, 3), projected along `normal`.

    Self-intersecting polygons can have fewer than n - 2 ears; they become a fan."""
    with needed_by("a concave polygon"):
        from mapbox_earcut import triangulate_float64

    drop, n = int(np.argmax(np.abs(normal))), len(outline)
    keep = [(1, 2), (2, 0), (0, 1)][drop]
    flat = outline[:, keep] * np.array([1.0, 1.0 if normal[drop] > 0.0 else -1.0])
    ears = triangulate_float64(flat, np.array([n], dtype=np.uint32)).reshape(-1, 3)
    i = np.arange(1, n - 1)
    return ears if len(ears) == n - 2 else np.stack([np.zeros_like(i), i, i + 1], axis=1)
