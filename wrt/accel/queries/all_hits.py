"""All hits of a ray, in order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.queries.accelerator import Accelerator, snapshot_of
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.batches import RAYS_PER_LAUNCH
from wrt.accel.queries.hit_points import surroundings
from wrt.accel.queries.rays import rays_of, rays_on
from wrt.accel.structure import Structure
from wrt.core.arrays import returned, to_numpy, to_warp
from wrt.core.checks import as_integer, as_one
from wrt.core.device import MOST_ROWS, launch_on, made_once, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.kernels.hit_lists import FEW, HitLists, copy_hits, list_hit, make_list_hits_kernel
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import Hit
from wrt.kernels.warp_private import fields_of

ALL = (1 << 30) - 1
RAYS_AT_ONCE = 1 << 18  # for whose first walk there are 32 MiB


@dataclass(frozen=True, eq=False)
class AllHits:
    """Those of ray i are rows first[i] to first[i + 1] of t, u, v (float32) and prim_id (int32), in the order of t and, where that
    is equal, of prim_id; first: (N + 1,) int64. NumPy arrays; torch's or JAX's if the rays were."""

    first: Any
    t: Any
    u: Any
    v: Any
    prim_id: Any

    def __len__(self) -> int:
        return len(self.first) - 1

    @property
    def counts(self) -> Any:
        """(N,) int64, as of count_hits."""
        return self.first[1:] - self.first[:-1]

    @property
    def ray_id(self) -> Any:
        """The ray of each hit, (len(t),) int64."""
        ray_id = np.repeat(np.arange(len(self)), to_numpy(self.counts))
        give = returned(self.first)
        return ray_id if give is None else give(wp.array(ray_id, dtype=wp.int64, device=to_warp(self.first).device))

    def __repr__(self) -> str:
        return f"AllHits({len(self)} rays, {len(self.t)} hits)"


class Asked:
    """A structure that is asked, as it is now: `of` gives it rays, and `all`, `first` or `counts` answers."""

    n = 0
    rays: RayArrays
    give: Any = to_numpy  # what answers become, which are Warp's

    def __init__(self, accel: Accelerator, threads: int | None, crossings: bool = False) -> None:
        self.snapshot = snapshot_of(accel)
        self.threads, self.device = thread_count(threads), self.snapshot.device
        self.lists: Any = HitLists()
        self.lists.crossings = as_one(crossings, bool, "crossings")
        if crossings:
            surfaces = surroundings(self.snapshot).surfaces
            self.lists.vertices, self.lists.faces = surfaces.vertices, surfaces.faces

    def of(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf) -> Asked:
        """Raises InputError that names the argument."""
        rays = rays_of(origins, directions, t_min, t_max)
        self.n, self.rays = len(rays.origins), rays_on(self.device, rays)
        self.give = returned(origins, directions) or to_numpy
        return self

    def all(self, limit: int = ALL) -> AllHits:
        """The hits of each ray, `limit` at most."""
        counts, parts = [np.zeros(0, np.int64)], []
        for rays, lists, of_each in self._listed(limit):
            begin = np.concatenate([[0], np.cumsum(of_each)])
            parts.append(self._arrays(begin[-1]))
            counts.append(of_each)
            self._copy(rays, lists, begin, parts[-1])
        first = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        hits = parts[0] if len(parts) == 1 else self._joined(parts)
        return AllHits(self.given(first), *map(self.give, (hits.t, hits.u, hits.v, hits.prim_id)))

    def first(self, k: int) -> Hits:
        """The first k hits of each ray: (N, k)."""
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
        """How many hits each ray has, (N,) int64. Where no triangle is in several leaves, the first walk has counted them all."""
        counting = self.snapshot.stats.references == len(self.snapshot.geometry)
        return np.concatenate([np.zeros(0, np.int64), *(of_each for _, _, of_each in self._listed(ALL, counting))])

    def given(self, numbers: np.ndarray) -> Any:
        """int64 as an answer."""
        return numbers if self.give is to_numpy else self.give(upload(numbers, wp.int64, self.device))

    def _listed(self, limit: int, counting: bool = False) -> Iterator[tuple[Any, list[Any], np.ndarray]]:
        """Of so many rays at a time: the rays; lists, in one of which a ray has its hits, `limit` at most; and how many.
        counting: lists may be too short."""
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

    def _filled(self, rays: RayArrays, room: np.ndarray, limit: int) -> Any:
        """HitLists with room for so many hits of each ray, after the walk."""
        lists: Any = HitLists()
        lists.limit, lists.crossings = limit, self.lists.crossings
        lists.vertices, lists.faces = self.lists.vertices, self.lists.faces
        first = np.concatenate([[0], np.cumsum(room)])
        lists.rows = wp.empty(rows_of(first[-1]), dtype=Hit, device=self.device)
        lists.first = upload(first, wp.int32, self.device)
        lists.count = wp.zeros(len(room), dtype=wp.int32, device=self.device)
        self._launch(list_hits_kernel(self.snapshot.structure), len(room), self.snapshot.data, rays, lists)
        return lists

    def _copy(self, rays: RayArrays, lists: list[Any], begin: np.ndarray, hits: Any) -> None:
        for each in lists:
            self._launch(copy_hits, len(rays.origin), rays, each, upload(begin, wp.int32, self.device), hits)

    def _arrays(self, n: int) -> Any:
        empty = partial(wp.empty, rows_of(n), device=self.device)
        hits: Any = HitArrays()
        hits.t, hits.u, hits.v, hits.prim_id = *(empty(dtype=wp.float32) for _ in range(3)), empty(dtype=wp.int32)
        return hits

    def _joined(self, parts: list[Any]) -> Any:
        out, at = self._arrays(sum(len(part.t) for part in parts)), 0
        for part in parts:
            for name in fields_of(HitArrays):
                wp.copy(getattr(out, name), getattr(part, name), dest_offset=at, count=len(part.t))
            at += len(part.t)
        return out

    def _launch(self, kernel: Any, n: int, *inputs: Any) -> None:
        launch_on(self.device, kernel, n, *inputs, None, threads=self.threads, step=RAYS_PER_LAUNCH)


def rows_of(hits: int) -> int:
    """Raise InputError for more than kernels, whose indices are int32, can reach."""
    if hits > MOST_ROWS:
        raise InputError(f"{hits} hits are more than an array can have, 2^31 - 1", hint="ask fewer rays at a time")
    return int(hits)


@made_once
def list_hits_kernel(structure: Structure) -> Any:
    listing = structure._replace(units=structure.units._replace(lists=True))
    return make_list_hits_kernel(structure.struct, listing.traversal(any_hit=False, accepts=list_hit))


def all_hits(accel: Accelerator, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
             threads: int | None = None, crossings: bool = False) -> AllHits:
    """Every hit of each ray in its segment, in order. Arguments as in Accelerator.closest_hit; the answer is of NumPy, or of
    torch or JAX if the rays are.

    Each triangle is there once. Between two triangles no ray is lost: one through their common edge hits one of them or both,
    depending on rounding (float32, of the ray against the mesh). crossings: only where the ray goes through, as if it stood aside
    of edges and corners by as little as one likes: where a surface goes on, one triangle, and none or two at an outline. So a ray
    crosses a closed surface an even number of times from outside to outside, with the watertight test exactly. One walk finds all
    hits of most rays, and two those of the others; n hits take n log n steps, also where many are at the same t. Raises InputError.
    """
    return Asked(accel, threads, crossings).of(origins, directions, t_min, t_max).all()


def count_hits(accel: Accelerator, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
               threads: int | None = None, crossings: bool = False) -> Any:
    """How many hits each ray has in its segment, (N,) int64; as all_hits. Unless a triangle is in several leaves (cells), the hits
    take no memory."""
    asked = Asked(accel, threads, crossings).of(origins, directions, t_min, t_max)
    return asked.given(asked.counts())


def first_hits(accel: Accelerator, k: int, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
               threads: int | None = None, crossings: bool = False) -> Hits:
    """The first k hits of each ray in order, as Hits of (N, k) arrays; what a ray has not is a miss. As all_hits, but what lies
    beyond the k-th is not walked to."""
    k = as_integer(k, "k", 1, (1 << 31) - 1)
    return Asked(accel, threads, crossings).of(origins, directions, t_min, t_max).first(k)
