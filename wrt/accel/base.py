"""Structures over one mesh: construction, refits, files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import warp as wp

from wrt.accel.box_tree import BoxTree, nested
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.ray_query import kernel_argument
from wrt.accel.queries.rays import vectors
from wrt.accel.snapshot import AccelStats, Built, Refit, Snapshot, Structure
from wrt.accel.store import check_order, save
from wrt.accel.structures import options_of
from wrt.core.arrays import check_no_gradients, from_tensor, real_numbers
from wrt.core.building import build_clock, report_parts
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import ArrayLike, Device, KernelModule, PathLike, WarpArray, WarpStruct, WarpType
from wrt.core.warp_private import refuse_capture
from wrt.kernels.traverse.common import Units
from wrt.kernels.warp_private import fields_of
from wrt.scene.values import as_number, near_zero, warn_if_far

MeshT = TypeVar("MeshT", bound="OneMesh")


class OneMesh(Accelerator, ABC):
    """An acceleration structure over one mesh. Subclasses set `name`, `kernels` and `options`, and implement `_build`.

    record: Warp struct of a primitive. units: kernels.traverse.common.Units. accepts: Warp function that can reject hits. A module
    `stream` has make_stream(units, any_hit) -> kernel or None, stream_block (number of rays), and stream_sizes (lengths of the arrays
    in kernels.wide.packets.Scratch).
    """

    name: ClassVar[str]  # Key in wrt.ACCELERATORS.
    kernels: KernelModule  # With make_struct(record) -> Warp struct of the arrays, and make_traversal(units, any_hit, accepts).
    stream: ClassVar[KernelModule | None] = None  # Module of a CPU kernel that traces many rays at a time.
    options: ClassVar[type[Any]]  # A frozen dataclass, which raises InputError for values out of range.
    build_all: ClassVar[Callable[..., list[Built]] | None] = None  # (structures, options), if it is faster than `_build` of each.
    built_with: Any  # an instance of `options`
    can_refit: ClassVar[bool] = False  # True if `_refit` is implemented.

    def __init__(self, geometry: Geometry, attributes: FlatScene | None = None, /, device: str = DEFAULT_DEVICE,
                 threads: int | None = None, *, triangle: str = "watertight", box: str = "conservative", **options: object) -> None:
        super().__init__(Structure(type(self), Units(triangle, box)), geometry, attributes, device, threads)
        self.built_with, begin = options_of(self.name, self.options, options), build_clock()
        built = self._build(self.built_with)
        self._install(built, begin, built.sah_cost)

    @classmethod
    def restore(cls, built: Built, geometry: Geometry, attributes: FlatScene | None = None, /, device: str = DEFAULT_DEVICE,
                threads: int | None = None, *, units: Units | None = None, built_with: object = None) -> Self:
        """Make a structure from saved arrays, or raise InputError if they do not fit. units: intersection tests; built_with: options."""
        begin, built_with = build_clock(), cls.options() if built_with is None else built_with
        self = unbuilt(cls, units or Units(), built_with, geometry, attributes, device, threads)
        check_order(built.order, len(geometry), cls.name)
        self._check(built)
        self._install(built, begin, built.sah_cost)
        return self

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the arrays and the geometry. In the unpickled structure, Refit.growth is relative to the present SAH cost."""
        named = {"device": str(self.device), "threads": self.threads, "units": self.structure.units, "built_with": self.built_with}
        return partial(type(self).restore, **named), (self.built, self.geometry, self._snapshot.attributes)

    @property
    def geometry(self) -> Geometry:
        """Geometry of the mesh, as of the last refit."""
        return self._snapshot.mesh

    @property
    def built(self) -> Built:
        """Result of the builder or of the last refit, in NumPy arrays."""
        return self._snapshot.arrays.on_host()

    @property
    def world(self) -> WarpStruct:
        """The structure, as of the last refit, as an argument of the user's kernels (`wrt.ray_query`)."""
        return kernel_argument(self._snapshot)

    def _over(self, geometry: Geometry, built: Built | None = None, built_cost: float = np.nan) -> Self:
        """Return a copy over another geometry, with the arrays of `built`. Queries of `self` still use the old geometry."""
        other, old = copy(self), self._snapshot
        other._snapshot = Snapshot(old.structure, old.device, old.surfaces, old.attributes, geometry)
        if built is not None:
            other._install(built, build_clock(), built_cost)
        return other

    def _install(self, built: Built, begin: float, built_cost: float) -> None:
        """Upload the arrays and set the snapshot. begin: build_clock() at the start of the build; built_cost: as in Snapshot."""
        data = self._upload(built)
        stats = AccelStats(build_clock() - begin, built.nodes, built.leaves, built.depth, built.references,
                           array_bytes(data), built.sah_cost)
        self._snapshot = replace(self._snapshot, built=built, data=data, stats=stats, built_cost=built_cost)

    @abstractmethod
    def _build(self, options: Any) -> Built:
        """Build over self.geometry. options: an instance of the class's `options`."""

    def _check(self, built: Built) -> None:
        """Raise InputError if arrays from a file would lead a ray out of bounds or into a cycle."""
        raise InputError(f"a {self.name} cannot be read from a file")

    def _refit(self, built: Built) -> Built:
        """Fit the tree to the moved vertices of self.geometry. Called only if can_refit."""
        raise NotImplementedError

    def _moved(self, vertices: ArrayLike) -> Geometry:
        """Return the geometry with new vertices, or raise InputError."""
        return moved_to(self.geometry, vertices)

    def _refit_in_place(self, points: ArrayLike) -> None:
        raise InputError(f"a {self.name} cannot be refitted in place", hint="use bvh8, bvh4 or bvh2")

    def refit(self, vertices: ArrayLike, rebuild_at: float = np.inf, *, in_place: bool = False) -> Refit:
        """Fit the boxes of the tree to moved vertices. The topology of the tree does not change.

        Hits are bit for bit those of a new structure, but queries become slower if neighbouring primitives move apart. Queries in
        other threads that begin before the refit ends see the old vertices.

        Parameters
        ----------
        vertices : (V, 3) array_like, or Warp array (V,) of vec3
            New vertices, as many as before, finite (not checked in a Warp array on a GPU). bvh2 does not copy a Warp array to the
            host. While a `wp.Tape` records, gradients of later hits flow to a Warp array that requires gradients.
        rebuild_at : float
            Build a new tree if the SAH cost exceeds this multiple of its value at the last build.
        in_place : bool
            Only bvh2, bvh4, bvh8 and bvh8c: kernels write to the existing arrays, so that a graph can capture the refit. `vertices` must be
            a Warp array on the structure's device. After the first call, nothing is allocated or copied to the host. No other thread may
            query at the same time.

        Returns
        -------
        Refit
            Growth of the SAH cost (NaN if `in_place`), and whether a new tree was built.

        Raises
        ------
        InputError
            If `vertices` has another shape or is not finite, or the structure cannot be refitted.
        """
        if not self.can_refit:
            raise InputError(f"a {self.name} cannot be refitted", hint="build it again, or use bvh2")
        if not in_place:
            refuse_capture(self.device)
        rebuild_at = np.inf if np.array_equal(rebuild_at, np.inf) else as_number(rebuild_at, "rebuild_at", low=0.0)
        vertices = from_tensor(vertices, "vertices")
        with self._refitting:
            begin, before = build_clock(), self._snapshot
            if in_place:
                check_no_gradients("a refit in place", vertices=vertices)
                self._refit_in_place(vertices)
                return Refit(build_clock() - begin, float("nan"), False)
            beside = self._over(self._moved(vertices))
            built, built_cost = beside._refit(before.arrays), before.built_cost
            growth = float(built.sah_cost) / float(built_cost) if built_cost > 0.0 else 1.0
            if rebuilt := growth > rebuild_at:
                built_cost = (built := beside._build(self.built_with)).sah_cost
            beside._install(built, begin, built_cost)
            followed = vertices if isinstance(vertices, wp.array) and vertices.requires_grad else None
            self._snapshot = replace(beside._snapshot, followed=followed)
            return Refit(beside.stats.build_seconds, growth, rebuilt)

    def tree(self) -> BoxTree:
        """Return the tree of a BVH as plain arrays, the same for all BVHs; `wrt.accel_from_tree` takes it back.

        Returns
        -------
        BoxTree
            Boxes, children and primitives of the nodes. `tree().save("tree.npz")` writes a file that NumPy reads. Spheres and 14-DOPs
            appear as boxes, and boxes of few bits as boxes that contain their children's.

        Raises
        ------
        InputError
            If the structure is not a BVH.
        """
        return nested(self._box_tree(self.built))

    def _box_tree(self, built: Built) -> BoxTree:
        raise InputError(f"a {self.name} has no tree of boxes", hint="use a BVH")

    def _built_of(self, tree: BoxTree) -> Built:
        """Convert a tree, whose boxes contain the padded primitives."""
        raise InputError(f"a {self.name} cannot be made from a tree of boxes", argument="accel", hint="use a BVH")

    def _upload(self, built: Built) -> WarpStruct:
        return uploaded(self.structure, built, self._primitives(built), self.device)

    def _primitives(self, built: Built) -> np.ndarray | WarpArray:
        """Return the records that the triangle test reads, in the order of `built.order`."""
        return self.geometry.primitives(self.structure.units, built.order, self.threads)

    def save(self, path: PathLike, mesh: bool = False) -> None:
        """Write the structure to a file that `wrt.load_accel` reads.

        Parameters
        ----------
        path : str or path, with the suffix .accel
        mesh : bool
            Write the mesh, too, so that `wrt.load_accel(path)` needs none. Of materials, the file has only indices.

        Raises
        ------
        InputError
            If the suffix is not .accel, or the file cannot be written.
        """
        save(self.snapshot, path, mesh)

    def __repr__(self) -> str:
        s = self.stats
        return (f"{type(self).__name__}({len(self.geometry)} primitives, {s.nodes} nodes, depth {s.depth}, "
                f"{s.bytes / 1e6:.1f} MB, {f'SAH {s.sah_cost:.1f}, ' if s.sah_cost == s.sah_cost else ''}built in {s.build_seconds:.3f} s)")


