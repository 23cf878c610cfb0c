"""A triangle mesh: what it must hold to be traced, and how OBJ, PLY and STL files become one."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.checks import LARGEST, as_array, as_path, shown
from wrt.core.errors import InputError, SceneWarning
from wrt.core.files import require_file
from wrt.core.html import html_facts
from wrt.core.memory import require
from wrt.scene.clean import clean

if TYPE_CHECKING:
    import trimesh


BYTES_OF_FACE, BYTES_OF_VERTEX = 60.0, 100.0  # of memory, measured: of a file's mesh while it becomes a Mesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in object space.

    vertices: (V, 3) float32, finite; faces: (F, 3) int32, counter-clockwise seen from outside; normals: (V, 3)
    float32 or None (flat shading), unit length where not zero (zero: flat there); uvs: (V, 2) float32 or None, (0, 0)
    the top left of a picture; groups: names of parts, and face_group: (F,) int32 index into them, or None. dropped:
    how many faces were left out on loading because their area is exactly zero. Coordinates end at 1e30 (and at 1e18 in an
    Object's world). Raises InputError that names the mesh, the array and the first place that is wrong.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    groups: tuple[str, ...] = ()
    face_group: np.ndarray | None = None
    dropped: int = 0
    name: str = ""

    def __post_init__(self) -> None:
        vertices = self._array("vertices", np.float32, 3)
        faces = self._array("faces", np.int32, 3)
        _require_finite(vertices, self.name, "vertices")
        if self.reach > np.float32(LARGEST):
            row = int(np.argmax(np.abs(vertices).max(axis=1)))
            raise InputError(f"vertex {row} is {vertices[row].tolist()}; at most {LARGEST:g} can be traced", self.name or None,
                             "vertices")
        outside = (faces < 0) | (faces >= len(vertices))
        if outside.any():
            face = int(np.nonzero(outside.any(axis=1))[0][0])
            raise InputError(f"face {face} is {faces[face].tolist()}, but there are {len(vertices)} vertices",
                             self.name or None, "faces")
        for attribute, width in (("normals", 3), ("uvs", 2)):
            if getattr(self, attribute) is not None:
                array = self._array(attribute, np.float32, width)
                if len(array) != len(vertices):
                    raise InputError(f"{len(array)} {attribute} for {len(vertices)} vertices", self.name or None,
                                     attribute)
                _require_finite(array, self.name, attribute)
        if self.face_group is not None:
            group = as_array(self.face_group, np.int32, "face_group")
            if group.shape != (len(faces),):
                raise InputError(f"face_group must be ({len(faces)},), got {group.shape}", self.name or None)
            object.__setattr__(self, "face_group", group)

    def _array(self, attribute: str, dtype: type, width: int) -> np.ndarray:
        try:
            raw = np.asarray(getattr(self, attribute))
        except ValueError:
            raise InputError(f"must be (N, {width}), got rows of different lengths", self.name or None, attribute) from None
        if raw.ndim != 2 or raw.shape[1] != width:
            raise InputError(f"must be (N, {width}), got {raw.shape}", self.name or None, attribute)
        if dtype is np.int32 and raw.size and not np.issubdtype(raw.dtype, np.integer):
            raise InputError(f"must hold integers, got {raw.dtype}", self.name or None, attribute)
        array = as_array(raw, dtype, ": ".join(part for part in (self.name, attribute) if part))
        object.__setattr__(self, attribute, array)
        return array

    @classmethod
    def from_trimesh(cls, mesh: trimesh.Trimesh | trimesh.Scene, smooth: bool = False) -> Mesh:
        """The triangles of a trimesh mesh, or of all of a trimesh scene in its world: every format that trimesh reads.

        uvs are taken where there are some; smooth: also its vertex normals. Faces without area stay, and are never hit. Raises
        InputError for anything else, and as Mesh does.
        """
        import trimesh

        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        if not isinstance(mesh, trimesh.Trimesh):
            raise InputError(f"mesh must be a trimesh.Trimesh or a trimesh.Scene, got {shown(mesh)}")
        uv = getattr(mesh.visual, "uv", None)
        uvs = None if uv is None or len(uv) != len(mesh.vertices) else np.asarray(uv)[:, :2] * (1.0, -1.0) + (0.0, 1.0)
        source = getattr(mesh, "source", None)
        return cls(np.array(mesh.vertices), np.array(mesh.faces), np.array(mesh.vertex_normals) if smooth else None, uvs,
                   name=str(getattr(source, "file_name", None) or ""))

    def to_trimesh(self) -> trimesh.Trimesh:
        """The same as a trimesh mesh, to repair, simplify or write in its formats: vertices and faces in the same order,
        normals and uvs where there are some."""
        import trimesh

        visual = None if self.uvs is None else trimesh.visual.TextureVisuals(uv=self.uvs * (1.0, -1.0) + (0.0, 1.0))
        return trimesh.Trimesh(self.vertices, self.faces, vertex_normals=self.normals, visual=visual, process=False)

    @cached_property
    def reach(self) -> float:
        """The largest coordinate of any vertex, without its sign."""
        return float(np.abs(self.vertices).max(initial=0.0))

    def __repr__(self) -> str:
        parts = [repr(self.name)] if self.name else []
        parts += [f"{len(self.vertices)} vertices", f"{len(self.faces)} faces"]
        parts += [name for name in ("normals", "uvs") if getattr(self, name) is not None]
        parts += [f"{len(self.groups)} groups"] * bool(self.groups) + [f"{self.dropped} dropped"] * bool(self.dropped)
        if len(self.vertices):
            parts.append(f"from {_corner(self.vertices.min(axis=0))} to {_corner(self.vertices.max(axis=0))}")
        return f"Mesh({', '.join(parts)})"

    def _repr_html_(self) -> str:
        facts: dict[str, object] = {"vertices": len(self.vertices), "faces": len(self.faces)}
        facts |= {name: "yes" if getattr(self, name) is not None else "no" for name in ("normals", "uvs")}
        facts |= {"groups": ", ".join(self.groups)} if self.groups else {}
        facts |= {"faces without area, left out": self.dropped} if self.dropped else {}
        if len(self.vertices):
            facts |= {"from": _corner(self.vertices.min(axis=0)), "to": _corner(self.vertices.max(axis=0))}
        return html_facts(f"Mesh {self.name}", facts)


def _corner(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"


def _require_finite(array: np.ndarray, name: str, attribute: str) -> None:
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        row = int(np.nonzero(bad)[0][0])
        raise InputError(f"{attribute} {row} is {array[row].tolist()} ({int(bad.sum())} not finite in all)",
                         name or None, attribute)


@dataclass(frozen=True, eq=False)
class RawMesh:
    """What a file holds, triangulated and with every index in range, but not yet cleaned.

    The arrays are those of `Mesh`; incomplete: faces with fewer than three corners; positions: how many the file has.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    groups: tuple[str, ...] = ()
    face_group: np.ndarray | None = None
    incomplete: int = 0
    positions: int = 0


