"""Instances: each mesh is stored once in its own space, and each instance has a transform to world space."""

from dataclasses import dataclass, field

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.kernels.traverse.common import Units

# Largest row sum of |A| |A^-1|, the growth of rounding errors from a mesh's own space to world space by the matrix A. Rotation and
# scaling have at most 3.
MAX_SPREAD = 1e4


@dataclass(frozen=True, eq=False)
class NumberedGeometry(Geometry):
    """A geometry with other prim_ids in the scene: primitive i has prim_ids[i]. prim_ids: (N,) int32, ascending."""

    prim_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))

    def primitives(self, units: Units, order: np.ndarray | None = None, threads: int = 1) -> np.ndarray:
        if order is not None and len(order) > len(self):
            return self.primitives(units, None, threads)[order]
        out = super().primitives(units, order, threads)
        out["prim_id"] = self.prim_ids[out["prim_id"]]
        return out


@dataclass(frozen=True, eq=False)
class InstancedGeometry:
    """Instances of geometries in world space. Spheres belong to part 0, and their prim_ids come after the triangles.

    `to_world` maps the arrays of a part, without the part's origin, to the world minus `origin`."""

    parts: tuple[Geometry, ...]  # In their own spaces; their prim_ids begin at 0.
    part: np.ndarray  # (I,) int, index of each instance's part.
    to_world: np.ndarray  # (I, 3, 4) float64, affine and invertible.
    first_prim: np.ndarray  # (I,) int, which an instance adds to the prim_ids of its part.
    n_triangles: int  # Number of triangles of all instances.
    worlds: np.ndarray | None = None  # (W + 1,) int. World w has the instances [worlds[w], worlds[w + 1]); None: one world.
    origin: np.ndarray | None = None  # (3,) float64, the point of the world that is 0 for the structure; None: 0.

    @property
    def first_instance(self) -> np.ndarray:
        """Index of the first instance of each world, and, as the last entry, the number of instances: (W + 1,) int64."""
        return np.array([0, len(self.part)] if self.worlds is None else self.worlds, np.int64)

    @property
    def n_worlds(self) -> int:
        """Number of worlds; 1 if the structure was not built from a list of worlds."""
        return 1 if self.worlds is None else len(self.worlds) - 1

    @property
    def world_first_prim(self) -> np.ndarray:
        """Index of each world's first primitive among the primitives of all worlds, (W,) int64."""
        if self.worlds is None:
            return np.zeros(1, np.int64)
        return np.append(self.first_prim, self.n_triangles)[self.worlds[:-1]]

    @property
    def first_prim_in_world(self) -> np.ndarray:
        """First prim_id of each instance, counted from the first primitive of its world, (I,) int64."""
        return self.first_prim - np.repeat(self.world_first_prim, np.diff(self.first_instance))

    @property
    def spheres(self) -> np.ndarray:
        """Spheres (S, 4) float32, as in Geometry. Spheres have no transforms."""
        return self.parts[0].spheres

    def __len__(self) -> int:
        return self.n_triangles + len(self.spheres)

    @property
    def is_placed(self) -> np.ndarray:
        """Mask of instances, (I,) bool: True for one object with its own transform, False for joined objects."""
        return np.array([not isinstance(self.parts[part], NumberedGeometry) for part in self.part], bool)


    def near_zero(self, rows: np.ndarray, matrices: np.ndarray) -> np.ndarray:
        """Convert matrices (R, 3, 4) of the instances `rows` from the caller's mesh and world to those of `to_world`."""
        origins = [part.origin for part in self.parts]
        if self.origin is None and all(each is None for each in origins):
            return matrices
        own = np.array([np.zeros(3) if each is None else each for each in origins])[self.part[rows]]
        out = matrices.copy()
        out[:, :, 3] += (matrices[:, :, :3] @ own[:, :, None])[..., 0] - (0.0 if self.origin is None else self.origin)
        return out


def inverse_of(matrices: np.ndarray) -> np.ndarray:
    """Invert affine maps (I, 3, 4) in float64."""
    linear = np.linalg.inv(matrices[:, :, :3])
    return np.concatenate([linear, -(linear @ matrices[:, :, 3:])], axis=2)


def spread_of(to_world: np.ndarray, to_local: np.ndarray) -> np.ndarray:
    """Return the growth of rounding errors from a mesh's own space to world space: largest row sum of |A| |A^-1|, (I,)."""
    return np.asarray((np.abs(to_world[:, :, :3]) @ np.abs(to_local[:, :, :3])).sum(axis=2).max(axis=1, initial=1.0))
