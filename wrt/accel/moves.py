"""Arguments of `Instances.move`: instances by value, name and world, matrices, and Warp arrays of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import TypeAlias, TypeGuard

import numpy as np
import warp as wp

from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import InstancedGeometry
from wrt.accel.queries.transforms import require_on, transforms_in, transforms_of
from wrt.accel.top_level import TopLevel
from wrt.core.arrays import real_numbers
from wrt.core.checks import shown, unknown
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, Device, WarpArray, WarpStruct
from wrt.scene.values import FAR, FAR_IN_A_SCENE, MAX_REACH, SMALLEST, far_origin, shift, warn_if_alone

ObjectId: TypeAlias = str | int


def is_named(instance: object) -> TypeGuard[str | list[str]]:
    """Return True for one or more names."""
    return isinstance(instance, str) or (isinstance(instance, list | tuple) and any(isinstance(each, str) for each in instance))


def rows_of(geometry: InstancedGeometry, scene: FlatScene | None) -> np.ndarray:
    """Return the row of geometry.to_world for each value of hits.instance; -1 for objects that are not instances."""
    placed = np.flatnonzero(geometry.is_placed)
    if scene is None or scene.objects is None:
        rows, ids = np.full(len(geometry.part), -1), placed
    else:
        rows, ids = np.full(len(scene.objects), -1), np.searchsorted(scene.objects, geometry.first_prim[placed], "right") - 1
    rows[ids] = placed
    return rows


def checked_moves(row_of: np.ndarray, instance: ArrayLike, matrix: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Check the arguments of Instances.move, except for the values of matrices; return values (R,) of hits.instance and matrices
    (R, 3, 4) float64. row_of: from `rows_of`. Raises InputError that names the argument."""
    rows = real_numbers(instance, "instance", "a whole number, or (R,)")
    if rows.ndim > 1 or (rows.dtype.kind not in "iu" and rows.size):
        raise InputError(f"must be a whole number, or (R,) of them, got {shown(instance)}", argument="instance")
    matrices = real_numbers(matrix, "matrix", f"{(*rows.shape, 4, 4)}").astype(np.float64)
    if matrices.shape not in ((*rows.shape, 4, 4), (*rows.shape, 3, 4)):
        raise InputError(f"must be {(*rows.shape, 4, 4)}, got {matrices.shape}", argument="matrix",
                         hint="Warp arrays of transforms move Warp arrays of instances" if matrices.shape[-1:] == (7,) else None)
    if matrices.shape[-2] == 4 and (matrices[..., 3, :] != [0.0, 0.0, 0.0, 1.0]).any():
        raise InputError("must be affine: its last row must be 0, 0, 0, 1", argument="matrix")
    return check_ids(row_of, rows.reshape(-1)), matrices[..., :3, :].reshape(-1, 3, 4)


def check_ids(row_of: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Return values (R,) of hits.instance as int64. Raises InputError for values that cannot move, and for repeats."""
    ids = ids.astype(np.int64)
    for each in ids[(ids < 0) | (ids >= len(row_of))][:1]:
        raise InputError(f"must be 0 to {len(row_of) - 1}, got {each}", argument="instance")
    if (np.bincount(ids) > 1).any():
        raise InputError("must not have the same index twice", argument="instance")
    if (row_of[ids] < 0).any():
        raise InputError(f"instance {ids[np.argmin(row_of[ids])]} cannot move: it is a sphere, or was joined with other objects",
                         argument="instance")
    return ids


def place(top: TopLevel, before: InstancedGeometry, row_of: np.ndarray, ids: np.ndarray,
          matrices: np.ndarray) -> tuple[InstancedGeometry, WarpArray]:
    """Place the instances of the values `ids` of hits.instance; return the geometry and the values that were placed: all, if the
    origin changes. row_of: from `rows_of`. Raises InputError for invalid matrices."""
    geometry, device, rows = before.now(), top.data.nodes.device, row_of[ids]
    to_world = geometry.to_world.copy()
    to_world[rows] = geometry.near_zero(rows, matrices)
    geometry = replace(geometry, to_world=to_world)
    for turn in range(5):  # boxes are rounded where they were: each turn is more exact
        values = upload(ids, wp.int32, device)
        top.data.pending.zero_()
        top.place(values, transforms_of(geometry.to_world[row_of[ids]], 12, device))
        refuse_invalid(ids, top.data.invalid.numpy())
        low, high = (corner.numpy().astype(np.float64) for corner in (top.data.low, top.data.high))
        far = np.maximum(-low, high).max(axis=1)[rows]
        if geometry.origin is None and turn == 0 and not (far > 0.5 * FAR * (high - low).max(axis=1)[rows]).any():
            break
        some = (low <= high).all(axis=1)
        if turn == 4 or not some.any() or len(geometry.spheres) or not geometry.is_placed.all():  # these have no matrix of their own
            break
        ends, old = (low[some].min(axis=0), high[some].max(axis=0)), shift(geometry.origin)[:3, 3]
        if (step := far_origin(*ends)) is not None:
            origin: np.ndarray | None = old + step
        elif geometry.origin is not None and far_origin(ends[0] + old, ends[1] + old) is None:
            origin = None
        else:
            half = np.where(low <= high, 0.5 * (high - low), np.inf).max(axis=1)[rows]
            for row in rows[far > FAR_IN_A_SCENE * np.maximum(half, SMALLEST)][:1]:
                warn_if_alone(low[row], high[row], "a moved instance")
            break
        to_world, ids = geometry.to_world.copy(), np.flatnonzero(row_of >= 0)
        rows = row_of[ids]
        to_world[:, :, 3] += old - shift(origin)[:3, 3]
        geometry = replace(geometry, to_world=to_world, origin=origin)
    return geometry, values


def refuse_invalid(ids: np.ndarray, invalid: np.ndarray) -> None:
    """Raise InputError if the move of one of these values of hits.instance is invalid. invalid: see `Instances.invalid_moves`."""
    for each in ids[invalid[ids] > 0][:1]:
        raise InputError(f"must be finite, must not flatten or shear too much, and must not put an instance farther than {MAX_REACH:g} from"
                         f" the origin, which the matrix of instance {each} violates", argument="matrix")


def checked_transforms(ids: WarpArray, matrices: WarpArray, device: Device) -> WarpStruct:
    """Return kernels.transforms.Transforms of the arguments of a move in place; values are not checked."""
    require_on(device, instance=ids, matrix=matrices)
    if ids.dtype != wp.int32 or ids.ndim != 1:
        raise InputError(f"must be a Warp array (R,) of int32, got {shown(ids)}", argument="instance")
    return transforms_in(matrices, "matrix", str(len(ids)), lambda shape: shape == ids.shape, outside=True)[0]


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
