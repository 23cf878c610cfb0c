"""Meshes that stand in several places: each kept once in its own space, with a transform to the world for each place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.kernels.traverse.common import Units

# Sum of |A| |A^-1| over a row, 3 at most for turned and scaled meshes. Beyond, rounding in the mesh's space is much in the world.
MAX_SPREAD = 1e4


@dataclass(frozen=True, eq=False)
class NumberedGeometry(Geometry):
    """A geometry whose primitives have numbers of their own in the scene: numbers (N,) int32, ascending."""

    numbers: np.ndarray

    def primitives(self, units: Units, order: np.ndarray | None = None, threads: int = 1) -> np.ndarray:
        if order is not None and len(order) > len(self):
            return self.primitives(units, None, threads)[order]
        out = super().primitives(units, order, threads)
        out["prim_id"] = self.numbers[out["prim_id"]]
        return out


@dataclass(frozen=True, eq=False)
class InstancedGeometry:
    """Geometries placed in the world. parts: each in its own space; of a mesh, primitives are numbered from 0, and an instance
    adds its own first_prim. part: (I,) int, the part of each instance; to_world: (I, 3, 4) float64, affine and invertible;
    first_prim: (I,) int. n_triangles: of all instances together; spheres, numbered behind them, are those of part 0.
    worlds: (W + 1,) int: world w has instances worlds[w] .. worlds[w + 1] - 1; None: all are in one."""

    parts: tuple[Geometry, ...]
    part: np.ndarray
    to_world: np.ndarray
    first_prim: np.ndarray
    n_triangles: int
    worlds: np.ndarray | None = None

    @property
    def first_instance(self) -> np.ndarray:
        """(W + 1,) int64: of each world, and behind them the number of instances."""
        return np.array([0, len(self.part)] if self.worlds is None else self.worlds, np.int64)

    @property
    def n_worlds(self) -> int:
        """Number of worlds; 1 where instances are not in worlds."""
        return 1 if self.worlds is None else len(self.worlds) - 1

    @property
    def world_first_prim(self) -> np.ndarray:
        """(W,) int64: the first of each world's primitives among those of all."""
        if self.worlds is None:
            return np.zeros(1, np.int64)
        return np.append(self.first_prim, self.n_triangles)[self.worlds[:-1]]

    @property
    def numbers(self) -> np.ndarray:
        """(I,) int64: first_prim of each instance in its world, where primitives are numbered from 0."""
        return self.first_prim - np.repeat(self.world_first_prim, np.diff(self.first_instance))

    @property
    def spheres(self) -> np.ndarray:
        """(S, 4) float32, as in Geometry; none of them is an instance."""
        return self.parts[0].spheres

    def __len__(self) -> int:
        return self.n_triangles + len(self.spheres)

    @property
    def is_placed(self) -> np.ndarray:
        """(I,) bool: False of what was joined in the world, and has no transform of its own."""
        return np.array([not isinstance(self.parts[part], NumberedGeometry) for part in self.part], bool)


def inverse_of(matrices: np.ndarray) -> np.ndarray:
    """Of affine maps (I, 3, 4), in float64."""
    linear = np.linalg.inv(matrices[:, :, :3])
    return np.concatenate([linear, -(linear @ matrices[:, :, 3:])], axis=2)
