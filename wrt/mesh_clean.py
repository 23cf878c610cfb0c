"""What a mesh must lose before it can be traced: faces without area, and vertices that no face uses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wrt.errors import InputError


class Cleaned(NamedTuple):
    """The arrays of a mesh after `clean`; `dropped` faces are gone."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None
    face_group: np.ndarray | None
    dropped: int


def clean(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None, uvs: np.ndarray | None = None,
          face_group: np.ndarray | None = None) -> Cleaned:
    """Drop the faces whose area is exactly zero, then the vertices that no remaining face uses.

    vertices: (V, 3), taken as float32; faces: (F, 3) integers; normals (V, 3), uvs (V, 2) and face_group (F,) or None.
    The order of what remains is kept. Area is the cross product of two edges, in float64 from the float32 positions:
    zero for repeated indices, coincident corners and corners exactly on a line; it neither overflows nor underflows. A
    face with a NaN or an infinite corner is kept, so that whoever makes the `Mesh` reports it.
    Raises InputError that names the first face with an index outside of [0, V).
    """
    vertices = np.asarray(vertices, dtype=np.float32).reshape(-1, 3)
    faces = np.asarray(faces).reshape(-1, 3)
    outside = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    if outside.any():
        face = int(np.nonzero(outside)[0][0])
        corners = faces[face].tolist()
        raise InputError(f"face {face} is {corners}, but there are {len(vertices)} vertices", None, "faces")

    has_area = _has_area(vertices, faces)
    dropped = len(faces) - int(np.count_nonzero(has_area))
    if dropped:
        faces = faces[has_area]
        face_group = face_group[has_area] if face_group is not None else None

    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    if not used.all():
        faces = (np.cumsum(used) - 1)[faces]
        vertices = vertices[used]
        normals = normals[used] if normals is not None else None
        uvs = uvs[used] if uvs is not None else None
    return Cleaned(vertices, faces.astype(np.int32), normals, uvs, face_group, dropped)


def _has_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool. One component of the cross product at a time, which keeps the float64 temporaries small."""
    x, y, z = (vertices[:, axis].astype(np.float64)[faces] for axis in range(3))
    nonzero = np.zeros(len(faces), dtype=bool)
    with np.errstate(invalid="ignore"):  # inf - inf: NaN differs from zero, so the face is kept
        for a, b in ((y, z), (z, x), (x, y)):
            nonzero |= (a[:, 1] - a[:, 0]) * (b[:, 2] - b[:, 0]) != (b[:, 1] - b[:, 0]) * (a[:, 2] - a[:, 0])
    return nonzero
