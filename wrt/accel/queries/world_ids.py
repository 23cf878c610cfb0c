"""Indices of the worlds that the rays of a query see, in a structure over several worlds."""

from copy import copy
from typing import TypeGuard

import numpy as np
import warp as wp

from wrt.accel.geometry import InstancedGeometry
from wrt.accel.snapshot import Snapshot
from wrt.core.arrays import real_numbers, to_numpy
from wrt.core.checks import shown
from wrt.core.device import to_device, upload
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, Device, WarpArray, WarpStruct
from wrt.kernels.query import Worlds


class WorldIds:
    """Index of the world of each of n rays, in arrays on the structure's device."""

    def __init__(self, snapshot: Snapshot, first_prim: np.ndarray, world: ArrayLike, n: int) -> None:
        """Check and upload the argument `world`. first_prim: (W,), index of each world's first primitive among those of all worlds."""
        self.first_prim = first_prim
        self.arrays: WarpStruct = Worlds()
        self.arrays.id, self.arrays.root = self._on(snapshot.device, world, n), snapshot.roots

    def _on(self, device: Device, world: ArrayLike, n: int) -> WarpArray:
        if isinstance(world, wp.array):
            if world.dtype != wp.int32 or world.shape != (n,):
                raise InputError(f"must be ({n},) int32, got {world.shape} {world.dtype.__name__}", argument="world")
            return to_device(world if world.is_contiguous else world.contiguous(), device)
        ids, count = real_numbers(world, "world", f"a number or ({n},)"), len(self.first_prim)
        if ids.shape not in ((), (n,)) or (ids.dtype.kind not in "iu" and ids.size):
            raise InputError(f"must be a whole number or ({n},) of them, got {shown(world)}", argument="world")
        if ids.size and not (ids.min() >= 0 and ids.max() < count):
            raise InputError(f"must be 0 to {count - 1}, got {ids.min() if ids.min() < 0 else ids.max()}", argument="world")
        return upload(np.broadcast_to(ids, (n,)).astype(np.int32), wp.int32, device)

    def of(self, rays: np.ndarray) -> "WorldIds":
        """Return the worlds of some of the rays, given by their indices."""
        some = copy(self)
        arrays: WarpStruct = Worlds()
        arrays.id = wp.array(self.arrays.id.numpy()[rays], dtype=wp.int32, device=self.arrays.id.device)
        arrays.root = self.arrays.root
        vars(some).update(arrays=arrays)
        return some

    def over_all(self, prim_id: ArrayLike) -> np.ndarray:
        """Convert prim_ids, which count within a ray's world, to indices among the primitives of all worlds, (N,) int32; -1 stays."""
        own, world = to_numpy(prim_id), self.arrays.id.numpy()
        return np.where(own >= 0, own + self.first_prim[np.where(own >= 0, world, 0)], -1).astype(np.int32)


def roots_of(snapshot: Snapshot, world: ArrayLike | None, n: int) -> np.ndarray | None:
    """Return the root node of each ray's world, (n,) int32; -1 in a world that does not exist; None for a structure over one mesh.

    Raises InputError that names `world`.
    """
    return roots_at(snapshot, check_world(snapshot, world, n), n)


def roots_at(snapshot: Snapshot, worlds: WorldIds | None, n: int) -> np.ndarray | None:
    """Return the roots of `roots_of` for worlds that `check_world` converted."""
    if snapshot.roots is None:
        return None
    roots = np.append(snapshot.roots.numpy(), np.int32(-1))
    if worlds is None:
        return np.full(n, roots[0], np.int32)
    ids = worlds.arrays.id.numpy()
    return np.asarray(roots[np.where((ids >= 0) & (ids < len(roots) - 1), ids, -1)])


def over_worlds(geometry: object) -> TypeGuard[InstancedGeometry]:
    """Return whether a structure was built from a list of worlds."""
    return isinstance(geometry, InstancedGeometry) and geometry.worlds is not None


def check_world(snapshot: Snapshot, world: ArrayLike | None, n: int) -> WorldIds | None:
    """Check and convert the argument `world` of a query with n rays; None stays None. Raises InputError that names `world`."""
    geometry = snapshot.geometry
    if world is None:
        if over_worlds(geometry) and geometry.n_worlds > 1:
            raise InputError(f"must not be None: the structure is over {geometry.n_worlds} worlds, because wrt.build makes a world of"
                             " each entry of a list, and a ray sees one of them", argument="world",
                             hint="for one scene of these meshes: wrt.build(wrt.Scene.of(meshes))")
        return None
    if not over_worlds(geometry):
        raise InputError("is for structures over worlds, which wrt.build makes from a list of meshes or scenes", argument="world")
    return WorldIds(snapshot, geometry.world_first_prim, world, n)
