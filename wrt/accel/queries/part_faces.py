"""Faces of the structures below instances, for queries that read corners of triangles in a mesh's own space."""

from typing import NamedTuple

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry, InstancedGeometry, NumberedGeometry
from wrt.accel.snapshot import Snapshot, once
from wrt.core.device import upload
from wrt.core.types import WarpArray


class PartFaces(NamedTuple):
    """Triangles of all parts of an InstancedGeometry, on the structure's device."""

    vertices: WarpArray  # In the parts' own spaces.
    faces: WarpArray  # Of each part in the order of its prim_ids, with gaps where the part lacks prim_ids.
    first_face: WarpArray  # (P,) int32, index in `faces` of the face with prim_id 0 of each part.


@once
def part_faces(snapshot: Snapshot) -> PartFaces:
    """Upload the faces of all parts of a structure over instances."""
    geometry, device = snapshot.geometry, snapshot.device
    assert isinstance(geometry, InstancedGeometry)
    faces = [by_prim_id(part) for part in geometry.parts]
    first_vertex, first_face = (np.cumsum([0, *map(len, rows)]) for rows in ([part.vertices for part in geometry.parts], faces))
    joined = [rows + np.int32(first) for rows, first in zip(faces, first_vertex, strict=False)]
    return PartFaces(upload(np.concatenate([part.vertices for part in geometry.parts]), wp.vec3, device),
                     upload(np.concatenate(joined), wp.vec3i, device), upload(first_face[:-1], wp.int32, device))


def by_prim_id(part: Geometry) -> np.ndarray:
    """Return the faces of a part, row i with prim_id i; (0, 0, 0) where the part has no such prim_id."""
    if not isinstance(part, NumberedGeometry):
        return part.faces
    prim_ids = part.prim_ids[: len(part.faces)]
    out = np.zeros((int(prim_ids.max(initial=-1)) + 1, 3), np.int32)
    out[prim_ids] = part.faces
    return out
