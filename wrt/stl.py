"""STL files, text and binary, through trimesh."""

from __future__ import annotations

import logging
import os
import re
import warnings
from pathlib import Path

import numpy as np

from wrt.errors import InputError
from wrt.mesh import RawMesh


def read_stl(path: str | os.PathLike[str]) -> RawMesh:
    """Read the triangles of an STL file in the order of the file; each has three vertices of its own.

    The solids of a text file become groups. Facet normals are not read: they say no more than the winding does. Raises
    InputError for a file that is truncated or no STL, and for a position that is not finite.
    """
    path = Path(path)
    data = path.read_bytes()
    solids = _solids(path)
    vertices = np.concatenate([np.zeros((0, 3)), *solids.values()])
    if not _is_binary(data):
        # trimesh leaves out what stands before the file's end where an `endsolid` is missing: count for ourselves.
        promised = len(re.findall(rb"^\s*vertex\s", data, re.MULTILINE | re.IGNORECASE))
        if promised != len(vertices) or b"\0" in data:
            raise InputError(f"truncated, or no STL file: {len(vertices) // 3} whole triangles in closed solids, "
                             f"{promised} vertices in all, and the length is not that of a binary STL file", path)
    with np.errstate(over="ignore"):
        bad = np.nonzero(~np.isfinite(vertices.astype(np.float32)).all(axis=1))[0]
    if len(bad):
        raise InputError(f"position {vertices[bad[0]].tolist()} is not finite ({len(bad)} in all)", path,
                         f"triangle {bad[0] // 3}")
    sizes = [len(solid) // 3 for solid in solids.values()]
    return RawMesh(
        vertices=vertices,
        faces=np.arange(len(vertices)).reshape(-1, 3),
        groups=tuple(solids) if len(solids) > 1 else (),
        face_group=np.repeat(np.arange(len(solids)), sizes) if len(solids) > 1 else None,
        positions=len(vertices),
    )


def _is_binary(data: bytes) -> bool:
    """Whether the length is just that of a binary file with as many triangles as the header says."""
    return len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")


def _solids(path: Path) -> dict[str, np.ndarray]:
    """Positions (3 T, 3) of each solid by name, in the order of the file."""
    import trimesh

    log = logging.getLogger("trimesh")
    level = log.level
    try:
        log.setLevel(logging.CRITICAL + 1)  # it prints a traceback for each facet normal that is not a number
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's way of saying that a word is not a number
            loaded = trimesh.load_scene(path, file_type="stl", process=False)
    except Exception as error:
        raise InputError(f"cannot be read as STL: {error}", path) from error
    finally:
        log.setLevel(level)
    return {name: np.asarray(mesh.vertices)[mesh.faces.reshape(-1)] for name, mesh in loaded.geometry.items()}