def _reader(suffix: str) -> Callable[[str | os.PathLike[str]], RawMesh]:
    """The function that reads such files; modules are imported when they are needed."""
    module, function = READERS[suffix]
    return getattr(importlib.import_module(module), function)


READERS = {".obj": ("wrt.io.obj", "read_obj"), ".ply": ("wrt.io.ply", "read_ply"), ".stl": ("wrt.io.stl", "read_stl")}


def load_mesh(path: str | os.PathLike[str], parts: Sequence[tuple[int, int]] = ()) -> Mesh:
    """Read an OBJ, PLY or STL file.

    Nothing is merged or reordered: faces and vertices keep the order of the file, except that faces without area and
    vertices without a face are dropped (`Mesh.dropped` counts the faces). Polygons become triangles. Normals and uvs
    are those of the file, or None; normals are made unit length, v is flipped so that (0, 0) is the top left of a
    picture. parts: ranges (first, count) of the file's triangles, counted before any is dropped; they become `groups`
    "0", "1" ... in place of the file's own, the triangles in none of them the last group, "rest". Raises InputError
    that names the file, and the place where it is known: a file that is missing, truncated or has no triangles, an
    index out of range, a position that is NaN or infinite. Normals and uvs that are not finite are replaced by zero
    with one SceneWarning.
    """
    path = as_path(path, "path")
    if path.suffix.lower() not in READERS:
        raise InputError(f"is no mesh file: known are {', '.join(READERS)}", path)
    require_file(path)
    try:
        raw = _reader(path.suffix.lower())(path)
    except InputError as error:
        raise error if error.path is not None else InputError(str(error), path) from None
    if len(raw.faces) == 0:
        raise InputError(f"holds no triangles ({raw.positions} positions, {raw.incomplete} faces of fewer than 3 "
                         "corners)", path)
    groups, face_group = raw.groups, raw.face_group
    if parts:
        groups, face_group = _part_groups(parts, len(raw.faces), path)

    require(BYTES_OF_FACE * len(raw.faces) + BYTES_OF_VERTEX * len(raw.vertices), "the mesh")
    cleaned = clean(raw.vertices, raw.faces, raw.normals, raw.uvs, face_group)
    if len(cleaned.faces) == 0:
        raise InputError(f"none of its {len(raw.faces)} triangles has any area", path)
    return Mesh(
        vertices=cleaned.vertices,
        faces=cleaned.faces,
        normals=_unit(_finite(cleaned.normals, "normals", path)),
        uvs=_finite(cleaned.uvs, "uvs", path),
        groups=groups,
        face_group=cleaned.face_group,
        dropped=cleaned.dropped + raw.incomplete,
        name=os.fspath(path),
    )


def as_mesh(value: Mesh | str | os.PathLike[str]) -> Mesh:
    """A Mesh as it is; the mesh of a file by its path (load_mesh). Raises InputError for anything else, or no triangles."""
    if not isinstance(value, Mesh | str | os.PathLike):
        raise InputError(f"mesh must be a Mesh or the path of a mesh file, got {shown(value)}")
    mesh = value if isinstance(value, Mesh) else load_mesh(value)
    if not len(mesh.faces):
        raise InputError("there are no triangles to hit", None if isinstance(value, Mesh) else value)
    return mesh


def _part_groups(parts: Sequence[tuple[int, int]], faces: int, path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    group = np.full(faces, len(parts), dtype=np.int32)
    for number, (first, count) in enumerate(parts):
        if first < 0 or count < 0 or first + count > faces:
            raise InputError(f"triangles {first} to {first + count - 1}, but the file has {faces}", path,
                             f"part {number}")
        group[first:first + count] = number
    return (*(str(number) for number in range(len(parts))), "rest"), group


def _finite(array: np.ndarray | None, attribute: str, path: Path) -> np.ndarray | None:
    """The array as float32, with zeros in rows that are not finite: a bad normal must not cost the whole mesh."""
    if array is None:
        return None
    with np.errstate(over="ignore"):
        array = np.asarray(array, dtype=np.float32)
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        warnings.warn(f"{path}: {int(bad.sum())} {attribute} are not finite and taken as zero", SceneWarning,
                      stacklevel=3)
        array = np.where(bad[:, None], np.float32(0.0), array)
    return array


def _unit(normals: np.ndarray | None) -> np.ndarray | None:
    """Rows scaled to unit length; rows of zeros stay."""
    if normals is None:
        return None
    wide = normals.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return (wide / np.where(length > 0.0, length, 1.0)).astype(np.float32)
