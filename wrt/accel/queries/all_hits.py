"""All hits of a ray in order of distance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar, Unpack, overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.geometry import InstancedGeometry
from wrt.accel.queries.accelerator import Accelerator, Seen, snapshot_of
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.arguments import Shape, WorldIds, check_world, rays_of, roots_at
from wrt.accel.queries.hit_points import HitIds, Source, device_scene, part_faces
from wrt.accel.queries.lists import ALL, BATCH, BATCH_ON_GPU, HIT_KINDS, GpuLists, Mesh, begins, host_lists, rows_of
from wrt.accel.queries.rays import Rays, arrays_on, filled, host_arrays
from wrt.core.arrays import given_like, to_numpy, to_tensor_like
from wrt.core.checks import as_integer, as_one
from wrt.core.device import upload
from wrt.core.threads import run_all, thread_count
from wrt.core.types import Array, ArrayLike, ArrayT, NumpyLike, TensorT, WarpArray, WarpType
from wrt.core.warp_private import struct_record
from wrt.kernels.query import HitArrays

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class AllHits(HitIds[ArrayT]):
    """M hits of N rays, ray by ray (in C order), in order of t and, at equal t, of prim_id. Arrays of NumPy, PyTorch or JAX.

    Attributes
    ----------
    first : (N + 1,) int64
        Rows first[i] .. first[i + 1] - 1 of the other arrays are the hits of ray i.
    t, u, v : (M,) float32
        As in `Hits`.
    prim_id : (M,) int32
        Index of the face. `face`, `object`, `instance` and `material` are ids as those of `Hits`.
    source : tuple or None
        Snapshot from which ids are computed. Pickled hits have none.
    """

    first: ArrayT
    t: ArrayT
    u: ArrayT
    v: ArrayT
    prim_id: ArrayT
    source: Source | None = None

    def __len__(self) -> int:
        return len(self.first) - 1

    @property
    def counts(self) -> ArrayT:
        """Number of hits of each ray, (N,) int64."""
        counts: ArrayT = self.first[1:] - self.first[:-1]
        return counts

    @property
    def ray_id(self) -> ArrayT:
        """Index of the ray of each hit, (M,) int64."""
        ray: ArrayT = given_like(self.first, np.repeat(np.arange(len(self)), to_numpy(self.counts)))
        return ray

    def __repr__(self) -> str:
        return f"AllHits({len(self)} rays, {int(self.first[-1])} hits)"


class ListQuery:
    """A query for all hits of rays, on a snapshot of a structure. `of` sets the rays; `all`, `first` and `counts` return results."""

    n = 0
    shape: Shape | None = None  # Of the rays; None: (n,).
    rays: Rays
    worlds: WorldIds | None = None
    roots: np.ndarray | None = None  # (1 or 3, N) int32: root node of each ray's world, or -1; exclude, mask. None without instances.
    touches: np.ndarray  # (N,) bool, if crossings are found: the ray hits triangles, but crosses none.
    give: Any = staticmethod(to_numpy)  # Converts arrays to those of the caller's library.

    def __init__(self, accel: Accelerator, threads: int | None, crossings: bool = False) -> None:
        self.snapshot = snapshot_of(accel, instances=True)
        self.threads, self.device = thread_count(threads), self.snapshot.device
        self.structure = self.snapshot.structure
        self.crossings = as_one(crossings, bool, "crossings")
        self.mesh: Mesh = None, None, None
        if self.snapshot.roots is not None:
            self.mesh = (*(part_faces(self.snapshot)[:2] if crossings else (None, None)), part_faces(self.snapshot).first_face)
        elif crossings:
            surfaces = device_scene(self.snapshot).surfaces
            self.mesh = surfaces.vertices, surfaces.faces, None

    def of_valid(self, rays: Rays, worlds: WorldIds | None) -> ListQuery:
        """Set rays that are valid: contiguous NumPy arrays of float32."""
        self.n, self.rays, self.worlds = len(rays.origins), rays if self.device.is_cpu else arrays_on(self.device, rays), worlds
        roots = roots_at(self.snapshot, worlds, self.n)
        if worlds is not None and worlds.filtered and roots is not None:
            self.roots = np.stack([roots, worlds.arrays.exclude.numpy(), worlds.arrays.mask.numpy()])
            self.structure = self.snapshot.structure.filtered
        else:
            self.roots = None if roots is None else roots[None]
        return self

    def of(self, origins: ArrayLike, directions: ArrayLike | None, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
           **seen: Unpack[Seen]) -> ListQuery:
        """Set the rays. Raises InputError that names the argument."""
        rays, self.shape = rays_of(origins, directions, t_min, t_max, origin=self.snapshot.geometry.origin)
        if self.shape is not None:
            self.give = to_tensor_like(origins, directions) or to_numpy
        worlds = check_world(self.snapshot, (len(rays.origins),) if self.shape is None else self.shape, **seen)
        return self.of_valid(host_arrays(rays) if self.device.is_cpu else rays, worlds)

    def all(self, limit: int = ALL) -> AllHits[Any]:
        """Find the first `limit` hits of each ray."""
        found = self._each(limit, lambda lists, begin, counts: (counts, lists.hits(counts)))
        if len(found) == 1:
            (counts, hits), = found
        else:
            counts = np.concatenate([np.zeros(0, np.int64), *(counts for counts, _ in found)])
            rows_of(int(counts.sum()))
            hits = [self._joined([hits[i] for _, hits in found], kind) for i, kind in enumerate(HIT_KINDS)]
        t, u, v, prim_id = map(self.give, hits)
        return AllHits(self.converted(begins(counts)), t, u, v, prim_id, self._source(counts))

    def _joined(self, parts: list[Any], kind: WarpType) -> Array:
        if self.device.is_cpu:
            return np.concatenate([np.zeros(0, wp.dtype_to_numpy(kind)), *parts])
        out, first = wp.empty(sum(map(len, parts)), dtype=kind, device=self.device), 0
        for part in parts:
            wp.copy(out, part, dest_offset=first, count=len(part))
            first += len(part)
        return out

    def _source(self, counts: int | np.ndarray) -> Source:
        return self.snapshot, None, self.worlds and self.worlds.of(np.repeat(np.arange(self.n), counts))

    def first(self, k: int) -> Hits[Any]:
        """Find the first k hits of each ray, in arrays (N, k)."""
        rows_of(self.n * k)
        hits: list[Any] = [np.full(self.n * k, missing, wp.dtype_to_numpy(kind))
                           for missing, kind in zip((np.inf, 0.0, 0.0, -1), HIT_KINDS, strict=True)]
        if self.device.is_cpu:
            target = struct_record(HitArrays, hits)
        else:
            hits = [upload(array, kind, self.device) for array, kind in zip(hits, HIT_KINDS, strict=True)]
            target = filled(HitArrays, hits)
        self._each(k, lambda lists, begin, counts: lists.copy(np.arange(begin, begin + len(counts)) * k, target))
        shape = (self.n,) if self.shape is None else self.shape
        return Hits(*[*(self.give(array.reshape((*shape, k))) for array in hits), None, self._source(k)])

    def counts(self) -> np.ndarray:
        """Count the hits of each ray, (N,) int64. If no triangle is in several leaves, one traversal without lists is enough."""
        geometry = self.snapshot.geometry
        triangles = sum(map(len, geometry.parts if isinstance(geometry, InstancedGeometry) else [geometry]))
        found = self._each(ALL, lambda lists, begin, counts: counts, self.snapshot.stats.references == triangles)
        return found[0] if len(found) == 1 else np.concatenate([np.zeros(0, np.int64), *found])

    def converted(self, values: np.ndarray) -> Array:
        """Convert int64 values to an array of the caller's library."""
        return values if self.give is to_numpy else self.give(upload(values, wp.int64, self.device))

    def _each(self, limit: int, take: Callable[[Any, int, np.ndarray], T], counting: bool = False) -> list[T]:
        """Return take(lists, begin, counts) of each batch of rays: its lists, its first ray, and its rays' numbers of hits, int64.

        counting: see HostLists.find.
        """
        step = BATCH if self.device.is_cpu else BATCH_ON_GPU
        firsts = range(0, self.n, step)
        out: list[Any] = [None] * len(firsts)
        if self.crossings:
            self.touches = np.zeros(self.n, bool)

        def find(lists: Any, i: int) -> None:  # HostLists or GpuLists
            some = slice(firsts[i], min(firsts[i] + step, self.n))  # Warp arrays refuse a larger end
            counts = lists.find(self.snapshot, [array[some] for array in self.rays], None if self.roots is None else self.roots[:, some],
                                min(limit, ALL), self.mesh, counting)
            if self.crossings:
                self.touches[some] = counts < 0
                counts = np.maximum(counts, 0)
            out[i] = take(lists, firsts[i], counts.astype(np.int64))
            if self.device.is_cpu:
                lists.release()

        if self.device.is_cpu:
            free = host_lists(self.structure)
            run_all([partial(free.run, partial(find, i=i)) for i in range(len(firsts))], self.threads)
        else:
            for i in range(len(firsts)):
                find(GpuLists(self.device, self.structure), i)
        return out


