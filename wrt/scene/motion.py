"""Movement of an object within one period of an animation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from wrt.core.checks import as_array, as_one
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.scene.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Motion:
    """Movement of an object within one period, from time 0 to 1.

    Parameters
    ----------
    keys
        (K, 3, 3), K >= 2: translation, rotation (degrees about x, then y, then z) and scale at K times evenly spread from 0 to 1,
        interpolated linearly. They act before the object's transform. None: the object is not moved.
    target
        A mesh with the same faces, or None. Each vertex moves on a line to its position in the target and back: the target has the
        weight (1 - cos 2 pi t) / 2.

    Raises
    ------
    InputError
        If the keys have another shape, are not finite or pass through a scale of 0.
    """

    keys: np.ndarray | None = field(default=None, repr=False)
    target: Mesh | None = None

    def __post_init__(self) -> None:
        as_one(self.target, (Mesh, type(None)), "motion: target")
        if self.keys is None:
            return
        keys = as_array(self.keys, np.float64, "motion: keys")
        if keys.ndim != 3 or keys.shape[1:] != (3, 3) or len(keys) < 2 or not np.isfinite(keys).all():
            raise InputError(f"must be (K, 3, 3), finite, with two keys or more, got {keys.shape}", argument="keys", place="motion")
        if (keys[:, 2] == 0.0).any() or (np.sign(keys[:, 2]) != np.sign(keys[0, 2])).any():
            raise InputError("must not pass through a scale of zero, at a key or between two keys", argument="keys", place="motion")
        object.__setattr__(self, "keys", keys)

    def check(self, mesh: Mesh) -> None:
        """Raise InputError unless `mesh` has the same faces and as many vertices as the target."""
        if self.target is None:
            return
        if len(self.target.vertices) != len(mesh.vertices) or not np.array_equal(self.target.faces, mesh.faces):
            raise InputError(f"must have the same faces as the mesh; it has {len(self.target.vertices)} vertices and "
                             f"{len(self.target.faces)} faces, the mesh has {len(mesh.vertices)} and {len(mesh.faces)}",
                             argument="target", place="motion")

    def transform(self, time: float) -> np.ndarray:
        """Return the (4, 4) float64 matrix at a time in [0, 1]; the identity without keys."""
        matrix = np.eye(4)
        if self.keys is not None:
            with needed_by("a motion"):
                from scipy.spatial.transform import Rotation

            place = min(max(time, 0.0), 1.0) * (len(self.keys) - 1)
            first = min(int(place), len(self.keys) - 2)
            share = place - first
            translate, rotate, scale = (1.0 - share) * self.keys[first] + share * self.keys[first + 1]
            matrix[:3, :3] = Rotation.from_euler("xyz", rotate, degrees=True).as_matrix() * scale
            matrix[:3, 3] = translate
        return matrix

    def mesh(self, mesh: Mesh, time: float) -> Mesh:
        """Return the deformed mesh at a time in [0, 1]; `mesh` itself without a target."""
        if self.target is None:
            return mesh
        share = 0.5 - 0.5 * math.cos(2.0 * math.pi * time)
        target = self.target.positions - (0.0 if mesh.origin is None else mesh.origin)
        vertices = ((1.0 - share) * mesh.vertices.astype(np.float64) + share * target).astype(np.float32)
        normals = None
        if mesh.normals is not None and self.target.normals is not None:
            mixed = (1.0 - share) * mesh.normals.astype(np.float64) + share * self.target.normals
            length = np.linalg.norm(mixed, axis=1, keepdims=True)
            normals = np.divide(mixed, length, out=np.zeros_like(mixed), where=length > 1e-6).astype(np.float32)
        elif mesh.normals is not None:
            normals = np.zeros_like(mesh.vertices)  # flat shading by zero normals: the mesh's kernels read normals
        return replace(mesh, vertices=vertices, normals=normals)
