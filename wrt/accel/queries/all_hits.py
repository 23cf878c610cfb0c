"""All hits of a ray in order of distance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar, Unpack, overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.geometry import InstancedGeometry
from wrt.accel.queries.accelerator import Accelerator, WorldOptions, snapshot_of
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.batches import Tracer, lister
from wrt.accel.queries.few_lists import MOST, FewLists, Mesh, begins
from wrt.accel.queries.hit_points import HitIds, Source, device_scene
from wrt.accel.queries.part_faces import part_faces
from wrt.accel.queries.raw_kernel import RawKernel, kernel_memory
from wrt.accel.queries.rays import Rays, are_rows, arrays_on, host_arrays, rays_of
from wrt.accel.queries.shapes import Shape, shaped_rays, worlds_of_each
from wrt.accel.queries.world_ids import WorldIds, check_world, roots_at
from wrt.accel.snapshot import Snapshot, Structure
from wrt.core.arrays import given_like, to_numpy, to_tensor_like
from wrt.core.checks import as_integer, as_one
from wrt.core.device import MOST_ROWS, made_once, upload
from wrt.core.errors import InputError
from wrt.core.threads import FreeList, thread_count
from wrt.core.types import Array, ArrayLike, ArrayT, NumpyLike, TensorT, WarpArray
from wrt.kernels.hit_lists import FEW, HitLists, copy_hits, make_list_hit, make_list_hits_kernel
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import Hit

ALL = (1 << 30) - 1
RAYS_AT_ONCE = 1 << 18  # rays per batch; their hit lists take 32 MiB in the first traversal
HIT_KINDS = wp.float32, wp.float32, wp.float32, wp.int32  # of HitArrays
T = TypeVar("T")
COPY_HITS = RawKernel(copy_hits, RayArrays(), HitLists(), None, HitArrays())


class ListOptions(WorldOptions, total=False):
    """Options of `first_hits` by keyword."""

    crossings: bool


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


class _Lists(NamedTuple):
    """Fields of HitLists."""

    limit: int
    crossings: bool
    vertices: WarpArray | None
    faces: WarpArray | None
    first_face: WarpArray | None
    first: Array
    counts: Array
    rows: Array | None
    root: Array | None = None
    scale: Array | None = None
    to_face: Array | None = None
    end: Array | None = None


class ListQuery:
    """A query for all hits of rays, on a snapshot of a structure. `of` sets the rays; `all`, `first` and `counts` return results."""

    n = 0
    shape: Shape | None = None  # Of the rays; None: (n,).
    rays: Rays
    worlds: WorldIds | None = None
    roots: np.ndarray | None = None  # (N,) int32, root node of each ray's world, or -1; None without instances.
    touches: np.ndarray  # (N,) bool, if crossings are found: the ray hits triangles, but crosses none.
    give: Any  # Converts arrays to those of the caller's library.

    def __init__(self, accel: Accelerator, threads: int | None, crossings: bool = False) -> None:
        self.snapshot = snapshot_of(accel, instances=True)
        self.threads, self.device = thread_count(threads), self.snapshot.device
        self.memory: Any = kernel_memory(self.device)
        self.give = to_numpy
        self.crossings = as_one(crossings, bool, "crossings")
        vertices = faces = first_face = None
        if self.snapshot.roots is not None:
            vertices, faces, first_face = part_faces(self.snapshot)
        elif crossings:
            surfaces = device_scene(self.snapshot).surfaces
            vertices, faces = surfaces.vertices, surfaces.faces
        self.mesh: Mesh = (vertices, faces, first_face) if crossings else (None, None, first_face)

    def of_valid(self, rays: Rays, world: ArrayLike | None = None) -> ListQuery:
        """Set rays that are valid: contiguous NumPy arrays of float32. world: see `of`."""
        self.n, self.rays = len(rays.origins), rays if self.device.is_cpu else arrays_on(self.device, rays)
        self.worlds = check_world(self.snapshot, world, self.n)
        self.roots = roots_at(self.snapshot, self.worlds, self.n)
        return self

    def of(self, origins: ArrayLike, directions: ArrayLike | None, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
           world: ArrayLike | None = None) -> ListQuery:
        """Set the rays. Raises InputError that names the argument."""
        zero = self.snapshot.geometry.origin
        if are_rows(origins, directions):
            rays = rays_of(origins, directions, t_min, t_max, origin=zero)  # type: ignore[arg-type]
        else:
            rays, self.shape = shaped_rays(origins, directions, t_min, t_max, origin=zero)
            world = worlds_of_each(world, self.shape)
        self.n, self.rays = len(rays.origins), host_arrays(rays) if self.device.is_cpu else arrays_on(self.device, rays)
        self.worlds = check_world(self.snapshot, world, self.n)
        self.roots = roots_at(self.snapshot, self.worlds, self.n)
        self.give = to_tensor_like(origins, directions) or to_numpy
        return self

    def all(self, limit: int = ALL) -> AllHits[Any]:
        """Find the first `limit` hits of each ray."""
        if (few := self._few(min(limit, ALL), lambda lists, counts: lists.hits_of(counts))) is not None:
            return self._all(*few)
        counts, parts = [np.zeros(0, np.int64)], []
        for rays, lists, of_each in self._listed(limit):
            first = begins(of_each)
            parts.append([self.memory.empty(rows_of(first[-1]), kind) for kind in HIT_KINDS])
            counts.append(of_each)
            self._copy(rays, lists, first, parts[-1])
        if len(parts) == 1:
            return self._all(first, *parts[0])
        first = begins(np.concatenate(counts))
        rows_of(first[-1])
        hits = [self.memory.joined(arrays, kind) for kind, *arrays in zip(HIT_KINDS, *parts, strict=True)]
        return self._all(first, *hits)

    def _all(self, first: np.ndarray, *hits: Array) -> AllHits[Any]:
        return AllHits(*[self.converted(first), *map(self.give, hits), self._source(np.diff(first))])

    def _source(self, counts: int | np.ndarray) -> Source:
        return self.snapshot, None, self.worlds and self.worlds.of(np.repeat(np.arange(self.n), counts))

    def first(self, k: int) -> Hits[Any]:
        """Find the first k hits of each ray, in arrays (N, k)."""
        rows_of(self.n * k)
        hits = [self.memory.array(np.full(self.n * k, missing), kind)
                for missing, kind in zip((np.inf, 0.0, 0.0, -1), HIT_KINDS, strict=True)]
        begin = np.arange(0, self.n * k, k, dtype=np.int64)
        for rays, lists, of_each in self._listed(k):
            self._copy(rays, lists, begin[:len(of_each)], hits)
            begin = begin[len(of_each):]
        shape = (self.n,) if self.shape is None else self.shape
        return Hits(*[*(self.give(array.reshape((*shape, k))) for array in hits), None, self._source(k)])

    def counts(self) -> np.ndarray:
        """Count the hits of each ray, (N,) int64. If no triangle is in several leaves, one traversal is enough."""
        if (few := self._few(ALL, lambda lists, counts: counts)) is not None:
            return few
        return np.concatenate([np.zeros(0, np.int64), *(of_each for _, _, of_each in self._listed(ALL, stores_once(self.snapshot)))])

    def converted(self, values: np.ndarray) -> Array:
        """Convert int64 values to an array of the caller's library."""
        return values if self.give is to_numpy else self.give(upload(values, wp.int64, self.device))

    def _few(self, limit: int, take: Callable[[FewLists, np.ndarray], T]) -> T | None:
        """Return `take` of the lists of few rays and their numbers of hits; None on a GPU, and for many rays or hits."""
        def find(lists: FewLists) -> T | None:
            counts = lists.find(self.snapshot, self.rays, self.roots, limit, self.mesh)
            return None if counts is None else take(lists, self._noted(counts))

        return few_lists(self.snapshot.structure).run(find) if self.n <= MOST and self.device.is_cpu else None

    def _noted(self, counts: np.ndarray, first: int = 0) -> np.ndarray:
        """Convert HitLists.count of the rays from `first` on to numbers of hits, int64, and set `touches` of these rays."""
        if self.crossings:
            if first == 0:
                self.touches = np.zeros(self.n, bool)
            self.touches[first:first + len(counts)] = counts < 0
            counts = np.maximum(counts, 0)
        return counts.astype(np.int64)

    def _listed(self, limit: int, counting: bool = False) -> Iterator[tuple[object, list[_Lists], np.ndarray]]:
        """Yield, for each batch of the rays: these rays, one or two HitLists, and the number of hits of each ray.

        All hits of a ray, at most `limit`, are in one of the HitLists. counting: the caller needs only the numbers of hits.
        """
        limit = min(limit, ALL)
        for begin in range(0, self.n, RAYS_AT_ONCE):
            n = min(RAYS_AT_ONCE, self.n - begin)
            rays = self.memory.struct(RayArrays, *(array[begin:begin + n] for array in self.rays))
            roots = None if self.roots is None else self.memory.array(self.roots[begin:begin + n], wp.int32)
            tracer = lister(self.snapshot.structure) if limit > FEW and self.device.is_cpu else None
            room = FEW if not counting else 1 if tracer is None else 0  # hits of each ray
            few = self._filled(rays, roots, room * np.arange(n + 1), limit, counting, tracer)
            lists, counts = [few], self._noted(self.memory.numpy(few.counts), begin)
            if counts.max() > FEW and not counting:
                many = counts > FEW
                lists[0] = few._replace(counts=self.memory.array(np.where(many, 0, counts), wp.int32))
                lists.append(self._filled(rays, roots, begins(np.where(many, np.minimum(counts, 2 * limit), 0)), limit))
                counts = np.where(many, self.memory.numpy(lists[1].counts), counts)
            yield rays, lists, counts

    def _filled(self, rays: object, roots: Array | None, first: np.ndarray, limit: int, counting: bool = False,
                tracer: Tracer | None = None) -> _Lists:
        """Traverse the structure, by means of `tracer` if there is one, and return lists of hits.

        The list of ray i has the rows first[i] .. first[i + 1] - 1. No rows: only count hits, which needs a tracer.
        """
        rows, n = rows_of(first[-1]), len(first) - 1
        lists = _Lists(limit, self.crossings, *self.mesh, self.memory.array(first, wp.int32),
                       self.memory.array(np.zeros(n, np.int32), wp.int32), self.memory.empty(rows, Hit) if rows else None)
        if roots is not None:
            lists = _Lists(*lists[:8], roots, *(self.memory.empty(n, kind) for kind in (wp.float64, wp.int32, wp.float32)))
        record = self.memory.struct(HitLists, *lists)
        if tracer:
            tracer.launch(self.snapshot, (rays, record), n, self.threads)
        else:
            kernel = list_hits(self.snapshot.structure, not counting)
            self.memory.launch(kernel, n, self.snapshot.data, rays, record, threads=self.threads)
        return lists

    def _copy(self, rays: object, lists: list[_Lists], begin: np.ndarray, hits: list[Array]) -> None:
        for each in lists:
            self.memory.launch(COPY_HITS, len(each.counts), rays, self.memory.struct(HitLists, *each),
                               self.memory.array(begin, wp.int32), self.memory.struct(HitArrays, *hits), threads=self.threads)


