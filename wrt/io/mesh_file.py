"""Reading of mesh files as a `Mesh`, with a reader for each suffix in MESH_FORMATS."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wrt.core.checks import as_path, short, shown
from wrt.core.errors import InputError, at, warn
from wrt.core.files import require_file
from wrt.core.registry import Registry
from wrt.core.types import PathLike
from wrt.io.meshes import PLACES
from wrt.scene.clean import clean
from wrt.scene.mesh import Mesh, unit_rows


@dataclass(frozen=True, eq=False)
class RawMesh:
    """A file's arrays as in `Mesh`, triangulated and with every index in range, but not yet cleaned."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    groups: tuple[str, ...] = ()
    face_group: np.ndarray | None = None
    incomplete: int = 0  # faces with fewer than three corners
    positions: int = 0  # in the file


Reader = Callable[[Path], RawMesh]
MESH_FORMATS: Registry[Reader] = Registry("mesh format", PLACES)


def register_mesh_format(suffix: str, read: Reader) -> None:
    """Make files with a suffix readable wherever a mesh can be named.

    Parameters
    ----------
    suffix
        Such as ".off", in small letters.
    read
        Returns a file's RawMesh, which is then checked and cleaned. Raises InputError, without the path, for a file it cannot read.
    """
    if not suffix.startswith(".") or suffix != suffix.lower():
        raise InputError(f"must begin with a dot and be in small letters, got {shown(suffix)}", argument="suffix")
    MESH_FORMATS[suffix] = read


def load_mesh(path: PathLike, parts: Sequence[tuple[int, int]] = ()) -> Mesh:
    """Read a mesh file, with faces and vertices in the order of the file.

    Polygons become triangles. Faces without area and vertices without a face are dropped (`Mesh.dropped` counts the faces); nothing is
    merged. Normals are made unit length, and v is flipped so that (0, 0) is the top left of a picture. Normals and uvs that are not
    finite become zero, with one SceneWarning.

    Parameters
    ----------
    path
        A file with a suffix of wrt.MESH_FORMATS.
    parts
        Ranges (first, count) of the file's triangles before any is dropped. They become the groups "0", "1" ... in place of the
        file's groups; the triangles outside of them become the last group, "rest".

    Raises
    ------
    InputError
        With the file and the place: a file that is missing, truncated or without triangles, an index out of range, a position that
        is not finite.
    """
    path = as_path(path, "path")
    if path.suffix.lower() not in MESH_FORMATS:
        scene = "; wrt.load_scene and wrt.build take scenes" if path.suffix.lower() in (".toml", ".gltf", ".glb") else ""
        raise InputError(f"is no mesh file: known are {', '.join(MESH_FORMATS)}{scene}", path=path)
    require_file(path)
    with at(path=path):
        raw = MESH_FORMATS[path.suffix.lower()](path)
        if len(raw.faces) == 0:
            raise InputError(f"holds no triangles ({raw.positions} positions, {raw.incomplete} faces of fewer than 3 corners)")
        groups, face_group = _part_groups(parts, len(raw.faces)) if parts else (raw.groups, raw.face_group)
    cleaned = clean(raw.vertices, raw.faces, raw.normals, raw.uvs, face_group)
    if len(cleaned.faces) == 0:
        raise InputError(f"none of its {len(raw.faces)} triangles has any area", path=path)
    normals = _finite(cleaned.normals, "normals", path)
    return Mesh(
        vertices=cleaned.vertices,
        faces=cleaned.faces,
        normals=None if normals is None else unit_rows(normals),
        uvs=_finite(cleaned.uvs, "uvs", path),
        groups=groups,
        face_group=cleaned.face_group,
        dropped=cleaned.dropped + raw.incomplete,
        name=os.fspath(path),
    )


def mesh_of(value: Mesh | PathLike) -> Mesh:
    """Return a Mesh unchanged, or the mesh of a file by its path. Raises InputError for others."""
    if not isinstance(value, Mesh | str | os.PathLike):
        raise InputError(f"must be a Mesh or the path of a mesh file, got {shown(value)}", argument="mesh")
    return value if isinstance(value, Mesh) else load_mesh(value)


def as_mesh(value: Mesh | PathLike) -> Mesh:
    """Return mesh_of(value). Raises InputError for a mesh without triangles, too."""
    mesh = mesh_of(value)
    if not len(mesh.faces):
        raise InputError("there are no triangles to hit", path=None if isinstance(value, Mesh) else value)
    return mesh


def _part_groups(parts: Sequence[tuple[int, int]], faces: int) -> tuple[tuple[str, ...], np.ndarray]:
    group = np.full(faces, len(parts), dtype=np.int32)
    for number, (first, count) in enumerate(parts):
        if first < 0 or count < 0 or first + count > faces:
            last = short(first + count - 1)
            raise InputError(f"triangles {short(first)} to {last}, but the file has {faces}", place=f"part {number}")
        group[first:first + count] = number
    return (*(str(number) for number in range(len(parts))), "rest"), group


def _finite(array: np.ndarray | None, attribute: str, path: Path) -> np.ndarray | None:
    """Convert to float32 and set rows that are not finite to zero, so that a bad normal does not cost the whole mesh."""
    if array is None:
        return None
    with np.errstate(over="ignore"):
        array = np.asarray(array, dtype=np.float32)
    finite = np.isfinite(array)
    if not finite.all():
        bad = ~finite.all(axis=1)
        warn(f"{path}: {int(bad.sum())} {attribute} are not finite and taken as zero")
        array = np.where(bad[:, None], np.float32(0.0), array)
    return array
