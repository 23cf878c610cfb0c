"""Files of shapes: like OFF files, as plain text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wrt.core.errors import InputError
from wrt.core.files import read_file
from wrt.io.mesh_file import RawMesh, triangulate


def read(path: Path) -> RawMesh:
    """Read the vertices and faces of a file of shapes."""
    words = read_file(path).split()
    try:
        n_vertices, n_faces = int(words[1]), int(words[2])
        vertices = np.array(words[4 : 4 + 3 * n_vertices], np.float64).reshape(n_vertices, 3)
        corners, counts, at = [], [], 4 + 3 * n_vertices
        for _ in range(n_faces):
            counts.append(int(words[at]))
            corners += map(int, words[at + 1 : at + 1 + counts[-1]])
            at += 1 + counts[-1]
    except (IndexError, ValueError) as error:
        raise InputError(f"is no file of shapes, or ends too early ({error})") from None
    if corners and not 0 <= min(corners) <= max(corners) < n_vertices:
        raise InputError(f"a face has a corner that is none of the {n_vertices} vertices")
    triangles, _ = triangulate(np.array(corners, np.int64), np.array(counts, np.int64), vertices)
    return RawMesh(vertices, np.array(corners, np.int64)[triangles], positions=n_vertices)
