"""Walks of wide trees by other rules than wrt's own: counts and logs of each ray (kernel: kernels/study/tree_walk.py)."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import warp as wp

from wrt.accel.bvh.builders import BvhOptions, build_binary
from wrt.accel.bvh.compress import compress, decompress
from wrt.accel.bvh.wide_tree import WideTree, collapse
from wrt.accel.geometry import Geometry
from wrt.core.device import launch, on_host, start, upload
from wrt.core.errors import InputError
from wrt.core.types import WarpStruct
from wrt.kernels.structs import Primitive, Surfaces
from wrt.kernels.study import tree_walk as kernels
from wrt.kernels.study.tree_walk import STACK
from wrt.kernels.traverse.common import Units

RAYS_PER_LAUNCH = 2048


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of a workload, arrays (N,), sorted by depth, kind and pixel."""

    origins: np.ndarray  # (N, 3) float32.
    directions: np.ndarray  # (N, 3) float32.
    t_max: np.ndarray
    kind: np.ndarray  # The value 0 for camera or bounce, 1 for shadow or ambient occlusion. The latter end at their first hit.
    depth: np.ndarray  # Bounces before the ray.
    pixel: np.ndarray  # Index of its pixel.
    warp: np.ndarray  # (N,) int64, warp of 32 rays in which the ray runs, ascending; gaps are idle lanes.

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, rows: np.ndarray) -> "Rays":
        return Rays(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


class Tree(NamedTuple):
    """A wide tree with its primitives on the device."""

    wide: WideTree
    data: WarpStruct

    @property
    def width(self) -> int:
        return int(self.wide.children.shape[1])


class Rules(NamedTuple):
    """Rules of a walk, see kernels.study.tree_walk.Rules. The default is wrt's own walk."""

    ordered: bool = True
    culled: bool = True


@dataclass(frozen=True, eq=False)
class Walk:
    """Result of `walk`. The log has M fetches of all rays."""

    counts: np.ndarray  # (N,) records of kernels.study.tree_walk.Work.
    first: np.ndarray  # (N + 1,) int64. Ray i has the fetches first[i] .. first[i + 1] - 1.
    fetch: np.ndarray  # (M,) int32 references.
    entered: np.ndarray  # (M,) int64, entries that each fetch pushed.

    @cached_property
    def fetches(self) -> np.ndarray:
        """Number of nodes and leaves that each ray fetches, (N,) int64."""
        return self.counts["inner"].astype(np.int64) + self.counts["leaves"]

    @cached_property
    def owner(self) -> np.ndarray:
        """Ray of each fetch, (M,) int64."""
        return np.repeat(np.arange(len(self.counts)), np.diff(self.first))


def tree_of(geometry: Geometry, wide: WideTree) -> Tree:
    """Upload a tree and its primitives."""
    cpu, data = start("cpu"), kernels.StudyTree()
    data.width = wide.children.shape[1]
    data.children = upload(np.ascontiguousarray(wide.children).reshape(-1), wp.int32, cpu)
    data.lo, data.hi = (upload(np.ascontiguousarray(box).reshape(-1, 3), wp.vec3, cpu) for box in (wide.lo, wide.hi))
    order = np.maximum(wide.order.reshape(-1), 0).astype(np.int32)
    data.primitives = upload(geometry.primitives(Units(), order), Primitive, cpu)
    return Tree(wide, data)


def build_tree(geometry: Geometry, width: int, max_leaf: int = 1, bits: int = 32) -> Tree:
    """Build a tree of nodes with `width` children, as wrt's wide BVHs are built. bits of a plane of a box: 32 (float32), or 8, rounded
    outwards, as in the nodes of bvh8c (width 2 to 8, even)."""
    options = BvhOptions(max_leaf=max_leaf, cost_traversal=0.0, row=width)
    wide = collapse(build_binary(geometry, options, 1), width, max_leaf, 1.0, 1.0)
    if bits == 8:
        lo, hi = decompress(compress(wide.lo, wide.hi, wide.exists), width)
        wide = WideTree(np.ascontiguousarray(lo), np.ascontiguousarray(hi), wide.children, wide.order, wide.leaves, wide.depth)
    return tree_of(geometry, wide)


def walk(tree: Tree, rays: Rays, rules: Rules) -> Walk:
    """Trace rays by `rules`, once to count and once with a log. Raise InputError if a stack needs more than STACK entries."""
    cpu, n, given = start("cpu"), len(rays), kernels.StudyRays()
    given.origin, given.direction = (upload(np.ascontiguousarray(each), wp.vec3, cpu) for each in (rays.origins, rays.directions))
    given.t_max = upload(rays.t_max.astype(np.float32), wp.float32, cpu)
    given.any_hit = upload((rays.kind == 1).astype(np.int8), wp.int8, cpu)
    device_rules, out = kernels.Rules(), wp.zeros(n, dtype=kernels.Work, device=cpu)
    device_rules.ordered, device_rules.culled = map(int, rules)
    scratch = wp.empty(RAYS_PER_LAUNCH * int(STACK), dtype=wp.uint64, device=cpu)

    def trace(record: WarpStruct) -> np.ndarray:
        record.work = out
        launch(kernels.walk, n, tree.data, Surfaces(), given, device_rules, None, scratch, record, step=RAYS_PER_LAUNCH)
        return on_host(out).copy()

    counts = trace(kernels.WalkLog())
    if counts["full"].any():
        raise InputError(f"a ray needs more than {int(STACK)} entries in its stack")
    first = np.concatenate([[0], np.cumsum(counts["inner"].astype(np.int64) + counts["leaves"])])
    record = kernels.WalkLog()
    record.fetch_first = upload(first, wp.int64, cpu)
    record.fetch = wp.zeros(int(first[-1]), dtype=wp.int32, device=cpu)
    record.entered = wp.zeros(int(first[-1]), dtype=wp.int8, device=cpu)
    trace(record)
    return Walk(counts, first, record.fetch.numpy().copy(), record.entered.numpy().astype(np.int64))
