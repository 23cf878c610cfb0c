"""NumPy archives with the arrays of a mesh: vertices and faces, perhaps normals and uvs, as in `Mesh`.

`Mesh.save` writes them, with an array `exact`: the mesh is then read bit by bit, and not cleaned."""

import zipfile
from pathlib import Path

import numpy as np

from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.io.mesh_file import RawMesh
from wrt.scene.clean import require_indices

SHAPES = {"vertices": 3, "faces": 3, "normals": 3, "uvs": 2}


def read(path: Path) -> RawMesh:
    """Read the arrays of a mesh. uvs: (0, 0) is the top left of an image. Raises InputError for other arrays; nothing is unpickled."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in (*SHAPES, "groups", "face_group", "origin") if name in file}
            exact = "exact" in file
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"is no NumPy archive of arrays of numbers ({error})") from error
    for name, columns in SHAPES.items():
        array = arrays.get(name)
        if array is None and name in ("vertices", "faces"):
            raise InputError(f"has no array {name!r}", hint="an .npz mesh has vertices (V, 3) and faces (F, 3)")
        kinds = "iu" if name == "faces" else "fiu"
        if array is not None and not (array.ndim == 2 and array.shape[1] == columns and array.dtype.kind in kinds):
            raise InputError(f"{name} must be (N, {columns}) {'integers' if name == 'faces' else 'numbers'}, got {shown(array)}")
        if array is not None and name in ("normals", "uvs") and len(array) != len(arrays["vertices"]):
            raise InputError(f"{name} must have {len(arrays['vertices'])} rows like the vertices, got {len(array)}")
    vertices, faces = arrays["vertices"], arrays["faces"]
    require_indices(faces, len(vertices))
    if not np.isfinite(vertices).all():
        raise InputError("vertices must be finite", place=f"row {int(np.argmin(np.isfinite(vertices).all(axis=1)))}")
    groups, face_group = arrays.get("groups", np.empty(0, "U1")), arrays.get("face_group")
    if not (groups.ndim == 1 and groups.dtype.kind == "U"):
        raise InputError(f"groups must be (G,) text, got {shown(groups)}")
    if face_group is not None and not (face_group.shape == faces.shape[:1] and face_group.dtype.kind in "iu"
                                       and (face_group >= 0).all() and (face_group < len(groups)).all()):
        raise InputError(f"face_group must be ({len(faces)},) indices of {len(groups)} groups, got {shown(face_group)}")
    origin = arrays.get("origin")
    if origin is not None and not (origin.shape == (3,) and origin.dtype == np.float64 and np.isfinite(origin).all()):
        raise InputError(f"origin must be (3,) finite float64, got {shown(origin)}")
    return RawMesh(vertices, faces.astype(np.int64), arrays.get("normals"), arrays.get("uvs"), tuple(groups.tolist()), face_group,
                   positions=len(vertices), exact=exact, origin=origin)
