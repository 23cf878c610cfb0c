"""All hits of a ray in order of distance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.queries.accelerator import Accelerator, snapshot_of
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.batches import RAYS_PER_LAUNCH
from wrt.accel.queries.hit_points import device_scene
from wrt.accel.queries.rays import rays_of, rays_on
from wrt.accel.structure import Structure
from wrt.core.arrays import to_numpy, to_tensor_like, to_warp
from wrt.core.checks import as_integer, as_one
from wrt.core.device import MOST_ROWS, launch_on, made_once, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import Array, ArrayLike, ArrayT, Kernel, NumpyLike, TensorT, WarpArray, WarpStruct
from wrt.kernels.hit_lists import FEW, HitLists, copy_hits, list_hit, make_list_hits_kernel
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import Hit
from wrt.kernels.warp_private import fields_of

ALL = (1 << 30) - 1
RAYS_AT_ONCE = 1 << 18  # rays per batch; their hit lists take 32 MiB in the first traversal


@dataclass(frozen=True, eq=False)
class AllHits(Generic[ArrayT]):
    """M hits of N rays, ray by ray, in order of t and, at equal t, of prim_id. Arrays of NumPy, PyTorch or JAX.

    Attributes
    ----------
    first : (N + 1,) int64
        Rows first[i] .. first[i + 1] - 1 of the other arrays are the hits of ray i.
    t, u, v : (M,) float32
        As in `Hits`.
    prim_id : (M,) int32
        Index of the face.
    """

    first: ArrayT
    t: ArrayT
    u: ArrayT
    v: ArrayT
    prim_id: ArrayT

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
        ray_id: Any = np.repeat(np.arange(len(self)), to_numpy(self.counts))
        give: Any = to_tensor_like(self.first)
        return ray_id if give is None else give(wp.array(ray_id, dtype=wp.int64, device=to_warp(self.first).device))

    def __repr__(self) -> str:
        return f"AllHits({len(self)} rays, {int(self.first[-1])} hits)"


class ListQuery:
    """A query for all hits of rays, on a snapshot of a structure. `of` sets the rays; `all`, `first` and `counts` return results."""

    n = 0
    rays: RayArrays
    give: Any = to_numpy  # converts Warp arrays to arrays of the caller's library

    def __init__(self, accel: Accelerator, threads: int | None, crossings: bool = False) -> None:
        self.snapshot = snapshot_of(accel)
        self.threads, self.device = thread_count(threads), self.snapshot.device
        self.lists: WarpStruct = HitLists()
        self.lists.crossings = as_one(crossings, bool, "crossings")
        if crossings:
            surfaces = device_scene(self.snapshot).surfaces
            self.lists.vertices, self.lists.faces = surfaces.vertices, surfaces.faces

    def of(self, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> ListQuery:
        """Set the rays. Raises InputError that names the argument."""
        rays = rays_of(origins, directions, t_min, t_max)
        self.n, self.rays = len(rays.origins), rays_on(self.device, rays)
        self.give = to_tensor_like(origins, directions) or to_numpy
        return self

    def all(self, limit: int = ALL) -> AllHits[Any]:
        """Find the first `limit` hits of each ray."""
        counts, parts = [np.zeros(0, np.int64)], []
        for rays, lists, of_each in self._listed(limit):
            begin = np.concatenate([[0], np.cumsum(of_each)])
            parts.append(self._arrays(begin[-1]))
            counts.append(of_each)
            self._copy(rays, lists, begin, parts[-1])
        first = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        hits = parts[0] if len(parts) == 1 else self._joined(parts)
        return AllHits(self.converted(first), *map(self.give, (hits.t, hits.u, hits.v, hits.prim_id)))

    def first(self, k: int) -> Hits[Any]:
        """Find the first k hits of each ray, in arrays (N, k)."""
        hits = self._arrays(self.n * k)
        hits.t.fill_(np.inf)
        hits.u.zero_()
        hits.v.zero_()
        hits.prim_id.fill_(-1)
        begin = np.arange(0, self.n * k, k, dtype=np.int64)
        for rays, lists, of_each in self._listed(k):
            self._copy(rays, lists, begin[:len(of_each)], hits)
            begin = begin[len(of_each):]
        return Hits(*(self.give(array.reshape((self.n, k))) for array in (hits.t, hits.u, hits.v, hits.prim_id)))

    def counts(self) -> np.ndarray:
        """Count the hits of each ray, (N,) int64. If no triangle is in several leaves, the first traversal is enough."""
        counting = self.snapshot.stats.references == len(self.snapshot.geometry)
        return np.concatenate([np.zeros(0, np.int64), *(of_each for _, _, of_each in self._listed(ALL, counting))])

    def converted(self, values: np.ndarray) -> Array:
        """Convert int64 values to an array of the caller's library."""
        return values if self.give is to_numpy else self.give(upload(values, wp.int64, self.device))

    def _listed(self, limit: int, counting: bool = False) -> Iterator[tuple[Any, list[Any], np.ndarray]]:
        """Yield, for each batch of the rays: these rays, one or two HitLists, and the number of hits of each ray.

        All hits of a ray, at most `limit`, are in one of the HitLists. counting: the caller needs only the numbers of hits.
        """
        limit = min(limit, ALL)
        for begin in range(0, self.n, RAYS_AT_ONCE):
            n, rays = min(RAYS_AT_ONCE, self.n - begin), self.rays
            if n < self.n:
                rays = RayArrays()
                for name in fields_of(RayArrays):
                    setattr(rays, name, getattr(self.rays, name)[begin:begin + n])
            lists = [self._filled(rays, np.full(n, FEW), limit)]
            counts = lists[0].count.numpy().astype(np.int64)
            many = counts > FEW
            if many.any() and not counting:
                lists[0].count = upload(np.where(many, 0, counts), wp.int32, self.device)
                lists.append(self._filled(rays, np.where(many, np.minimum(counts, 2 * limit), 0), limit))
                counts = np.where(many, lists[1].count.numpy(), counts)
            yield rays, lists, counts

    def _filled(self, rays: RayArrays, capacity: np.ndarray, limit: int) -> WarpStruct:
        """Traverse the structure, and return HitLists with space for capacity[i] hits of ray i."""
        lists: WarpStruct = HitLists()
        lists.limit, lists.crossings = limit, self.lists.crossings
        lists.vertices, lists.faces = self.lists.vertices, self.lists.faces
        first = np.concatenate([[0], np.cumsum(capacity)])
        lists.rows = wp.empty(rows_of(first[-1]), dtype=Hit, device=self.device)
        lists.first = upload(first, wp.int32, self.device)
        lists.count = wp.zeros(len(capacity), dtype=wp.int32, device=self.device)
        self._launch(list_hits_kernel(self.snapshot.structure), len(capacity), self.snapshot.data, rays, lists)
        return lists

    def _copy(self, rays: RayArrays, lists: list[WarpStruct], begin: np.ndarray, hits: WarpStruct) -> None:
        for each in lists:
            self._launch(copy_hits, len(rays.origin), rays, each, upload(begin, wp.int32, self.device), hits)

    def _arrays(self, n: int) -> WarpStruct:
        empty = partial(wp.empty, rows_of(n), device=self.device)
        hits: WarpStruct = HitArrays()
        hits.t, hits.u, hits.v, hits.prim_id = *(empty(dtype=wp.float32) for _ in range(3)), empty(dtype=wp.int32)
        return hits

    def _joined(self, parts: list[WarpStruct]) -> WarpStruct:
        out, at = self._arrays(sum(len(part.t) for part in parts)), 0
        for part in parts:
            for name in fields_of(HitArrays):
                wp.copy(getattr(out, name), getattr(part, name), dest_offset=at, count=len(part.t))
            at += len(part.t)
        return out

    def _launch(self, kernel: Kernel, n: int, *inputs: object) -> None:
        launch_on(self.device, kernel, n, *inputs, None, threads=self.threads, step=RAYS_PER_LAUNCH)