def rows_of(hits: int) -> int:
    """Return `hits` as the size of an array. Raises InputError above 2^31 - 1, the largest size that kernels can index."""
    if hits > MOST_ROWS:
        raise InputError(f"{hits} hits do not fit into an array of at most 2^31 - 1", hint="query fewer rays at a time")
    return int(hits)


def stores_once(snapshot: Snapshot) -> bool:
    """Return whether each triangle is in one leaf only."""
    parts = snapshot.geometry.parts if isinstance(snapshot.geometry, InstancedGeometry) else [snapshot.geometry]
    return bool(snapshot.stats.references == sum(map(len, parts)))


def counter_of(snapshot: Snapshot) -> Tracer | None:
    """Return the tracer that counts hits without room for them (batches.lister), or None if the structure has none."""
    return lister(snapshot.structure) if snapshot.device.is_cpu and stores_once(snapshot) else None


@made_once
def list_hits(structure: Structure, ordered: bool) -> RawKernel:
    """Return the kernel that lists hits. ordered: it visits near nodes first, so that it ends early if the number of hits is limited."""
    listing, instances = structure._replace(units=structure.units._replace(lists=True)), structure.units.instances
    accepts = make_list_hit(instances, structure.units.triangle == "watertight")
    traverse = listing.traversal(any_hit=not ordered, accepts=accepts)
    kernel = make_list_hits_kernel(structure.struct, traverse, instances)
    return RawKernel(kernel, structure.struct(), RayArrays(), HitLists())


