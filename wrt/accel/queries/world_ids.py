"""The world that each ray of a query sees, in a structure over several."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.snapshot import Snapshot
from wrt.core.arrays import real_numbers, to_numpy
from wrt.core.checks import shown
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.kernels.query import Worlds


class WorldIds:
    """The world of each of n rays: arrays for kernels, on the structure's device."""

    def __init__(self, snapshot: Snapshot, world: Any, n: int) -> None:
        self.first_prim = snapshot.geometry.world_first_prim
        self.arrays: Any = Worlds()
        self.arrays.id, self.arrays.root = self._on(snapshot.device, world, n), snapshot.roots

    def _on(self, device: Any, world: Any, n: int) -> Any:
        if isinstance(world, wp.array):
            if world.dtype != wp.int32 or world.shape != (n,):
                raise InputError(f"must be ({n},) int32, got {world.shape} {world.dtype.__name__}", argument="world")
            return (world if world.is_contiguous else world.contiguous()).to(device)
        ids, count = real_numbers(world, "world", f"a number or ({n},)"), len(self.first_prim)
        if ids.shape not in ((), (n,)) or (ids.dtype.kind not in "iu" and ids.size):
            raise InputError(f"must be a whole number or ({n},) of them, got {shown(world)}", argument="world")
        if ids.size and not (ids.min() >= 0 and ids.max() < count):
            raise InputError(f"must be 0 to {count - 1}, got {ids.min() if ids.min() < 0 else ids.max()}", argument="world")
        return upload(np.broadcast_to(ids, (n,)).astype(np.int32), wp.int32, device)

    def numbered(self, prim_id: Any) -> np.ndarray:
        """(N,) int32: prim_ids of hits as numbers among the primitives of all worlds."""
        own, world = to_numpy(prim_id), self.arrays.id.numpy()
        return np.where(own >= 0, own + self.first_prim[np.where(own >= 0, world, 0)], -1).astype(np.int32)


def worlds_asked(snapshot: Snapshot, world: Any, n: int) -> WorldIds | None:
    """The argument of a query; None where there is but one world, and none is named. Raises InputError that calls it `world`."""
    geometry = snapshot.geometry
    several = isinstance(geometry, InstancedGeometry) and geometry.worlds is not None
    if world is None:
        if several and len(geometry.worlds) > 2:
            raise InputError(f"must be given: the structure is over {len(geometry.worlds) - 1} worlds", argument="world")
        return None
    if not several:
        raise InputError("is for structures over worlds: wrt.build takes a list of them", argument="world")
    return WorldIds(snapshot, world, n)