def moved_to(geometry: Geometry, vertices: ArrayLike) -> Geometry:
    """Return a geometry with new vertices. Raises InputError for another shape and for values that are not finite."""
    near, origin = near_zero(real_numbers(vertices, "vertices", "(V, 3)"))
    moved, shape = vectors(near, "vertices").copy(), (geometry.n_vertices, 3)
    if moved.shape != shape:
        raise InputError(f"must be {shape}, got {moved.shape}", argument="vertices")
    warn_if_far(moved, "refit", origin)
    return Geometry(moved, geometry.faces, geometry.spheres, origin)


def uploaded(structure: Structure, built: Built, primitives: np.ndarray | WarpArray, device: Device) -> WarpStruct:
    """Return the struct of a structure's arrays on a device. primitives: the records of the triangle test."""

    def on_device(array: np.ndarray | WarpArray, dtype: WarpType) -> WarpArray:
        return array if isinstance(array, wp.array) else upload(array, dtype, device)

    data = structure.struct()
    types = fields_of(data)
    for name, array in built.arrays.items():
        kind = types[name]
        setattr(data, name, on_device(array, kind.dtype) if isinstance(kind, wp.array) else kind(*np.ravel(array)))
    data.primitives = on_device(primitives, types["primitives"].dtype)
    return data


