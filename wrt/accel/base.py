"""The contract of an acceleration structure: what it is built from, what it answers, what it tells of itself."""

from __future__ import annotations

import os
import threading
import time
from abc import ABC, abstractmethod
from copy import copy
from dataclasses import asdict, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp

from wrt.accel.answers import ANY_HIT_TYPES, HIT_TYPES, AccelStats, Counters, Hits, Refit, room_for
from wrt.accel.batches import trace_on_gpu, tracer
from wrt.accel.built import Built, State
from wrt.accel.counting import counted
from wrt.accel.flatten import World
from wrt.accel.geometry import Geometry
from wrt.accel.ray_query import world_of
from wrt.accel.rays import Rays, rays_of, vectors
from wrt.accel.store import save
from wrt.accel.structure import Structure, check_options, check_units
from wrt.core.checks import shown
from wrt.core.device import start, thread_count, upload
from wrt.core.errors import InputError
from wrt.core.html import html_facts
from wrt.core.memory import require
from wrt.core.seconds import seconds_without_loads
from wrt.kernels.structs import Surfaces
from wrt.kernels.traverse.common import Units


class Accelerator(ABC):
    """A structure over a geometry, on a device. Subclasses set `name` and `kernels`, and implement `_build`.

    Several threads may ask one structure at a time, and one of them may refit it: docs/acceleration.md, "Several threads".

    kernels: the traversal's module, with make_struct(record) and make_traversal(units, any_hit, accepts); for the CPU it may have
    make_stream(units, any_hit), a kernel for many rays at a time, or None (wrt.accel.batches), with stream_block and stream_sizes;
    the last of its slots tells whether it met a ray that a query refuses.
    """

    name: ClassVar[str]
    kernels: Any
    attributes: World | None = None  # what wrt.build knows of the primitives beyond the geometry: normals, uvs, materials, objects
    bytes_to_build: ClassVar[float] = 200.0  # of memory for each primitive, at the peak; measured, rounded up

    def __init__(self, geometry: Geometry, device: str = "cpu", threads: int | None = None, *, triangle: str = "watertight",
                 box: str = "conservative", **options: Any) -> None:
        self._begin(geometry, device, threads, triangle, box)
        check_options(self.name, self._build, options)
        require(len(geometry) * self.bytes_to_build, f"a {self.name} over {len(geometry)} primitives")
        begin = time.perf_counter()
        built = self._build(**options)
        self._take(built, begin, built.sah_cost)

    @classmethod
    def restore(cls, built: Built, geometry: Geometry, device: str = "cpu", threads: int | None = None, *,
                triangle: str = "watertight", box: str = "conservative") -> Accelerator:
        """What was built before over the same geometry. Raises InputError where `built` is no such structure."""
        self = cls.__new__(cls)
        self._begin(geometry, device, threads, triangle, box)
        begin = time.perf_counter()
        if not np.array_equal(np.unique(built.order), np.arange(len(geometry))):
            raise InputError(f"is no {cls.name} over this geometry: its primitives are not in it, or not all of them")
        self._check(built)
        self._take(built, begin, built.sah_cost)
        return self

    def _begin(self, geometry: Geometry, device: str, threads: int | None, triangle: str, box: str) -> None:
        check_units(triangle, box)
        self.device = start(device)
        self._state = State(geometry)
        self._refitting = threading.Lock()
        self.threads = thread_count(threads)
        self.structure = Structure(type(self), Units(triangle, box, len(geometry.spheres) > 0))
        self._surfaces = Surfaces()
        self._surfaces.n_triangles = len(geometry.faces)
        self._surfaces.spheres = upload(geometry.spheres.copy(), wp.vec4, self.device)  # the caller may change his

    @property
    def geometry(self) -> Geometry:
        """What the structure is over, as it is now."""
        return self._state.geometry

    @property
    def built(self) -> Built:
        """What the builder gave, or the last refit."""
        return self._state.built

    @property
    def data(self) -> Any:
        """The Warp struct that kernels get. It is never written to: a refit makes another."""
        return self._state.data

    @property
    def world(self) -> Any:
        """The structure, as it is now, as an argument of a kernel of one's own (wrt.ray_query)."""
        return world_of(self.structure, self.data, self._surfaces)

    @property
    def stats(self) -> AccelStats:
        """What was built, how large it is, and what it costs."""
        return self._state.stats

    def _take(self, built: Built, begin: float, built_cost: float) -> None:
        """built_cost: as in State."""
        data = self._upload(built)
        stats = AccelStats(seconds_without_loads(begin), built.nodes, built.leaves, built.depth, built.references,
                           array_bytes(data), built.sah_cost)
        self._state = State(self.geometry, built, data, stats, built_cost)

    @abstractmethod
    def _build(self, *args: Any, **options: Any) -> Built:
        """The structure over self.geometry, on the host. Raises InputError for options out of range."""

    def _check(self, built: Built) -> None:
        """Raise InputError where arrays that come from a file would lead a ray out of them or round in circles."""
        raise InputError(f"a {self.name} cannot be read from a file")

    def _refit(self, built: Built) -> Built:
        """The same tree around self.geometry, whose vertices have moved."""
        raise InputError(f"a {self.name} cannot follow vertices that move; build it again, or take bvh2")

    def refit(self, vertices: np.ndarray, rebuild_at: float = np.inf) -> Refit:
        """Follow vertices that have moved, (V, 3) float32, as many as before: boxes are fitted anew, the tree stays as it is.

        It answers as exactly as a new one, but slower and slower as the motion mixes what was near. rebuild_at: build it anew
        (with default options) where the SAH cost passes this multiple of what it was when built. Other threads may go on asking:
        every query that begins before the refit ends answers of the old shape, all others of the new one. Raises InputError for
        another shape or values that are not finite, and from structures that cannot be refitted.
        """
        moved = vectors(vertices, "vertices").copy()
        if moved.shape != self.geometry.vertices.shape:
            raise InputError(f"vertices must be {self.geometry.vertices.shape}, got {moved.shape}")
        with self._refitting:
            begin, before = time.perf_counter(), self._state
            beside = copy(self)  # has the new shape while others still ask for the old one
            beside._state = State(replace(before.geometry, vertices=moved))
            built, built_cost = beside._refit(before.built), before.built_cost
            growth = float(built.sah_cost) / float(built_cost) if built_cost > 0.0 else 1.0
            if rebuilt := growth > rebuild_at:
                built = beside._build()
                built_cost = built.sah_cost
            beside._take(built, begin, built_cost)
            self._state = beside._state
            return Refit(beside.stats.build_seconds, growth, rebuilt)

    def _children(self, built: Built) -> Any:
        """A hierarchy of boxes as kernels.build.end_point_overlap.Children."""
        raise InputError(f"a {self.name} has no end-point overlap: it is no hierarchy of boxes")

    def epo(self) -> float:
        """End-point overlap of a BVH: nodes and primitives visited for nothing at a random point of the surface
        (wrt.accel.bvh.epo).

        It tells of rays that end, as stats.sah_cost does of lines that nothing stops; it takes about as long as a build. Raises
        InputError for structures that are no BVH.
        """
        from wrt.accel.bvh.epo import end_point_overlap

        state = self._state
        return end_point_overlap(self._children(state.built), state.geometry, self.threads)

    def _upload(self, built: Built) -> Any:
        data = self.structure.struct()
        types = {name: field.type for name, field in data._cls.vars.items()}
        for name, array in built.arrays.items():
            kind = types[name]
            is_array = isinstance(kind, wp.array)
            setattr(data, name, upload(array, kind.dtype, self.device) if is_array else kind(*np.ravel(array)))
        data.primitives = upload(self._primitives(built), types["primitives"].dtype, self.device)
        return data

    def _primitives(self, built: Built) -> np.ndarray:
        """What the struct's `primitives` holds: the triangle test's records, in the order of the leaves."""
        return self.geometry.primitives(self.structure.units, built.order, self.threads)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the structure to a file (.accel) that wrt.load_accel reads. Raises InputError where the system refuses."""
        save(self.structure, self._state, path)

    def __repr__(self) -> str:
        s = self.stats
        return (f"{type(self).__name__}({len(self.geometry)} primitives, {s.nodes} nodes, depth {s.depth}, "
                f"{s.bytes / 1e6:.1f} MB, SAH {s.sah_cost:.1f}, built in {s.build_seconds:.3f} s)")

    def _repr_html_(self) -> str:
        units = self.structure.units
        return html_facts(type(self).__name__, {"primitives": len(self.geometry), "triangle test": units.triangle,
                                                "box test": units.box, "device": str(self.device), **asdict(self.stats)})

    def closest_hit(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
                    threads: int | None = None, *, counters: bool = False, trace: bool = False, out: Hits | None = None) -> Hits:
        """The closest hit of each ray in the closed segment [t_min, t_max]; at equal t the lowest prim_id.

        Closed means that a surface through the origin is hit at t_min = 0; a t_min above 0 leaves it out. origins,
        directions: (N, 3) real numbers, taken as float32; origins up to 1e37, so that differences are finite; directions finite,
        not zero and of any length (where t would be beyond float32, there is no hit); t_min (>= 0), t_max: scalars or (N,).
        float32 without gaps is read where it is, all else is copied part by part. Warp arrays are (N,) vec3, and of their values
        only t_min and t_max are looked at, on the CPU. threads: 1 or more, or one a core. counters: count what each ray costs
        (hits.counters); trace: also record what it fetches, which takes a second run. out: hits of as many rays, whose arrays take
        the new ones (NumPy's, or Warp's if the rays are; they must not overlap with the rays' own).

        Several threads may ask at a time, with or without counters, while another refits. There are no gradients: Warp arrays
        that require them are refused while a wp.Tape records. Raises InputError that names the argument and what was expected;
        what `out` holds is lost then.
        """
        threads, rays = thread_count(threads), rays_of(origins, directions, t_min, t_max)
        if not (out is None or isinstance(out, Hits)):
            raise InputError(f"out must be Hits, got {shown(out)}")
        given = None if out is None else [out.t, out.u, out.v, out.prim_id]
        t, u, v, prim_id = arrays = room_for(HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None)
        state = self._state  # once: a refit may replace it meanwhile
        costs = _answer(self, state.data, rays, arrays, threads, trace if counters or trace else None)
        return Hits(t, u, v, prim_id, costs, (self, state, rays))

    def any_hit(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
                threads: int | None = None, *, out: Any = None) -> Any:
        """Whether each ray hits anything in its segment: (N,) bool, True where closest_hit finds a hit and nowhere else. Arguments
        as in closest_hit; out: an array that takes the answer."""
        threads, rays = thread_count(threads), rays_of(origins, directions, t_min, t_max)
        given = None if out is None else [out]
        arrays = room_for(ANY_HIT_TYPES, given, len(rays.origins), self.device if rays.as_warp else None)
        _answer(self, self.data, rays, arrays, threads)
        return arrays[0]


def _answer(accel: Accelerator, data: Any, rays: Rays, out: list[Any], threads: int,
            counting: bool | None = None) -> Counters | None:
    """Write the answers of `data`, the structure as it was once, to arrays: of HIT_TYPES or ANY_HIT_TYPES. counting: with a
    trace or without; None: not at all."""

    def trace(structure: Structure, data: Any) -> None:
        if accel.device.is_cuda:
            trace_on_gpu(structure, data, accel._surfaces, rays, out, accel.device)
        else:
            tracer(structure, len(out) == 1).trace(data, accel._surfaces, rays, out, threads)

    if counting is None:
        trace(accel.structure, data)
        return None
    return counted(trace, accel.structure, data, len(out[0]), accel.device, counting)


def array_bytes(data: Any) -> int:
    """Bytes of all arrays of a Warp struct."""
    arrays = (getattr(data, name) for name in data._cls.vars)
    return sum(array.capacity for array in arrays if isinstance(array, wp.array))