@overload
def all_hits(accel: Accelerator, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray | None = ..., t_min: ArrayLike = ...,
             t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ..., **seen: Unpack[Seen]) -> AllHits: ...
@overload
def all_hits(accel: Accelerator, origins: TensorT, directions: TensorT | None = ..., t_min: ArrayLike = ...,
             t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ..., **seen: Unpack[Seen]) -> AllHits[TensorT]: ...
def all_hits(accel: Accelerator, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
             threads: int | None = None, crossings: bool = False, **seen: Unpack[Seen]) -> AllHits[Any]:
    """Find every hit of each ray in its segment, in order of distance. A ray hits each triangle at most once.

    No ray passes between two adjacent triangles: through their common edge it hits one or both, depending on rounding. The time
    for n hits of a ray grows as n log n, even if many hits have the same t.

    Parameters
    ----------
    accel : Accelerator
        Structure without spheres.
    origins, directions, t_min, t_max, threads, world, exclude, mask
        See `Accelerator.closest_hit`.
    crossings : bool
        Find crossings of the surface instead. At a shared edge or corner, the ray counts as shifted by an infinitesimal distance:
        it hits one triangle, but at a silhouette none or two. A ray that begins and ends outside of a closed mesh crosses it an even
        number of times. With the watertight test this holds without exception.

    Returns
    -------
    AllHits
        Arrays of NumPy, or of the library of `origins`: PyTorch, JAX.
    """
    return ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max, **seen).all()


