"""The contract of an acceleration structure: what it is built from, what it answers, what it tells of itself."""

from __future__ import annotations

import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from dataclasses import asdict, dataclass, replace
from functools import partial
from hashlib import sha256
from inspect import signature
from typing import Any, ClassVar, NamedTuple

import numpy as np
import warp as wp

from wrt.accel.batches import launch_stream, stream_kernel
from wrt.accel.triangle_data import LAYOUTS
from wrt.core.arrays import check_no_gradients, real_numbers, taken, to_numpy, to_warp
from wrt.core.device import load_kernel, made_once, records, run_all, start, thread_count, upload
from wrt.core.errors import InputError
from wrt.core.html import html_facts, html_table
from wrt.core.memory import require
from wrt.core.seconds import seconds_without_loads
from wrt.kernels.query import HitArrays, RayArrays, make_any_hit_kernel, make_closest_hit_kernel
from wrt.kernels.structs import Surfaces
from wrt.kernels.traverse import instances as traverse_instances
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.counters import SIZE_RANGE, Counts
from wrt.kernels.units.box import PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST, RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.scene.mesh import Mesh

RAYS_PER_LAUNCH = 16384
RECORDS_PER_JOB = 32768
FARTHEST = 1e37  # of an origin's coordinates: differences of such are finite
# By the annotations of _build.
OPTION_TYPES: dict[str, Any] = {"int": int, "int | None": int | None, "float": int | float, "bool": bool, "str": str}


