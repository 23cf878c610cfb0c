"""Structures of two levels: each mesh is stored once, below a tree over all instances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Any, Self, TypeAlias, TypeGuard, cast, overload

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh, array_bytes, build_each
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import MAX_SPREAD, InstancedGeometry, inverse_of, spread_of
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.ray_query import kernel_argument
from wrt.accel.snapshot import AccelStats, Refit, Structure
from wrt.accel.top_level import BOXES, MOVED_BOXES, Boxes, build_top, part_boxes, refit_top, widen, world_boxes
from wrt.core.arrays import real_numbers, to_warp
from wrt.core.building import build_clock
from wrt.core.checks import shown, unknown
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import ArrayLike, WarpStruct
from wrt.core.warp_private import refuse_capture
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.instances import Placement
from wrt.kernels.warp_private import fields_of
from wrt.scene.values import FAR, FAR_IN_A_SCENE, MAX_REACH, SMALLEST, as_number, far_origin, warn_if_alone

ObjectId: TypeAlias = str | int
ALIGNMENT = 64  # bytes, between the addresses of structures


class Instances(Accelerator):
    """A binary BVH over instances of meshes, made by `wrt.build`. Each mesh has one structure; all structures are of one class.

    The closest hit does not depend on the tree: it is the closest of the hits that the meshes' structures find in their own spaces.
    """

    name = "instances"

    def __init__(self, kind: type[OneMesh], geometry: InstancedGeometry, attributes: FlatScene | None = None, /,
                 device: str = DEFAULT_DEVICE, threads: int | None = None, *, triangle: str = "watertight",
                 box: str = "conservative", **options: object) -> None:
        begin = build_clock()
        super().__init__(Structure(kind, Units(triangle, box, instances=True)), geometry, attributes, device, threads)
        self._place(build_each(kind, geometry.parts, device, threads, Units(triangle, box), options), geometry, begin)

    @classmethod
    def restore(cls, bottoms: list[OneMesh], geometry: InstancedGeometry, attributes: FlatScene | None, device: str,
                threads: int | None) -> Self:
        """Make the structure over the structures of all parts of the geometry. The upper level is built."""
        self, begin, units = cls.__new__(cls), build_clock(), bottoms[0].structure.units
        Accelerator.__init__(self, Structure(type(bottoms[0]), units._replace(instances=True)), geometry, attributes, device, threads)
        self._place(bottoms, geometry, begin)
        return self

    def _place(self, bottoms: list[OneMesh], geometry: InstancedGeometry, begin: float) -> None:
        """Build the upper level, and set the snapshot."""
        self.bottoms = bottoms
        # The snapshots keep the arrays alive: the Warp array of structs holds only their addresses.
        self._bottom_snapshots = [bottom.snapshot for bottom in self.bottoms]
        self._bottoms = wp.array([each.data for each in self._bottom_snapshots], dtype=self.structure.bottom, device=self.device)
        self._top = build_top(geometry, *world_boxes(geometry, np.arange(len(geometry.part)), self._boxes(geometry, BOXES)))
        self._wide = widen(self._top.nodes, self._top.roots)
        self._roots = upload(self._top.roots, wp.int32, self.device)
        self._install_top(geometry, begin, self._top.cost)

    @property
    def world(self) -> WarpStruct:
        """The structure, as of the last move, as an argument of the user's kernels (`wrt.ray_query`)."""
        return kernel_argument(self._snapshot)

    def _boxes(self, geometry: InstancedGeometry, most: int) -> list[Boxes]:
        return part_boxes(geometry, [bottom.built.order for bottom in self.bottoms], most)

    def _install_top(self, geometry: InstancedGeometry, begin: float, built_cost: float) -> None:
        """Upload the upper level and set the snapshot. begin, built_cost: see OneMesh._install."""
        top, data = self._top, self.structure.struct()
        sizes = np.array([top.nodes.nbytes, *(each.stats.bytes for each in self._bottom_snapshots)], np.int64)
        data.nodes = upload(top.nodes, fields_of(data)["nodes"].dtype, self.device)
        if self.structure.accel.stream is not None and self.device.is_cpu:
            data.wide, data.roots = to_warp(self._wide.nodes(top.nodes)), to_warp(self._wide.roots)
        data.placements = upload(top.placements, Placement, self.device)
        data.bottoms, data.slack = self._bottoms, top.slack
        data.bases = upload(np.cumsum((sizes + ALIGNMENT - 1) // ALIGNMENT * ALIGNMENT)[:-1], wp.int64, self.device)
        stats = [each.stats for each in self._bottom_snapshots]
        total = AccelStats(
            build_clock() - begin, len(top.nodes) + sum(s.nodes for s in stats), len(top.order) + sum(s.leaves for s in stats),
            top.depth + max((s.depth for s in stats), default=0), sum(s.references for s in stats),
            array_bytes(data) + sum(s.bytes for s in stats), float("nan"))
        self._snapshot = replace(self._snapshot, geometry=geometry, data=data, stats=total, built_cost=built_cost, roots=self._roots,
                                 order=top.order)

    @overload
    def move(self, instance: ArrayLike, matrix: ArrayLike, rebuild_at: float = ...) -> Refit: ...
    @overload
    def move(self, instance: str | Sequence[str], matrix: ArrayLike, rebuild_at: float = ..., *,
             world: ArrayLike | None = ...) -> Refit: ...
    @overload
    def move(self, *, object: ObjectId | Sequence[ObjectId], matrix: ArrayLike, world: ArrayLike | None = ...,
             rebuild_at: float = ...) -> Refit: ...
    def move(self, instance: ArrayLike | str | Sequence[str] | None = None, matrix: ArrayLike | None = None, rebuild_at: float = np.inf, *,
             object: ObjectId | Sequence[ObjectId] | None = None, world: ArrayLike | None = None) -> Refit:
        """Move instances to new matrices and fit the boxes of the upper level. Hits are bit for bit those of a new structure.

        If a move takes all instances far from 0, `origin` moves to them; a new structure has nearly the same origin.
        Other threads may query at the same time, as during `OneMesh.refit`.

        Parameters
        ----------
        instance : int, (R,) array_like of int, str or list of str
            Values of `hits.instance`, without repeats, or names as for `object`. Over a scene the values are indices of objects; else
            they are rows of `geometry.to_world`. Over several worlds, row `geometry.first_instance[w] + k` is object k of world w.
        matrix : (4, 4) or (R, 4, 4) array_like
            Affine maps from object to world space.
        rebuild_at : float
            Build the upper level anew if its SAH cost exceeds this multiple of its value at the last build.
        object : str, int or sequence of these
            In place of `instance`: names of objects, or their indices in their scene.
        world : int or (R,) array_like of int, optional
            Worlds of these objects; required over several worlds.

        Returns
        -------
        Refit
            Growth of the upper level's SAH cost, and whether it was built anew.

        Raises
        ------
        InputError
            For other shapes, names and indices, for objects that are not instances, and for matrices that flatten or shear too much.
        """
        refuse_capture(self.device)
        rebuild_at = np.inf if np.array_equal(rebuild_at, np.inf) else as_number(rebuild_at, "rebuild_at", low=0.0)
        with self._refitting:
            begin, before, geometry = build_clock(), self._snapshot, cast(Any, self._snapshot.geometry)
            if is_named(instance):
                instance, object = object, instance
            if (instance is None) == (object is None) or matrix is None or (object is None and world is not None):
                raise InputError("takes instance and matrix, or object, world and matrix", place="move")
            if object is not None:
                if "names" not in self._cache:
                    self._cache["names"] = InstanceNames(geometry, before.attributes)
                instance = self._cache["names"].find(object, world)
            assert instance is not None
            rows, matrices = checked_moves(rows_of(geometry, before.attributes), instance, matrix)
            to_world = geometry.to_world.copy()
            to_world[rows] = geometry.near_zero(rows, matrices)
            geometry, rows, low, high = self._boxed(replace(geometry, to_world=to_world), rows)
            top, cost = refit_top(self._top, geometry, rows, low, high), before.built_cost
            growth = top.cost / cost if cost > 0.0 else 1.0
            if rebuilt := growth > rebuild_at:
                top = build_top(geometry, top.low, top.high)
                self._wide, cost = widen(top.nodes, top.roots), top.cost
            self._top = top
            self._install_top(geometry, begin, cost)
            return Refit(self.stats.build_seconds, growth, rebuilt)

    def _boxed(self, geometry: InstancedGeometry, rows: np.ndarray) -> tuple[InstancedGeometry, np.ndarray, np.ndarray, np.ndarray]:
        """Return the geometry, the moved instances and their boxes: all instances, if their origin changes."""
        if "boxes" not in self._cache:
            self._cache["boxes"] = self._boxes(geometry, MOVED_BOXES)
        low, high = world_boxes(geometry, rows, self._cache["boxes"])
        if not ((np.maximum(np.abs(low), np.abs(high)) <= MAX_REACH) | (low > high)).all():
            raise InputError(f"puts an instance farther than {MAX_REACH:g} from the origin", argument="matrix")
        if geometry.origin is None and not (np.maximum(-low, high) > 0.5 * FAR * (high - low).max(axis=1, keepdims=True)).any():
            return geometry, rows, low, high
        lows, highs = self._top.low.astype(np.float64), self._top.high.astype(np.float64)
        lows[rows], highs[rows] = low, high
        some = (lows <= highs).all(axis=1)
        if not some.any() or len(geometry.spheres) or not geometry.is_placed.all():  # these have no matrix of their own
            return geometry, rows, low, high
        for _ in range(4):  # boxes are rounded where they were: each turn is more exact
            ends, old = (lows[some].min(axis=0), highs[some].max(axis=0)), np.zeros(3) if geometry.origin is None else geometry.origin
            if (far := far_origin(*ends)) is not None:
                origin: np.ndarray | None = old + far
            elif geometry.origin is not None and far_origin(ends[0] + old, ends[1] + old) is None:
                origin = None
            else:
                half = np.where(low <= high, 0.5 * (high - low), np.inf).max(axis=1)
                for row in np.flatnonzero(np.maximum(-low, high).max(axis=1) > FAR_IN_A_SCENE * np.maximum(half, SMALLEST))[:1]:
                    warn_if_alone(low[row], high[row], "a moved instance")
                break
            to_world, rows = geometry.to_world.copy(), np.arange(len(lows))
            to_world[:, :, 3] += old - (0.0 if origin is None else origin)
            geometry = replace(geometry, to_world=to_world, origin=origin)
            low, high = world_boxes(geometry, rows, self._cache["boxes"])
            lows, highs = low.astype(np.float64), high.astype(np.float64)
        return geometry, rows, low, high

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the structures of all parts and the scene. Unpickling builds the upper level."""
        return Instances.restore, (self.bottoms, self.geometry, self._snapshot.attributes, str(self.device), self.threads)

    def __repr__(self) -> str:
        s, geometry = self.stats, self.geometry
        assert isinstance(geometry, InstancedGeometry)
        return (f"Instances({len(geometry)} primitives in {len(geometry.part)} instances of "
                f"{len(self.bottoms)} {self.structure.accel.name}, {s.bytes / 1e6:.1f} MB, built in {s.build_seconds:.3f} s)")


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
    """Check the arguments of Instances.move; return rows (R,) of to_world and matrices (R, 3, 4) float64. row_of: from `rows_of`.

    Raises InputError that names the argument.
    """
    rows = real_numbers(instance, "instance", "a whole number, or (R,)")
    if rows.ndim > 1 or (rows.dtype.kind not in "iu" and rows.size):
        raise InputError(f"must be a whole number, or (R,) of them, got {shown(instance)}", argument="instance")
    matrices = real_numbers(matrix, "matrix", f"{(*rows.shape, 4, 4)}").astype(np.float64)
    if matrices.shape not in ((*rows.shape, 4, 4), (*rows.shape, 3, 4)):
        raise InputError(f"must be {(*rows.shape, 4, 4)}, got {matrices.shape}", argument="matrix",
                         hint="wp.transform_to_matrix makes one of a transform" if matrices.shape[-1:] == (7,) else None)
    if matrices.shape[-2] == 4 and (matrices[..., 3, :] != [0.0, 0.0, 0.0, 1.0]).any():
        raise InputError("must be affine: its last row must be 0, 0, 0, 1", argument="matrix")
    ids, matrices = rows.reshape(-1).astype(np.int64), matrices[..., :3, :].reshape(-1, 3, 4)
    if len(ids) and not (ids.min() >= 0 and ids.max() < len(row_of)):
        raise InputError(f"must be 0 to {len(row_of) - 1}, got {shown(instance)}", argument="instance")
    if len(np.unique(ids)) < len(ids):
        raise InputError("must not have the same index twice", argument="instance")
    rows = row_of[ids]
    if (rows < 0).any():
        raise InputError(f"instance {ids[np.argmin(rows)]} cannot move: it is a sphere, or was joined with other objects",
                         argument="instance")
    with np.errstate(all="ignore"):
        linear = matrices[:, :, :3]
        good = np.isfinite(matrices).all(axis=(1, 2)) & (np.abs(np.linalg.det(linear)) > 0.0)
        good[good] = spread_of(matrices[good], inverse_of(matrices[good])) <= MAX_SPREAD
    if not good.all():
        raise InputError("must be finite and must not flatten or shear too much, which the matrix of instance"
                         f" {ids[np.argmin(good)]} violates", argument="matrix")
    return rows, matrices


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
