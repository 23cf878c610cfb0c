"""All hits of a ray, in order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.answers import Hits
from wrt.accel.base import Accelerator
from wrt.accel.batches import RAYS_PER_LAUNCH
from wrt.accel.hit_points import surroundings
from wrt.accel.ray_query import query_of, require_one_mesh, world_of
from wrt.accel.rays import rays_of, rays_on
from wrt.accel.structure import Structure
from wrt.core.arrays import returned, to_numpy, to_warp
from wrt.core.checks import as_integer, as_one, shown
from wrt.core.device import launch_on, made_once
from wrt.core.threads import thread_count
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.ray_query import make_hit_kernels


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
        """(N,) int64."""
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
    """A structure that is asked, as it is now: `of` gives it rays, and launches over them follow."""

    n = 0
    rays: RayArrays
    give: Any = to_numpy  # what answers become, which are Warp's

    def __init__(self, accel: Accelerator, threads: int | None, crossings: bool = False) -> None:
        structure = require_one_mesh(getattr(accel, "structure", None),
                                     f"accel must be a structure over one mesh (wrt.build), got {shown(accel)}")
        self.threads, self.device, self.state = thread_count(threads), accel.device, accel._state
        self.crossings = as_one(crossings, bool, "crossings")
        surfaces = surroundings(accel, self.state).surfaces if crossings else accel._surfaces
        self.world = world_of(structure, self.state.data, surfaces)
        self.count_hits, self.write_hits = hit_kernels(structure)

    def of(self, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf) -> Asked:
        """Raises InputError that names the argument."""
        rays = rays_of(origins, directions, t_min, t_max)
        self.n, self.rays = len(rays.origins), rays_on(self.device, rays)
        self.give = returned(origins, directions) or to_numpy
        return self

    def launch(self, kernel: Any, *inputs: Any) -> None:
        asked = self.world, self.rays, self.crossings
        launch_on(self.device, kernel, self.n, *asked, *inputs, None, threads=self.threads, step=RAYS_PER_LAUNCH)

    def counts(self) -> Any:
        """Of the hits of each ray: a Warp array."""
        counts = wp.zeros(self.n, dtype=wp.int32, device=self.device)
        self.launch(self.count_hits, counts)
        return counts

    def rows(self, first: np.ndarray) -> list[Any]:
        """first, t, u, v, prim_id of so many hits of each ray, misses where it has fewer: Warp arrays."""
        empty = partial(wp.empty, int(first[-1]), device=self.device)
        hits: Any = HitArrays()
        hits.t, hits.u, hits.v, hits.prim_id = *(empty(dtype=wp.float32) for _ in range(3)), empty(dtype=wp.int32)
        begin = wp.array(first, dtype=wp.int64, device=self.device)
        self.launch(self.write_hits, begin, hits)
        return [begin, hits.t, hits.u, hits.v, hits.prim_id]


@made_once
def hit_kernels(structure: Structure) -> tuple[Any, Any]:
    return make_hit_kernels(query_of(structure))


def all_hits(accel: Accelerator, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
             threads: int | None = None, crossings: bool = False) -> AllHits:
    """Every hit of each ray in its segment, in order. Arguments as in Accelerator.closest_hit; the answer is of NumPy, or of
    torch or JAX if the rays are.

    None is lost and none is there twice: a ray through an edge hits both triangles there, at a corner all of them. crossings: only
    where the ray goes through, as if it stood aside of edges and corners by as little as one likes: where a surface goes on, one
    triangle of them, and none or two at an outline. So it crosses a closed surface an even number of times from outside to outside,
    with the watertight test exactly. A hit takes one walk from the root, and the count another; each walk tests all that is hit at
    the same t. Raises InputError.
    """
    asked = Asked(accel, threads, crossings).of(origins, directions, t_min, t_max)
    first = np.concatenate([[0], np.cumsum(asked.counts().numpy(), dtype=np.int64)])
    return AllHits(*map(asked.give, asked.rows(first)))


def count_hits(accel: Accelerator, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
               threads: int | None = None, crossings: bool = False) -> Any:
    """How many hits each ray has in its segment, (N,) int32; as all_hits."""
    asked = Asked(accel, threads, crossings).of(origins, directions, t_min, t_max)
    return asked.give(asked.counts())


def first_hits(accel: Accelerator, k: int, origins: Any, directions: Any, t_min: Any = 0.0, t_max: Any = np.inf,
               threads: int | None = None, crossings: bool = False) -> Hits:
    """The first k hits of each ray in order, as Hits of (N, k) arrays; what a ray has not is a miss. As all_hits."""
    k = as_integer(k, "k", 1, (1 << 31) - 1)
    asked = Asked(accel, threads, crossings).of(origins, directions, t_min, t_max)
    rows = asked.rows(np.arange(asked.n + 1, dtype=np.int64) * k)[1:]
    t, u, v, prim_id = (asked.give(row.reshape((asked.n, k))) for row in rows)
    return Hits(t, u, v, prim_id)