@dataclass(frozen=True, eq=False)
class Geometry:
    """What is hit, in world space: vertices (V, 3) float32, faces (F, 3) int32, spheres (S, 4) float32 (center, radius).

    prim_id counts the faces first, then the spheres.
    """

    vertices: np.ndarray
    faces: np.ndarray
    spheres: np.ndarray

    @staticmethod
    def of(mesh: Mesh) -> Geometry:
        """Of a mesh alone; prim_ids are indices into its faces."""
        return Geometry(mesh.vertices, mesh.faces, np.zeros((0, 4), np.float32))

    def __len__(self) -> int:
        return len(self.faces) + len(self.spheres)

    @property
    def n_triangles(self) -> int:
        """How many of the primitives are triangles: they come before the spheres."""
        return len(self.faces)

    def digest(self) -> str:
        """SHA-256 of the arrays: the same for the same geometry, whatever file it came from."""
        out = sha256()
        for array in (self.vertices, self.faces, self.spheres):
            out.update(f"{array.shape}{array.dtype.str}".encode() + np.ascontiguousarray(array).tobytes())
        return out.hexdigest()

    def bounds(self, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of every primitive's padded box, two (N, 3) float32."""
        lo, hi = (np.empty((len(self), 3), np.float32) for _ in range(2))
        self.write_bounds(lo, hi, threads)
        return lo, hi

    def write_bounds(self, lo: np.ndarray, hi: np.ndarray, threads: int = 1) -> None:
        """The same into arrays that there are, (N, 3) float32.

        To the last bit what the units take (kernels.ray_triangle.within_bounds): a hit is never outside its box.
        """
        def fill(first: int) -> None:
            some, n = slice(first, first + RECORDS_PER_JOB), len(self.faces)
            corners = [self.vertices.take(self.faces[some, i], axis=0) for i in range(3)]
            spheres = self.spheres[max(first - n, 0) : max(first + RECORDS_PER_JOB - n, 0)]
            low, high = (np.concatenate([end(end(corners[0], corners[1]), corners[2]), spheres[:, :3] + sign * spheres[:, 3:]])
                         for end, sign in ((np.minimum, np.float32(-1.0)), (np.maximum, np.float32(1.0))))
            with np.errstate(over="ignore"):  # near the end of float32 the padded box is all of space
                x, y, z = (high - low).T
                pad = np.float32(PAD_EXTENT) * np.maximum(np.maximum(x, y), z)[:, None] + np.float32(PAD_SMALLEST)
                lo[some] = low - (pad + np.float32(PAD_COORDINATE) * np.abs(low))
                hi[some] = high + (pad + np.float32(PAD_COORDINATE) * np.abs(high))

        run_all([partial(fill, first) for first in range(0, len(self), RECORDS_PER_JOB)], threads)

    def primitives(self, units: Units, order: np.ndarray | None = None, threads: int = 1) -> np.ndarray:
        """What the triangle test of `units` reads, in the given order of prim_id, or in their own."""
        if order is not None and len(order) > len(self):  # what stands more than once is made once
            return self.primitives(units, None, threads)[order]
        prim_id = np.arange(len(self), dtype=np.int32) if order is None else order
        out = records(units.triangle_test.record, len(prim_id))
        out["prim_id"] = prim_id

        def fill(first: int) -> None:
            some = slice(first, first + RECORDS_PER_JOB)
            triangle = prim_id[some] < len(self.faces) if units.spheres else slice(None)
            part = out[some][triangle]
            faces = self.faces.take(part["prim_id"], axis=0)
            LAYOUTS[units.triangle_test.layout](part, *(self.vertices.take(faces[:, i], axis=0) for i in range(3)))
            if units.spheres:
                out[some][triangle] = part

        run_all([partial(fill, first) for first in range(0, len(prim_id), RECORDS_PER_JOB)], threads)
        return out


@dataclass(frozen=True)
class AccelStats:
    """build_seconds: wall clock, without those in which the builder's kernels were compiled; nodes, leaves, depth: 0 where there is
    no tree; references: primitives in all leaves together, more than there are where a structure splits space; bytes: on the
    device, triangles included; sah_cost: expected cost of a random line through the root box, one node visited and one
    primitive tested costing 1 each (NaN where nobody knows)."""

    build_seconds: float
    nodes: int
    leaves: int
    depth: int
    references: int
    bytes: int
    sah_cost: float

    def _repr_html_(self) -> str:
        return html_facts("Structure", asdict(self))


@dataclass(frozen=True, eq=False)
class Built:
    """What a builder gives: arrays, one for each field of the structure's struct but `primitives` and `recorder`, records or
    rows of numbers (a field that is no array: a NumPy scalar or row); order: (R,) int32, the prim_id of each record of
    `primitives`, where one may stand more than once, unless cells share records: then there is an array `references` of their
    indices; and what AccelStats tells of a tree."""

    arrays: dict[str, np.ndarray]
    order: np.ndarray
    nodes: int = 0
    leaves: int = 0
    depth: int = 0
    sah_cost: float = float("nan")

    @property
    def references(self) -> int:
        return len(self.arrays.get("references", self.order))


@dataclass(frozen=True, eq=False)
class State:
    """All that a refit changes. It is replaced as a whole, and nothing in it is written to: whoever takes it once has parts that
    belong together, whatever other threads do. data: the Warp struct that kernels get; built_cost: the SAH cost that growth is
    measured against. Until the structure is built, there is a geometry and nothing else."""

    geometry: Geometry
    built: Any = None
    data: Any = None
    stats: Any = None
    built_cost: float = float("nan")


@dataclass(frozen=True)
class Refit:
    """What Accelerator.refit did: seconds; growth: SAH cost of the refitted tree over that of the tree when it was built; rebuilt:
    whether that was too much, and a new tree was built."""

    seconds: float
    growth: float
    rebuilt: bool

    def _repr_html_(self) -> str:
        return html_facts("Refit", asdict(self))


@dataclass(frozen=True, eq=False)
class Counters:
    """What each ray cost, (N,) each, as in kernels.counters.Counts; trace: the fetches of all rays one after another, those of
    ray i from first[i] to first[i + 1]: address (int64, bytes; primitives from PRIMITIVE_SPACE on) and size (int64, bytes)."""

    counts: np.ndarray
    first: np.ndarray
    address: np.ndarray
    size: np.ndarray

    def __getattr__(self, name: str) -> np.ndarray:
        if name.startswith("_") or name not in (self.counts.dtype.names or ()):
            raise AttributeError(name)
        return self.counts[name]

    def __repr__(self) -> str:
        means = ", ".join(f"{name} {self.counts[name].mean():.2f}" for name in self.counts.dtype.names or ())
        return f"Counters({len(self.counts)} rays; a ray: {means})" if len(self.counts) else "Counters(0 rays)"

    def _repr_html_(self) -> str:
        names = (self.counts.dtype.names or ()) if len(self.counts) else ()
        rows = [(name, float(self.counts[name].mean()), int(self.counts[name].max()), int(self.counts[name].sum(dtype=np.int64)))
                for name in names]
        return html_table(f"Counters of {len(self.counts)} rays", ("", "a ray", "largest", "sum"), rows)


@dataclass(frozen=True, eq=False)
class Hits:
    """t: (N,) float32, in units of |direction|, inf on a miss; prim_id: (N,) int32, -1 on a miss; u, v: (N,) float32:
    the point is (1 - u - v) v0 + u v1 + v v2 (0 on a miss and on spheres). NumPy arrays, or Warp's if the rays were.
    counters: what each ray cost, where that was asked for."""

    t: Any
    u: Any
    v: Any
    prim_id: Any
    counters: Counters | None = None

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Hits({len(self)} rays)"

    def _repr_html_(self) -> str:
        hits = self.numpy()
        t = hits.t[hits.prim_id >= 0]
        facts: dict[str, Any] = {"rays": len(self), "hits": len(t), "misses": len(self) - len(t)}
        if len(t):
            facts |= {"nearest t": float(t.min()), "farthest t": float(t.max())}
        return html_facts("Hits", facts) + (self.counters._repr_html_() if self.counters else "")

    def numpy(self) -> Hits:
        """The same with NumPy arrays; of hits on the CPU they share the memory."""
        return self._each(to_numpy)

    def warp(self) -> Hits:
        """The same with Warp arrays; of hits on the CPU they share the memory."""
        return self._each(to_warp)

    def _each(self, convert: Callable[[Any], Any]) -> Hits:
        return replace(self, **{name: convert(getattr(self, name)) for name in ("t", "u", "v", "prim_id")})


def check_units(triangle: str, box: str) -> None:
    """Raise InputError where there is no triangle test or box test of that name."""
    for choice, table, what in ((triangle, RAY_TRIANGLE, "triangle test"), (box, RAY_AABB, "box test")):
        if choice not in table:
            raise InputError(f"no {what} {choice!r}; there is {', '.join(table)}")


class Structure(NamedTuple):
    """A kind of structure together with the units that walk it: what a kernel is made from. Hashable. Where the units walk
    instances, it is a tree over structures of this kind (wrt.accel.instances)."""

    accel: type[Accelerator]
    units: Units = Units()

    @property
    def struct(self) -> Any:
        """The Warp struct of the structure's arrays."""
        return struct_of(self)

    @property
    def bottom(self) -> Any:
        """The struct of one structure, also where there are instances of several."""
        return struct_of(self._replace(units=self.units._replace(instances=False)))

    def traversal(self, *, any_hit: bool, accepts: Any = None) -> Any:
        """The traversal unit as a Warp function (accel, surfaces, ray) -> Hit."""
        traverse = self.accel.kernels.make_traversal(self.units, any_hit, accepts)
        if self.units.instances:
            return traverse_instances.make_traversal(self.units, any_hit, traverse, self.bottom)
        return traverse


@made_once
def struct_of(structure: Structure) -> Any:
    if structure.units.instances:
        return traverse_instances.make_struct(structure.bottom)
    return structure.accel.kernels.make_struct(structure.units.triangle_test.record)


class Accelerator(ABC):
    """A structure over a geometry, on a device. Subclasses set `name` and `kernels`, and implement `_build`.

    Several threads may ask one structure at a time, and one of them may refit it: docs/acceleration.md, "Several threads".

    kernels: the traversal's module, with make_struct(record) and make_traversal(units, any_hit, accepts); for the CPU it may have
    make_stream(units, any_hit), a kernel for many rays at a time, or None (wrt.accel.batches), with stream_block and stream_sizes.
    """

    name: ClassVar[str]
    kernels: ClassVar[Any]
    bytes_to_build: ClassVar[float] = 200.0  # of memory for each primitive, at the peak; measured, rounded up

    def __init__(self, geometry: Geometry, device: str = "cpu", threads: int | None = None, *, triangle: str = "watertight",
                 box: str = "conservative", **options: Any) -> None:
        self._begin(geometry, device, threads, triangle, box)
        known = {name: p.annotation for name, p in signature(self._build).parameters.items() if name != "options"}
        for option, value in options.items():
            if option not in known:
                raise InputError(f"{self.name} has no option {option!r}; there is {', '.join([*known, 'triangle', 'box'])}")
            kind = OPTION_TYPES.get(known[option], object)
            if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
                raise InputError(f"{option} must be {known[option]}, got {value!r}")
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
        moved = _vectors(vertices, "vertices").copy()
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
        """A hierarchy of boxes as kernels.end_point_overlap.Children."""
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
        from wrt.accel.store import save

        save(self, path)

    def __repr__(self) -> str:
        s = self.stats
        return (f"{type(self).__name__}({len(self.geometry)} primitives, {s.nodes} nodes, depth {s.depth}, "
                f"{s.bytes / 1e6:.1f} MB, SAH {s.sah_cost:.1f}, built in {s.build_seconds:.3f} s)")

    def _repr_html_(self) -> str:
        units = self.structure.units
        return html_facts(type(self).__name__, {"primitives": len(self.geometry), "triangle test": units.triangle,
                                                "box test": units.box, "device": str(self.device), **asdict(self.stats)})

    def closest_hit(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
                    threads: int | None = None, *, counters: bool = False, trace: bool = False) -> Hits:
        """The closest hit of each ray in the closed segment [t_min, t_max]; at equal t the lowest prim_id.

        Closed means that a surface through the origin is hit at t_min = 0; a t_min above 0 leaves it out. origins,
        directions: (N, 3) real numbers, taken as float32; origins up to 1e37, so that differences are finite; directions finite,
        not zero and of any length (where t would be beyond float32, there is no hit); t_min (>= 0), t_max: scalars or (N,).
        Warp arrays are (N,) vec3, and of their values only t_min and t_max are looked at, on the CPU. threads: 1 or more, or one
        a core. counters: count what each ray costs (hits.counters); trace: also record what it fetches, which takes a second run.

        Several threads may ask at a time, with or without counters, while another refits. There are no gradients: Warp arrays
        that require them are refused while a wp.Tape records. Raises InputError that names the argument and what was expected.
        """
        data, threads = self.data, thread_count(threads)  # data once: a refit may replace it meanwhile
        rays, as_warp = self._rays(origins, directions, t_min, t_max)
        n = len(rays.t_min)
        hits = HitArrays()
        for field, dtype in (("t", wp.float32), ("u", wp.float32), ("v", wp.float32), ("prim_id", wp.int32)):
            setattr(hits, field, wp.empty(n, dtype=dtype, device=self.device))
        counted = self._counted(closest_hit_kernel, data, rays, hits, trace, threads) if counters or trace else None
        if counted is None:
            self._trace(closest_hit_kernel, data, rays, hits, threads)
        t, u, v, prim_id = (array if as_warp else array.numpy() for array in (hits.t, hits.u, hits.v, hits.prim_id))
        return Hits(t, u, v, prim_id, counted)

    def any_hit(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
                threads: int | None = None) -> Any:
        """Whether each ray hits anything in its segment: (N,) bool, True where closest_hit finds a hit and nowhere else. Arguments
        as in closest_hit."""
        data, threads = self.data, thread_count(threads)
        rays, as_warp = self._rays(origins, directions, t_min, t_max)
        dark = wp.empty(len(rays.t_min), dtype=wp.bool, device=self.device)
        self._trace(any_hit_kernel, data, rays, dark, threads)
        return dark if as_warp else dark.numpy()

    def _counted(self, make_kernel: Any, data: Any, rays: RayArrays, out: Any, trace: bool, threads: int) -> Counters:
        """Launch with counters; with a trace once more, when it is known how long the trace of each ray is."""
        n = len(rays.t_min)
        kernel = make_kernel(self.structure._replace(units=self.structure.units._replace(counters=True)))

        def run(first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # The struct of the counting kernel is the same, but what it records is this call's alone.
            own = copied(data)
            own.recorder.counts = wp.zeros(n, dtype=Counts, device=self.device)
            own.recorder.first = upload(first, wp.int64, self.device)
            own.recorder.fetches = wp.zeros(int(first[-1]) if len(first) else 0, dtype=wp.int64, device=self.device)
            self._launch(kernel, [own, self._surfaces, rays, out], n, threads)
            return own.recorder.counts.numpy(), own.recorder.fetches.numpy()

        counts, fetches = run(np.zeros(0, np.int64))
        first = np.zeros(n + 1, np.int64)
        if trace:
            np.cumsum(counts["nodes"].astype(np.int64) + counts["primitives"], out=first[1:])
            counts, fetches = run(first)
        return Counters(counts, first, fetches // int(SIZE_RANGE), fetches % int(SIZE_RANGE))

    def _trace(self, make_kernel: Any, data: Any, rays: RayArrays, out: Any, threads: int) -> None:
        """By the kernel for many rays at a time where there is one."""
        n, inputs = len(rays.t_min), [data, self._surfaces, rays, out]
        stream = None if self.device.is_cuda else stream_kernel(self.structure, make_kernel is any_hit_kernel)
        if stream is None:
            self._launch(make_kernel(self.structure), inputs, n, threads)
        else:
            launch_stream(self.structure, stream, inputs, n, threads)

    def _launch(self, kernel: Any, inputs: list[Any], n: int, threads: int) -> None:
        """inputs: the kernel's first ones, up to where the hits go."""
        if self.device.is_cuda:
            wp.launch(kernel, dim=n, inputs=[*inputs, 0], device=self.device, record_tape=False)
            return
        load_kernel(kernel, self.device)

        def job(first: int) -> Any:
            count = min(RAYS_PER_LAUNCH, n - first)
            return lambda: wp.launch(kernel, dim=count, inputs=[*inputs, first], device=self.device, record_tape=False)

        run_all([job(first) for first in range(0, n, RAYS_PER_LAUNCH)], threads)

    def _rays(self, origins: Any, directions: Any, t_min: Any, t_max: Any) -> tuple[RayArrays, bool]:
        check_no_gradients(origins=origins, directions=directions, t_min=t_min, t_max=t_max)
        origins, directions = taken(origins, "origins"), taken(directions, "directions")
        as_warp = isinstance(origins, wp.array) or isinstance(directions, wp.array)
        rays = RayArrays()
        if as_warp:
            if any(not isinstance(array, wp.array) or array.dtype != wp.vec3 for array in (origins, directions)):
                raise InputError("origins and directions must both be Warp arrays of vec3, or both NumPy arrays")
            n = len(origins)
            rays.origin, rays.direction = (a if a.is_contiguous else a.contiguous() for a in (origins, directions))
        else:
            origins, directions = _vectors(origins, "origins", FARTHEST), _vectors(directions, "directions")
            n = len(origins)
            _check_not_zero(directions)
            rays.origin = upload(origins, wp.vec3, self.device)
            rays.direction = upload(directions, wp.vec3, self.device)
        if len(directions) != n:
            raise InputError(f"directions must have as many rows as origins ({n}), got {len(directions)}")
        rays.t_min = self._segment_end(t_min, n, "t_min", low=0.0)
        rays.t_max = self._segment_end(t_max, n, "t_max", low=-np.inf)
        return rays, as_warp

    def _segment_end(self, value: Any, n: int, name: str, low: float) -> Any:
        if isinstance(value, wp.array):
            if value.dtype != wp.float32 or value.shape != (n,):
                raise InputError(f"{name} must be ({n},) float32, got {value.shape} {value.dtype.__name__}")
            if value.device.is_cpu:
                _check_ends(value.numpy(), name, low)
            return value if value.is_contiguous else value.contiguous()
        array = real_numbers(value, name, f"a number or ({n},)")
        if array.ndim > 1 or (array.ndim == 1 and len(array) != n):
            raise InputError(f"{name} must be a number or ({n},), got {array.shape}")
        _check_ends(array, name, low)
        return upload(np.broadcast_to(array, (n,)).copy(), wp.float32, self.device)


def _check_ends(array: np.ndarray, name: str, low: float) -> None:
    if not array.min(initial=np.inf) >= low:  # the least of what has a NaN is NaN
        raise InputError(f"{name} must not be NaN" + (f" or below {low:g}" if low > -np.inf else ""))


def copied(data: Any) -> Any:
    """A Warp struct with the same arrays and numbers, of which fields may be set."""
    out = data._cls()
    out.assign(data)
    return out


def array_bytes(data: Any) -> int:
    """Bytes of all arrays of a Warp struct."""
    arrays = (getattr(data, name) for name in data._cls.vars)
    return sum(array.capacity for array in arrays if isinstance(array, wp.array))


def _vectors(value: Any, name: str, most: float = float(np.finfo(np.float32).max)) -> np.ndarray:
    """(N, 3) float32, no component beyond `most`."""
    array = real_numbers(value, name, "(N, 3)")
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} must be (N, 3), got {array.shape}")
    numbers = array.reshape(-1)
    if not (numbers.min(initial=0.0) >= -most and numbers.max(initial=0.0) <= most):  # False for NaN
        for good, what in ((np.isfinite(array), "finite"), (np.abs(array) <= most, f"within {most:g}")):
            if not good.all():
                row = int(np.argmin(good.all(axis=1)))
                raise InputError(f"{name} must be {what}; row {row} is [{', '.join(map(str, array[row]))}]")
    return array


def _check_not_zero(directions: np.ndarray) -> None:
    zero = directions[:, 0] == 0.0
    if zero.any():
        zero &= directions[:, 1] == 0.0
        zero &= directions[:, 2] == 0.0
        if zero.any():
            raise InputError(f"directions must not be zero; row {int(np.argmax(zero))} is")


@made_once
def closest_hit_kernel(structure: Structure) -> Any:
    return make_closest_hit_kernel(structure.struct, structure.traversal(any_hit=False))


@made_once
def any_hit_kernel(structure: Structure) -> Any:
    return make_any_hit_kernel(structure.struct, structure.traversal(any_hit=True))
