"""NumPy archives with the arrays of a mesh: vertices and faces, perhaps normals and uvs, as in `Mesh`.

`Mesh.save` writes them, with an array `exact`: the mesh is then read bit by bit, and not cleaned."""

from pathlib import Path
from typing import Any

import numpy as np

from wrt.core.errors import InputError
from wrt.io.mesh_file import RawMesh
from wrt.scene.mesh import Mesh

ARRAYS = ("vertices", "faces", "normals", "uvs", "groups", "face_group", "origin")


def read(path: Path) -> RawMesh:
    """Read the arrays of a mesh. uvs: (0, 0) is the top left of an image. Raises InputError for other arrays; nothing is unpickled."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Any] = {name: np.asarray(file[name]) for name in ARRAYS if name in file}
            exact = "exact" in file
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds
        raise InputError(f"is no NumPy archive of arrays of numbers ({error})") from error
    if not {"vertices", "faces"} <= arrays.keys():
        raise InputError("has no arrays 'vertices' and 'faces'", hint="an .npz mesh has vertices (V, 3) and faces (F, 3)")
    groups = tuple(arrays.pop("groups", np.empty(0, "U1")).reshape(-1).tolist())
    mesh = Mesh(**arrays, groups=groups)  # which checks them
    return RawMesh(mesh.vertices, mesh.faces, mesh.normals, mesh.uvs, mesh.groups, mesh.face_group, positions=len(mesh.vertices),
                   exact=exact, origin=mesh.origin)