@overload
def count_hits(accel: Accelerator, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray | None = ..., t_min: ArrayLike = ...,
               t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ...,
               **seen: Unpack[Seen]) -> npt.NDArray[np.int64]: ...
@overload
def count_hits(accel: Accelerator, origins: TensorT, directions: TensorT | None = ..., t_min: ArrayLike = ...,
               t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ..., **seen: Unpack[Seen]) -> TensorT: ...
def count_hits(accel: Accelerator, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0,
               t_max: ArrayLike = np.inf, threads: int | None = None, crossings: bool = False, **seen: Unpack[Seen]) -> object:
    """Count the hits of each ray in its segment. The hits take no memory unless the structure has triangles in several leaves.

    Parameters
    ----------
    accel, origins, directions, t_min, t_max, threads, crossings, world, exclude, mask
        See `all_hits`.

    Returns
    -------
    (...) int64
        Array of the rays' shape, of NumPy or of the library of `origins`: PyTorch, JAX.
    """
    query = ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max, **seen)
    counts = query.counts()
    return query.converted(counts if query.shape is None else counts.reshape(query.shape))


@overload
def first_hits(accel: Accelerator, k: int, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray | None = ...,
               t_min: ArrayLike = ..., t_max: ArrayLike = ..., threads: int | None = ..., *, crossings: bool = ...,
               **seen: Unpack[Seen]) -> Hits: ...
@overload
def first_hits(accel: Accelerator, k: int, origins: TensorT, directions: TensorT | None = ...,
               t_min: ArrayLike = ..., t_max: ArrayLike = ..., threads: int | None = ..., *, crossings: bool = ...,
               **seen: Unpack[Seen]) -> Hits[TensorT]: ...
def first_hits(accel: Accelerator, k: int, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0,
               t_max: ArrayLike = np.inf, threads: int | None = None, *, crossings: bool = False,
               **seen: Unpack[Seen]) -> Hits[Any]:
    """Find the first k hits of each ray in order of distance. The traversal ends at the k-th hit.

    Parameters
    ----------
    accel, origins, directions, t_min, t_max, threads, crossings, world, exclude, mask
        See `all_hits`.
    k : int
        Number of hits, at least 1.

    Returns
    -------
    Hits
        Arrays (..., k); a ray with fewer hits has misses at the end. These Hits have ids, but no points and normals.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    k = as_integer(k, "k", 1, (1 << 31) - 1)
    return ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max, **seen).first(k)