def rows_of(hits: int) -> int:
    """Return `hits` as the size of an array. Raises InputError above 2^31 - 1, the largest size that kernels can index."""
    if hits > MOST_ROWS:
        raise InputError(f"{hits} hits do not fit into an array of at most 2^31 - 1", hint="query fewer rays at a time")
    return int(hits)


@made_once
def list_hits_kernel(structure: Structure) -> Kernel:
    listing = structure._replace(units=structure.units._replace(lists=True))
    return make_list_hits_kernel(structure.struct, listing.traversal(any_hit=False, accepts=list_hit))


@overload
def all_hits(accel: Accelerator, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray, t_min: ArrayLike = ...,
             t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ...) -> AllHits: ...
@overload
def all_hits(accel: Accelerator, origins: TensorT, directions: TensorT, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
             threads: int | None = ..., crossings: bool = ...) -> AllHits[TensorT]: ...
def all_hits(accel: Accelerator, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
             threads: int | None = None, crossings: bool = False) -> AllHits[Any]:
    """Find every hit of each ray in its segment, in order of distance. A ray hits each triangle at most once.

    No ray passes between two adjacent triangles: through their common edge it hits one or both, depending on rounding. The time
    for n hits of a ray grows as n log n, even if many hits have the same t.

    Parameters
    ----------
    accel : Accelerator
        Structure over one mesh without spheres.
    origins, directions, t_min, t_max, threads
        See `Accelerator.closest_hit`.
    crossings : bool
        Find crossings of the surface instead. At a shared edge or corner, the ray counts as shifted by an infinitesimal distance:
        it hits one triangle, but at a silhouette none or two. A ray that begins and ends outside of a closed mesh crosses it an even
        number of times. With the watertight test this holds without exception.

    Returns
    -------
    AllHits
        Arrays of NumPy, or of the library of `origins`: PyTorch, JAX.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    return ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max).all()


@overload
def count_hits(accel: Accelerator, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray, t_min: ArrayLike = ...,
               t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ...) -> npt.NDArray[np.int64]: ...
@overload
def count_hits(accel: Accelerator, origins: TensorT, directions: TensorT, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
               threads: int | None = ..., crossings: bool = ...) -> TensorT: ...
def count_hits(accel: Accelerator, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
               threads: int | None = None, crossings: bool = False) -> object:
    """Count the hits of each ray in its segment. The hits take no memory unless the structure has triangles in several leaves.

    Parameters
    ----------
    accel, origins, directions, t_min, t_max, threads, crossings
        See `all_hits`.

    Returns
    -------
    (N,) int64
        Array of NumPy, or of the library of `origins`: PyTorch, JAX.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    query = ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max)
    return query.converted(query.counts())


@overload
def first_hits(accel: Accelerator, k: int, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray, t_min: ArrayLike = ...,
               t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ...) -> Hits: ...
@overload
def first_hits(accel: Accelerator, k: int, origins: TensorT, directions: TensorT, t_min: ArrayLike = ..., t_max: ArrayLike = ...,
               threads: int | None = ..., crossings: bool = ...) -> Hits[TensorT]: ...
def first_hits(accel: Accelerator, k: int, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0,
               t_max: ArrayLike = np.inf, threads: int | None = None, crossings: bool = False) -> Hits[Any]:
    """Find the first k hits of each ray in order of distance. The traversal ends at the k-th hit.

    Parameters
    ----------
    accel, origins, directions, t_min, t_max, threads, crossings
        See `all_hits`.
    k : int
        Number of hits, at least 1.

    Returns
    -------
    Hits
        Arrays (N, k); a ray with fewer hits has misses at the end. These Hits have no points and normals.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    k = as_integer(k, "k", 1, (1 << 31) - 1)
    return ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max).first(k)
