"""A structure over one mesh: what it is built from, what becomes of it, what it tells of itself."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
import warp as wp

from wrt.accel.built import AccelStats, Built, Refit
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.ray_query import kernel_argument
from wrt.accel.queries.rays import vectors
from wrt.accel.store import check_order, save
from wrt.accel.structure import Structure, options_of
from wrt.core.arrays import check_no_gradients, taken
from wrt.core.device import upload
from wrt.core.errors import InputError
from wrt.core.seconds import build_clock
from wrt.kernels.traverse.common import Units
from wrt.kernels.warp_private import fields_of


class OneMesh(Accelerator, ABC):
    """A structure over a geometry, on a device. Subclasses set `name`, `kernels` and `options`, and implement `_build`.

    options: a frozen dataclass of what the builder can be told; it raises InputError for values out of range. kernels: the
    traversal's module, with make_struct(record) and make_traversal(units, any_hit, accepts). stream: of structures with a kernel
    for many rays at a time on the CPU (wrt.accel.queries.batches), where that is made: make_stream(units, any_hit), which gives
    None for units that it has no kernel for; stream_block; stream_sizes. The last of the kernel's slots tells whether it met a ray
    that a query refuses. can_refit: whether `_refit` follows vertices.
    """

    name: ClassVar[str]
    kernels: Any
    stream: ClassVar[Any] = None
    options: ClassVar[type[Any]]
    can_refit: ClassVar[bool] = False

    def __init__(self, geometry: Geometry, attributes: FlatScene | None = None, /, device: str = "cpu", threads: int | None = None, *,
                 triangle: str = "watertight", box: str = "conservative", **options: Any) -> None:
        super().__init__(Structure(type(self), Units(triangle, box)), geometry.kept(), attributes, device, threads)
        self.built_with = options_of(self.name, self.options, options)
        begin = build_clock()
        built = self._build(self.built_with)
        self._take(built, begin, built.sah_cost)

    @classmethod
    def restore(cls, built: Built, geometry: Geometry, attributes: FlatScene | None = None, /, device: str = "cpu",
                threads: int | None = None, *, units: Units | None = None, built_with: Any = None) -> Self:
        """What was built before over the same geometry. built_with: its options (None: not known, and those that there are by
        default). Raises InputError where `built` is no such structure."""
        self = cls.__new__(cls)
        Accelerator.__init__(self, Structure(cls, units or Units()), geometry.kept(), attributes, device, threads)
        self.built_with = cls.options() if built_with is None else built_with
        begin = build_clock()
        check_order(built.order, len(geometry), cls.name)
        self._check(built)
        self._take(built, begin, built.sah_cost)
        return self

    def __reduce__(self) -> Any:
        """For pickle: what `save` writes, and what the structure is over. A refit there measures growth from the shape of now."""
        units, snapshot = self.structure.units, self._snapshot
        make = partial(type(self).restore, device=str(self.device), threads=self.threads, units=units, built_with=self.built_with)
        return make, (snapshot.built.on_host(), snapshot.geometry, snapshot.attributes)

    @property
    def geometry(self) -> Geometry:
        """The geometry that the structure is over, as it is now."""
        geometry: Geometry = self._snapshot.geometry
        return geometry

    @property
    def built(self) -> Built:
        """What the builder gave, or the last refit."""
        built: Built = self._snapshot.built
        return built.on_host()

    @property
    def world(self) -> Any:
        """The structure, as it is now, as an argument of a kernel of one's own (wrt.ray_query)."""
        return kernel_argument(self._snapshot)

    def _over(self, geometry: Geometry) -> Self:
        """A copy over another geometry, before anything is built over it: others still ask for the old shape."""
        other = copy(self)
        other._snapshot = self._snapshot.over(geometry)
        return other

    def _built_over(self, geometry: Geometry, built: Built, built_cost: float) -> Self:
        """A copy with what was built over another geometry."""
        other = self._over(geometry)
        other._take(built, build_clock(), built_cost)
        return other

    def _take(self, built: Built, begin: float, built_cost: float) -> None:
        """Have what was built. begin: when that began; built_cost: as in Snapshot."""
        data = self._upload(built)
        stats = AccelStats(build_clock() - begin, built.nodes, built.leaves, built.depth, built.references,
                           array_bytes(data), built.sah_cost)
        self._snapshot = replace(self._snapshot, built=built, data=data, stats=stats, built_cost=built_cost)

    @abstractmethod
    def _build(self, options: Any) -> Built:
        """The structure over self.geometry, on the host; options: an instance of the class's `options`."""

    def _check(self, built: Built) -> None:
        """Raise InputError where arrays that come from a file would lead a ray out of them or round in circles."""
        raise InputError(f"a {self.name} cannot be read from a file")

    def _refit(self, built: Built) -> Built:
        """The same tree around self.geometry, whose vertices have moved. Asked of structures that can_refit."""
        raise NotImplementedError

    def _moved(self, vertices: Any) -> Geometry:
        """The geometry with other vertices. Raises InputError for what these cannot be."""
        moved = vectors(vertices, "vertices").copy()
        if moved.shape != (self.geometry.n_vertices, 3):
            raise InputError(f"must be {(self.geometry.n_vertices, 3)}, got {moved.shape}", argument="vertices")
        return Geometry(moved, self.geometry.faces, self.geometry.spheres)

    def _refit_in_place(self, points: Any) -> None:
        """As `refit`, in place."""
        raise InputError(f"a {self.name} cannot be refitted in place", hint="take bvh2")

    def refit(self, vertices: Any, rebuild_at: float = np.inf, *, in_place: bool = False) -> Refit:
        """Follow vertices that have moved, (V, 3) float32 (a tensor, too) or a Warp array (V,) of vec3, as many as before: boxes
        are fitted anew, the tree stays as it is. bvh2 takes a Warp array where it is: of a GPU nothing comes to the host but the
        growth.

        It answers as exactly as a new one, but slower and slower as the motion mixes what was near. rebuild_at: build it anew
        (as it was built) where the SAH cost passes this multiple of what it was when built. Other threads may go on asking:
        every query that begins before the refit ends answers of the old shape, all others of the new one. While a wp.Tape records,
        hits after it have gradients in a Warp array that requires them.

        in_place: from a Warp array on the structure's device into the arrays that there are, for a CUDA graph to capture: after a
        first call no memory is taken, nothing copied and nothing waited for; the growth is not known (NaN), and no other thread
        may ask meanwhile. Raises InputError for another shape or values that are not finite (of a Warp array on a GPU they are
        not looked at), and from structures that cannot be refitted.
        """
        if not self.can_refit:
            raise InputError(f"a {self.name} cannot follow vertices that move", hint="build it again, or take bvh2")
        vertices = taken(vertices, "vertices")
        with self._refitting:
            begin, before = build_clock(), self._snapshot
            if in_place:
                check_no_gradients("a refit in place", vertices=vertices)
                self._refit_in_place(vertices)
                return Refit(build_clock() - begin, float("nan"), False)
            beside = self._over(self._moved(vertices))
            built, built_cost = beside._refit(before.built), before.built_cost
            growth = float(built.sah_cost) / float(built_cost) if built_cost > 0.0 else 1.0
            if rebuilt := growth > rebuild_at:
                built = beside._build(self.built_with)
                built_cost = built.sah_cost
            beside._take(built, begin, built_cost)
            followed = vertices if isinstance(vertices, wp.array) and vertices.requires_grad else None
            self._snapshot = replace(beside._snapshot, followed=followed)
            return Refit(beside.stats.build_seconds, growth, rebuilt)

    def _children(self, built: Built) -> Any:
        """A hierarchy of boxes as kernels.build.end_point_overlap.Children."""
        raise InputError(f"a {self.name} has no end-point overlap: it is no hierarchy of boxes")

    def epo(self) -> float:
        """End-point overlap of a BVH: nodes and primitives visited for nothing at a random point of the surface
        (wrt.accel.epo).

        It tells of rays that end, as stats.sah_cost does of lines that nothing stops; it takes about as long as a build. Raises
        InputError for structures that are no BVH.
        """
        from wrt.accel.epo import end_point_overlap

        snapshot = self._snapshot
        return end_point_overlap(self._children(snapshot.built.on_host()), snapshot.geometry, self.threads)

    def _upload(self, built: Built) -> Any:
        data = self.structure.struct()
        types = fields_of(data)
        for name, array in built.arrays.items():
            kind = types[name]
            is_array = isinstance(kind, wp.array)
            setattr(data, name, self._there(array, kind.dtype) if is_array else kind(*np.ravel(array)))
        data.primitives = self._there(self._primitives(built), types["primitives"].dtype)
        return data

    def _there(self, array: Any, dtype: Any) -> Any:
        return array if isinstance(array, wp.array) else upload(array, dtype, self.device)

    def _primitives(self, built: Built) -> Any:
        """What the struct's `primitives` holds: the triangle test's records, in the order of the leaves."""
        return self.geometry.primitives(self.structure.units, built.order, self.threads)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the structure to a file (.accel) that wrt.load_accel reads. Raises InputError where the system refuses."""
        save(self._snapshot, path)

    def __repr__(self) -> str:
        s = self.stats
        return (f"{type(self).__name__}({len(self.geometry)} primitives, {s.nodes} nodes, depth {s.depth}, "
                f"{s.bytes / 1e6:.1f} MB, SAH {s.sah_cost:.1f}, built in {s.build_seconds:.3f} s)")


def array_bytes(data: Any) -> int:
    """Bytes of all arrays of a Warp struct."""
    arrays = (getattr(data, name) for name in fields_of(data))
    return sum(array.capacity for array in arrays if isinstance(array, wp.array))
