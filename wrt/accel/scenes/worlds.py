"""Several worlds in one structure: each ray sees the instances of one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.scenes.flatten import World, world_of
from wrt.accel.scenes.instancing import is_invertible
from wrt.core.arrays import real_numbers, to_numpy
from wrt.core.checks import shown
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.kernels.query import Worlds
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene


def worlds_over(given: Sequence[Mesh | Scene]) -> World:
    """One geometry over several worlds, all of whose objects are instances; each mesh is kept once. Raises InputError for spheres
    and for objects that are flattened."""
    for number, scene in enumerate(given):
        for thing in scene.objects if isinstance(scene, Scene) else ():
            if not is_invertible(thing):
                raise InputError(f"world {number}: object {thing.name!r} is flattened or sheared too much to be an instance")
        if isinstance(scene, Scene) and scene.spheres:
            raise InputError(f"world {number} has spheres; worlds are of meshes")
    grey = (Material(),)
    objects = [scene.objects if isinstance(scene, Scene) else (Object(scene, grey),) for scene in given]
    together = tuple(thing for each in objects for thing in each)
    if not together:
        raise InputError("worlds must have at least one object between them")
    world = world_of(Scene(together), frozenset(id(thing.mesh) for thing in together))
    geometry: Any = world.geometry
    return replace(world, geometry=replace(geometry, worlds=np.cumsum([0, *map(len, objects)])), objects=None)


class WorldIds:
    """The world of each of n rays: arrays for kernels, on the structure's device."""

    def __init__(self, accel: Any, geometry: InstancedGeometry, world: Any, n: int) -> None:
        self.first_prim = geometry.world_first_prim
        self.arrays: Any = Worlds()
        self.arrays.id, self.arrays.root = self._on(accel.device, world, n), accel.roots

    def _on(self, device: Any, world: Any, n: int) -> Any:
        if isinstance(world, wp.array):
            if world.dtype != wp.int32 or world.shape != (n,):
                raise InputError(f"world must be ({n},) int32, got {world.shape} {world.dtype.__name__}")
            return (world if world.is_contiguous else world.contiguous()).to(device)
        ids, count = real_numbers(world, "world", f"a number or ({n},)"), len(self.first_prim)
        if ids.shape not in ((), (n,)) or (ids.dtype.kind not in "iu" and ids.size):
            raise InputError(f"world must be a whole number or ({n},) of them, got {shown(world)}")
        if ids.size and not (ids.min() >= 0 and ids.max() < count):
            raise InputError(f"world must be 0 to {count - 1}, got {ids.min() if ids.min() < 0 else ids.max()}")
        return upload(np.broadcast_to(ids, (n,)).astype(np.int32), wp.int32, device)

    def numbered(self, prim_id: Any) -> np.ndarray:
        """(N,) int32: prim_ids of hits as numbers among the primitives of all worlds."""
        own, world = to_numpy(prim_id), self.arrays.id.numpy()
        return np.where(own >= 0, own + self.first_prim[np.where(own >= 0, world, 0)], -1).astype(np.int32)


def worlds_asked(accel: Any, geometry: Any, world: Any, n: int) -> WorldIds | None:
    """The argument of a query; None where there is but one world, and none is named. Raises InputError that calls it `world`."""
    several = isinstance(geometry, InstancedGeometry) and geometry.worlds is not None
    if world is None:
        if several and len(geometry.worlds) > 2:
            raise InputError(f"world must be given: the structure is over {len(geometry.worlds) - 1} worlds")
        return None
    if not several:
        raise InputError("world is for structures over worlds: wrt.build takes a list of them")
    return WorldIds(accel, geometry, world, n)
