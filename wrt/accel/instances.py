"""Structures of two levels: each mesh is stored once, below a tree over all instances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self, cast, overload

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh, array_bytes, build_each
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import InstancedGeometry, MovedGeometry
from wrt.accel.moves import InstanceNames, ObjectId, check_ids, checked_moves, checked_transforms, is_named, place, refuse_invalid, rows_of
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.ray_query import kernel_argument
from wrt.accel.snapshot import AccelStats, Refit, Structure
from wrt.accel.top_level import BOXES, MOVED_BOXES, TopLevel, build_top, part_boxes, plant, set_boxes
from wrt.core.arrays import check_no_gradients, from_tensor, is_tensor, to_warp
from wrt.core.building import build_clock
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import ArrayLike, Device, WarpArray, WarpStruct
from wrt.core.warp_private import refuse_capture
from wrt.kernels.traverse.common import Units
from wrt.scene.values import as_number, shift

ALIGNMENT = 64  # bytes, between the addresses of structures


class InstanceArrays(Accelerator):
    """Arrays of a structure over instances: what moves and refits in place write, and what the caller may read or write."""

    @property
    def world(self) -> WarpStruct:
        """The structure, as of the last move, as an argument of the user's kernels (`wrt.ray_query`)."""
        return kernel_argument(self._snapshot)

    @property
    def bodies(self) -> WarpArray:
        """By the value of `hits.instance`, the number that `exclude` means: a Warp array of int32 on the device, which the caller may
        write. At first the index of the object in its world; instances with one number are one body. Below 0, no ray excludes it."""
        return self._filters()[0]

    @property
    def masks(self) -> WarpArray:
        """By the value of `hits.instance`, 32 bits, of which the argument `mask` of a ray must have one: a Warp array of int32 on the
        device, which the caller may write. At first all bits."""
        return self._filters()[1]

    def _filters(self) -> tuple[WarpArray, WarpArray]:
        data = self._snapshot.data
        if self._snapshot.bodies is None:
            raise InputError("has no masks and bodies: some objects are no instances", argument="accel",
                             hint="wrt.build(scene, movable=True) makes each object an instance")
        return data.bodies, data.masks

    def _place(self, bottoms: list[OneMesh], geometry: InstancedGeometry, begin: float, filters: Any = None) -> None:
        """Build the upper level, and set the snapshot. filters: values of `bodies` and `masks`; None for those at first."""
        self._set_bottoms(bottoms)
        wide = self.structure.accel.stream is not None and self.device.is_cpu
        boxes = part_boxes(geometry, self.bottoms, max(BOXES // max(len(geometry.part), 1), 8))
        self._top = build_top(geometry, boxes, self.device, self.threads, wide)
        self._roots = upload(self._top.roots, wp.int32, self.device)
        self._bodies, self._masks = filters_of(geometry, self.device, filters)
        self._install_top(geometry, begin, self._top.cost)

    def _set_bottoms(self, bottoms: list[OneMesh]) -> None:
        self.bottoms = bottoms
        # The snapshots keep the arrays alive: the Warp array of structs holds only their addresses.
        self._bottom_snapshots = [bottom.snapshot for bottom in self.bottoms]
        self._bottoms = wp.array([each.data for each in self._bottom_snapshots], dtype=self.structure.bottom, device=self.device)

    def _install_top(self, geometry: InstancedGeometry, begin: float, built_cost: float) -> None:
        """Set the snapshot over the upper level. begin, built_cost: see OneMesh._install."""
        top, data = self._top, self.structure.struct()
        nodes = data.nodes = top.data.nodes
        data.placements, data.slack, data.bottoms = top.data.placements, top.data.node_slack, self._bottoms
        if self._bodies is not None:
            data.bodies, data.masks, data.ids = self._bodies, self._masks, upload(top.order, wp.int32, self.device)
        if top.data.wide is not None:
            data.wide, data.roots = top.data.wide, to_warp(np.arange(len(top.roots), dtype=np.int32))
        stats = [each.stats for each in self._bottom_snapshots]
        sizes = np.array([nodes.capacity, *(s.bytes for s in stats)], np.int64)
        data.bases = upload(np.cumsum((sizes + ALIGNMENT - 1) // ALIGNMENT * ALIGNMENT)[:-1], wp.int64, self.device)
        total = AccelStats(
            build_clock() - begin, len(nodes) + sum(s.nodes for s in stats), len(top.order) + sum(s.leaves for s in stats),
            top.depth + max((s.depth for s in stats), default=0), sum(s.references for s in stats),
            array_bytes(data) + sum(s.bytes for s in stats), float("nan"))
        changes = isinstance(geometry, MovedGeometry) or any(each.changes for each in self._bottom_snapshots)
        self._snapshot = replace(self._snapshot, geometry=geometry, data=data, stats=total, built_cost=built_cost, roots=self._roots,
                                 order=top.order, bodies=self._bodies, changes=changes)

    @property
    def invalid_moves(self) -> WarpArray:
        """By the value of `hits.instance`, 1 if the last move in place was invalid, else 0: a Warp array of int32 on the device.

        A matrix must be finite, must not flatten or shear too much, and must not lead farther than 1e18 from 0. After an invalid move no
        ray hits the instance, until it moves again; its matrix in `geometry` stays.
        """
        with self._refitting:
            return self._movable().data.invalid

    def _movable(self) -> TopLevel:
        """Return the upper level with what moves need, which is made by the first move."""
        if "rows" not in self._cache:
            geometry: Any = self._snapshot.geometry
            rows = self._cache["rows"] = rows_of(geometry, self._snapshot.attributes)
            self._cache["all"] = upload(np.flatnonzero(rows >= 0), wp.int32, self.device)
            self._top = self._top.movable(rows, geometry, part_boxes(geometry, self.bottoms, MOVED_BOXES))
        return self._top

    def refit(self, object: ObjectId, vertices: ArrayLike, world: int | None = None) -> Refit:
        """Refit the mesh of an object in place. All its instances follow, in all worlds. Hits are those of a new structure.

        Parameters
        ----------
        object, world
            One object, as for `move`.
        vertices : Warp array (V,) of vec3
            New vertices of the mesh, on the structure's device; if they are not finite, later moves in place of the mesh are invalid.

        Returns
        -------
        Refit
            That of `OneMesh.refit` with `in_place=True`, which says what graphs can capture.

        Raises
        ------
        InputError
            For other arrays, objects that cannot move, meshes far from 0, and structures of meshes that cannot be refitted in place.
        """
        with self._refitting:
            begin, geometry = build_clock(), cast(Any, self._snapshot.geometry)
            if not isinstance(geometry, MovedGeometry):
                refuse_capture(self.device)
            self._movable()
            names = self._cache["names"] = self._cache.get("names") or InstanceNames(geometry, self._snapshot.attributes)
            id, rows = names.find(object, world), self._cache["rows"]
            if id.ndim or rows[id] < 0 or geometry.parts[geometry.part[rows[id]]].origin is not None:
                raise InputError("must be one object with a matrix of its own, and with a mesh near 0", argument="object")
            part = int(geometry.part[rows[id]])
            before, bottom = self.bottoms[part].data, self.bottoms[part].__copy__()
            bottom.refit(vertices, in_place=True)
            if bottom.data is not before:
                self._set_bottoms([*self.bottoms[:part], bottom, *self.bottoms[part + 1 :]])
                geometry = replace(geometry.now(), parts=tuple(each.geometry for each in self.bottoms))
                self._begin_in_place(geometry)
                set_boxes(self._top.data, part_boxes(geometry, self.bottoms, MOVED_BOXES), self.device)
                self._cache[f"part {part}"] = upload(np.flatnonzero((rows >= 0) & (geometry.part[rows] == part)), wp.int32, self.device)
            elif not isinstance(geometry, MovedGeometry):
                self._begin_in_place(geometry)
            self._top.follow(ids := self._cache[f"part {part}"], part, cast(Any, bottom).fitted)
            self._top.fit(ids)
            return Refit(build_clock() - begin, float("nan"), False)

    def _begin_in_place(self, geometry: InstancedGeometry) -> None:
        """Give the structure arrays that no other snapshot shares."""
        if self.device.is_capturing:
            raise InputError("a graph cannot capture the first move in place, which allocates memory",
                             hint="move in place once before the capture")
        begin, cost = build_clock(), self._snapshot.built_cost
        self._top = self._movable().copied()
        data = self._top.data
        data.to_world = upload(geometry.to_world.reshape(-1, 4).copy(), wp.vec4d, self.device)
        data.origin = wp.vec3d(*shift(geometry.origin)[:3, 3])
        self._install_top(MovedGeometry(geometry, data.to_world), begin, cost)


def filters_of(geometry: InstancedGeometry, device: Device, given: Any = None) -> tuple[WarpArray | None, WarpArray | None]:
    """Return the arrays `bodies` and `masks` with their first values, or with those given; None if an object is not an instance."""
    if not geometry.is_placed.all() or len(geometry.spheres):  # hits.instance is not the row of the geometry
        return None, None
    first, n = geometry.first_instance, len(geometry.part)
    bodies, masks = (np.arange(n) - np.repeat(first[:-1], np.diff(first)), np.full(n, -1)) if given is None else given
    return upload(bodies, wp.int32, device), upload(masks, wp.int32, device)


class Instances(InstanceArrays):
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
                threads: int | None, filters: Any = None) -> Self:
        """Make the structure over the structures of all parts of the geometry. The upper level is built. filters: see `_place`."""
        self, begin, units = cls.__new__(cls), build_clock(), bottoms[0].structure.units
        Accelerator.__init__(self, Structure(type(bottoms[0]), units._replace(instances=True)), geometry, attributes, device, threads)
        self._place(bottoms, geometry, begin, filters)
        return self

    @overload
    def move(self, instance: ArrayLike, matrix: ArrayLike | None = ..., rebuild_at: float = ..., *, check: bool = ...) -> Refit: ...
    @overload
    def move(self, instance: str | Sequence[str], matrix: ArrayLike, rebuild_at: float = ..., *,
             world: ArrayLike | None = ...) -> Refit: ...
    @overload
    def move(self, *, matrix: ArrayLike, object: ObjectId | Sequence[ObjectId] | None = ..., world: ArrayLike | None = ...,
             rebuild_at: float = ..., check: bool = ...) -> Refit: ...
    def move(self, instance: ArrayLike | str | Sequence[str] | None = None, matrix: ArrayLike | None = None, rebuild_at: float = np.inf, *,
             object: ObjectId | Sequence[ObjectId] | None = None, world: ArrayLike | None = None, check: bool = False) -> Refit:
        """Move instances to new matrices and fit the boxes of the upper level. Hits are bit for bit those of a new structure.

        `move(matrices)` moves all instances that can move, in the order of `hits.instance`. If matrices and, if given, `instance` are Warp
        arrays or tensors, the move is in place, on their device (docs/moving.md): `world` stays valid, graphs can capture the move, and no
        other thread may query at the same time. Other moves make new arrays, as `OneMesh.refit` does. If such a move takes all instances
        far from 0, `origin` moves to them; a new structure has nearly the same origin.

        Parameters
        ----------
        instance : int, (R,) array_like of int, str or list of str
            Values of `hits.instance`, without repeats, or names as for `object`. Over a scene the values are indices of objects; else
            they are rows of `geometry.to_world`. Over several worlds, row `geometry.first_instance[w] + k` is object k of world w.
            In place: a Warp array of int32, whose values that cannot move are skipped.
        matrix : (4, 4) or (R, 4, 4) array_like
            Affine maps from object to world space. In place: also wp.transformf, rows (R, 7) of position and quaternion, and (R, 3, 4).
        rebuild_at : float
            Build the upper level anew if its SAH cost exceeds this multiple of its value at the last build. Not in place.
        object : str, int or sequence of these
            In place of `instance`: names of objects, or their indices in their scene.
        world : int or (R,) array_like of int, optional
            Worlds of these objects; required over several worlds.
        check : bool
            In place: check the values, which copies them to the host. Other moves are always checked. See `invalid_moves`.

        Returns
        -------
        Refit
            Growth of the upper level's SAH cost (NaN in place), and whether it was built anew.

        Raises
        ------
        InputError
            For other shapes, names and indices, for objects that are not instances, and for matrices that flatten or shear too much.
        """
        if rebuild_at is not np.inf and not np.array_equal(rebuild_at, np.inf):
            rebuild_at = as_number(rebuild_at, "rebuild_at", low=0.0)
        named = is_named(instance)
        if matrix is None and object is None and not named:
            instance, matrix = None, cast(Any, instance)
        if matrix is None or (instance is not None and object is not None) or (object is None and world is not None and not named):
            raise InputError("takes matrices, instance and matrix, or object, world and matrix", place="move")
        with self._refitting:
            given = [each for each in (matrix, instance, object) if each is not None]
            if all(isinstance(each, wp.array) or is_tensor(each) for each in given) and object is None:
                return self._move_in_place([to_warp(from_tensor(each, "matrix", None)) for each in given], rebuild_at, check)
            refuse_capture(self.device)
            if named or object is not None:
                if "names" not in self._cache:
                    self._cache["names"] = InstanceNames(cast(Any, self._snapshot.geometry), self._snapshot.attributes)
                instance = self._cache["names"].find(instance if named else object, world)
            return self._move(cast(Any, instance), matrix, rebuild_at)

    def _move(self, instance: ArrayLike | None, matrix: ArrayLike, rebuild_at: float) -> Refit:
        """Move by arrays on the host. instance: None for all instances that can move."""
        begin, top, before = build_clock(), self._movable().copied(), self._snapshot
        rows, moved = self._cache["rows"], self._cache["all"].numpy() if instance is None else instance
        geometry, placed = place(top, cast(InstancedGeometry, before.geometry), rows, *checked_moves(rows, moved, matrix))
        top.fit(placed)
        cost, present = before.built_cost, top.cost
        growth = present / cost if cost > 0.0 else 1.0
        if rebuilt := growth > rebuild_at:
            top = plant(top.data, geometry.first_instance, self.device, self.threads, top.data.wide is not None)
            cost = top.cost
        self._top = top
        self._install_top(geometry, begin, cost)
        return Refit(self.stats.build_seconds, growth, rebuilt)

    def _move_in_place(self, given: list[WarpArray], rebuild_at: float, check: bool) -> Refit:
        """Move by Warp arrays: matrices and, unless all instances move, values of hits.instance."""
        begin = build_clock()
        if rebuild_at != np.inf:
            raise InputError("a move in place keeps the tree", argument="rebuild_at")
        if not isinstance(geometry := self._snapshot.geometry, MovedGeometry):
            self._begin_in_place(cast(Any, geometry))
        top, (matrices, ids) = self._top, (*given, self._cache["all"])[:2]
        key = ids.shape, ids.strides, ids.dtype, matrices.ptr, matrices.dtype, matrices.shape, matrices.strides, matrices.device, ids.device
        known, transforms = self._cache.get("transforms", (None, None))
        if key != known:  # making the struct takes longer than moving a few instances
            transforms = checked_transforms(ids, matrices, self.device)
            self._cache["transforms"] = key, transforms
        check_no_gradients("a move", matrix=matrices)
        if check:
            refuse_capture(self.device)
            trial = top.copied()
            trial.place(ids, transforms)
            refuse_invalid(check_ids(self._cache["rows"], ids.numpy()), trial.data.invalid.numpy())
        top.place(ids, transforms)
        top.fit(ids)
        return Refit(build_clock() - begin, float("nan"), False)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the structures of all parts and the scene. Unpickling builds the upper level."""
        filters = None if self._bodies is None else [each.numpy() for each in self._filters()]
        return Instances.restore, (self.bottoms, cast(Any, self.geometry).now(), self._snapshot.attributes, str(self.device), self.threads,
                                   filters)

    def __repr__(self) -> str:
        s, geometry = self.stats, self.geometry
        assert isinstance(geometry, InstancedGeometry)
        return (f"Instances({len(geometry)} primitives in {len(geometry.part)} instances of "
                f"{len(self.bottoms)} {self.structure.accel.name}, {s.bytes / 1e6:.1f} MB, built in {s.build_seconds:.3f} s)")