def array_bytes(data: WarpStruct) -> int:
    """Return the size of all arrays in a Warp struct, in bytes."""
    arrays = (getattr(data, name) for name in fields_of(data))
    return sum(array.capacity for array in arrays if isinstance(array, wp.array))


def unbuilt(kind: type[MeshT], units: Units, built_with: object, geometry: Geometry, attributes: FlatScene | None, device: str,
            threads: int | None) -> MeshT:
    """Make a structure without its tree. built_with: options of the class."""
    out = kind.__new__(kind)
    Accelerator.__init__(out, Structure(kind, units), geometry, attributes, device, threads)
    out.__dict__.update(built_with=built_with)
    return out


def from_tree(kind: type[MeshT], tree: BoxTree, geometry: Geometry, attributes: FlatScene | None, device: str, threads: int | None,
              spatial_splits: bool) -> MeshT:
    """Make a structure from another builder's tree (wrt.accel_from_tree). Raises InputError if it is no tree over the geometry."""
    options = kind.options()
    empty = unbuilt(kind, Units(), options, geometry, attributes, device, threads)
    built = empty._built_of(tree.checked(geometry, spatial_splits))
    return kind.restore(built, geometry, attributes, device, threads, built_with=options)


def build_each(kind: type[MeshT], geometries: Sequence[Geometry], device: str, threads: int | None, units: Units,
               options: dict[str, object]) -> list[MeshT]:
    """Build a structure over each geometry, all with the same options. AccelStats.build_seconds is the time of all of them."""
    begin, built_with = build_clock(), options_of(kind.name, kind.options, options)
    structures = [unbuilt(kind, units, built_with, geometry, None, device, threads) for geometry in geometries]
    built = kind.build_all(structures, built_with) if kind.build_all else report_parts(structures, lambda each: each._build(built_with))
    for each, arrays in zip(structures, built, strict=True):
        each._install(arrays, begin, arrays.sah_cost)
    return structures
