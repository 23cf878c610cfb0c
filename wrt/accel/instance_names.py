"""Instances by the names or indices of their objects, for `Instances.move`."""

from collections.abc import Sequence
from pathlib import PurePath
from typing import TypeAlias

import numpy as np

from wrt.accel.flat_scene import FlatScene
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.core.arrays import real_numbers
from wrt.core.checks import shown, unknown
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike

ObjectId: TypeAlias = str | int


class InstanceNames:
    """The objects of each world; without worlds, those of the one scene."""

    def __init__(self, geometry: InstancedGeometry, scene: FlatScene | None) -> None:
        names = () if scene is None else scene.names
        end = len(geometry.part) if scene is None or scene.objects is None else len(scene.objects)
        self.first = np.array([0, end], np.int64) if geometry.worlds is None else geometry.first_instance
        self.names = [names[begin:stop] for begin, stop in zip(self.first[:-1], self.first[1:], strict=True)]
        self.ids: dict[tuple[int, str], list[int]] = {}  # by world and name
        self.stems: dict[tuple[int, str], list[int]] = {}  # by the name of a file, for meshes that have its path as their name
        for world, each in enumerate(self.names):
            for index, name in enumerate(each):
                for ids, key in ((self.ids, name), (self.stems, PurePath(name).stem)):
                    ids.setdefault((world, key), []).append(int(self.first[world]) + index)

    def find(self, thing: ObjectId | Sequence[ObjectId], world: ArrayLike | None) -> np.ndarray:
        """Return the values of `hits.instance` of objects: one, or (R,) if either argument is a sequence.

        Raises InputError that names `object` or `world`.
        """
        many = isinstance(thing, list | tuple | range | np.ndarray)
        things = np.array(thing if many else [thing], np.dtype("O"))
        if things.ndim > 1:
            raise InputError(f"must be a name or an index, or (R,) of them, got {shown(thing)}", argument="object")
        worlds = self._worlds(world)
        try:
            things, worlds = np.broadcast_arrays(things if many else things.reshape(()), worlds)
        except ValueError:
            raise InputError(f"must be one or {len(things)} worlds, one for each object", argument="world") from None
        ids = [self._find(each, int(one)) for each, one in zip(things.flat, worlds.flat, strict=True)]
        return np.array(ids, np.int64).reshape(things.shape)

    def _worlds(self, world: ArrayLike | None) -> np.ndarray:
        count = len(self.names)
        if world is None and count > 1:
            raise InputError(f"must be given: the structure is over {count} worlds", argument="world",
                             hint=f"np.arange({count}) moves the object in each world, with ({count}, 4, 4) matrices")
        worlds = real_numbers(0 if world is None else world, "world", "a whole number, or (R,)")
        if worlds.ndim > 1 or worlds.dtype.kind not in "iu" or (worlds.size and not (worlds.min() >= 0 and worlds.max() < count)):
            raise InputError(f"must be 0 to {count - 1}, or (R,) of them, got {shown(world)}", argument="world")
        return worlds

    def _find(self, thing: object, world: int) -> int:
        place = f"world {world}" if len(self.names) > 1 else None
        if isinstance(thing, str):
            found = self.ids.get((world, thing)) or self.stems.get((world, thing), [])
            if not found:
                raise unknown(thing, "object", [name for name in self.names[world] if name], argument="object", place=place)
            if len(found) > 1:
                raise InputError(f"{len(found)} objects are called {thing!r}", argument="object", place=place,
                                 hint=f"use an index: {', '.join(str(each - int(self.first[world])) for each in found[:5])}")
            return found[0]
        count = int(self.first[world + 1] - self.first[world])
        if not isinstance(thing, int | np.integer) or isinstance(thing, bool) or not 0 <= thing < count:
            raise InputError(f"must be a name, or 0 to {count - 1}, got {shown(thing)}", argument="object", place=place)
        return int(self.first[world] + thing)