@made_once
def few_lists(structure: Structure) -> FreeList[FewLists]:
    """Return the FewLists of a structure that no thread uses now."""
    return FreeList(lambda: FewLists(list_hits(structure, True), COPY_HITS, lister(structure)))


@overload
def all_hits(accel: Accelerator, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray | None = ..., t_min: ArrayLike = ...,
             t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ..., **options: Unpack[WorldOptions]) -> AllHits: ...
@overload
def all_hits(accel: Accelerator, origins: TensorT, directions: TensorT | None = ..., t_min: ArrayLike = ...,
             t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ...,
             **options: Unpack[WorldOptions]) -> AllHits[TensorT]: ...
def all_hits(accel: Accelerator, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf,
             threads: int | None = None, crossings: bool = False, *, world: ArrayLike | None = None) -> AllHits[Any]:
    """Find every hit of each ray in its segment, in order of distance. A ray hits each triangle at most once.

    No ray passes between two adjacent triangles: through their common edge it hits one or both, depending on rounding. The time
    for n hits of a ray grows as n log n, even if many hits have the same t.

    Parameters
    ----------
    accel : Accelerator
        Structure without spheres.
    origins, directions, t_min, t_max, threads, world
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
    return ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max, world).all()


@overload
def count_hits(accel: Accelerator, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray | None = ..., t_min: ArrayLike = ...,
               t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ...,
               **options: Unpack[WorldOptions]) -> npt.NDArray[np.int64]: ...
@overload
def count_hits(accel: Accelerator, origins: TensorT, directions: TensorT | None = ..., t_min: ArrayLike = ...,
               t_max: ArrayLike = ..., threads: int | None = ..., crossings: bool = ..., **options: Unpack[WorldOptions]) -> TensorT: ...
def count_hits(accel: Accelerator, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0,
               t_max: ArrayLike = np.inf, threads: int | None = None, crossings: bool = False, *, world: ArrayLike | None = None) -> object:
    """Count the hits of each ray in its segment. The hits take no memory unless the structure has triangles in several leaves.

    Parameters
    ----------
    accel, origins, directions, t_min, t_max, threads, crossings, world
        See `all_hits`.

    Returns
    -------
    (...) int64
        Array of the rays' shape, of NumPy or of the library of `origins`: PyTorch, JAX.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    query = ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max, world)
    counts = query.counts()
    return query.converted(counts if query.shape is None else counts.reshape(query.shape))


@overload
def first_hits(accel: Accelerator, k: int, origins: NumpyLike | WarpArray, directions: NumpyLike | WarpArray | None = ...,
               t_min: ArrayLike = ..., t_max: ArrayLike = ..., threads: int | None = ..., **options: Unpack[ListOptions]) -> Hits: ...
@overload
def first_hits(accel: Accelerator, k: int, origins: TensorT, directions: TensorT | None = ...,
               t_min: ArrayLike = ..., t_max: ArrayLike = ..., threads: int | None = ...,
               **options: Unpack[ListOptions]) -> Hits[TensorT]: ...
def first_hits(accel: Accelerator, k: int, origins: ArrayLike, directions: ArrayLike | None = None, t_min: ArrayLike = 0.0,
               t_max: ArrayLike = np.inf, threads: int | None = None, *, crossings: bool = False,
               world: ArrayLike | None = None) -> Hits[Any]:
    """Find the first k hits of each ray in order of distance. The traversal ends at the k-th hit.

    Parameters
    ----------
    accel, origins, directions, t_min, t_max, threads, crossings, world
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
    return ListQuery(accel, threads, crossings).of(origins, directions, t_min, t_max, world).first(k)
