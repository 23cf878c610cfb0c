"""Queries with an observer (kernels.traverse.observer): counters, fetches, and the steps that `wrt.walk` and `wrt.trace` read."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from wrt.accel.queries.answers import HIT_TYPES, Counters, answer_arrays
from wrt.accel.queries.arguments import rays_of
from wrt.accel.queries.batches import Query, trace_query
from wrt.accel.snapshot import Snapshot
from wrt.core.checks import shown
from wrt.core.device import on_host, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike, WarpStruct
from wrt.core.warp_private import refuse_capture
from wrt.kernels.structs import size_of
from wrt.kernels.traverse import steps as of
from wrt.kernels.traverse.observer import SIZE_RANGE, Counts

RAYS_AT_ONCE = 1 << 12  # rays whose steps are in memory at once, about 10 kB each


@dataclass(frozen=True, eq=False)
class RecordedSteps:
    """Steps of N rays that search their closest hit. The hits are t, u, v and prim_id, (N,) each."""

    structure: str
    origin: np.ndarray  # (N, 3) float32.
    direction: np.ndarray  # (N, 3) float32.
    t: np.ndarray
    u: np.ndarray
    v: np.ndarray
    prim_id: np.ndarray
    counts: np.ndarray  # (N,), as in Counters.
    first: np.ndarray  # (N + 1,). Ray i has the steps first[i] .. first[i + 1] - 1.
    steps: np.ndarray  # (M,) records of kernels.traverse.steps.Step.
    node_bytes: int  # Size of a record.
    primitive_bytes: int

    def __len__(self) -> int:
        return len(self.first) - 1

    def depths(self) -> np.ndarray:
        """Return the depth of each step's node or leaf, (M,) int16: the number of links from the root; -1 if no child is recorded."""
        steps = self.steps
        kind, index, at = steps["kind"], steps["index"], np.arange(len(steps))
        begin = np.repeat(self.first[:-1], np.diff(self.first))
        node = np.maximum.accumulate(np.where(kind == of.NODE, at, -1))
        leaf = np.maximum.accumulate(np.where(kind == of.LEAF, at, -1))
        child = np.flatnonzero(((kind == of.BOX) | (kind == of.PART)) & (node >= begin))
        # Each child's parent. Every ray records the ancestors of all its nodes, from the root on.
        inner = steps["count"][child] == of.INNER
        size = int(index.max(initial=0)) + 1
        parent, parent_of_leaf = np.full(size, -1, np.int64), np.full(size, -1, np.int64)
        parent[index[child[inner]]] = index[node[child[inner]]]
        parent_of_leaf[index[child[~inner]]] = index[node[child[~inner]]]
        depth, up = np.zeros(size, np.int16), parent.copy()
        while (below := up >= 0).any():
            depth[below] += 1
            up[below] = parent[up[below]]
        in_node = np.where(node >= begin, depth[index[node]], 0)  # also of a leaf that is a node
        above = parent_of_leaf[index[leaf]]
        in_leaf = np.where((leaf > node) & (leaf >= begin) & (above >= 0), depth[above] + 1, in_node)
        out = np.where((kind == of.TEST) | (kind == of.LEAF) | (kind == of.SKIP), in_leaf, in_node).astype(np.int16)
        if not len(child) and (kind == of.NODE).any() and not (kind == of.CELL).any():
            out[:] = -1
        return out


def copied(data: WarpStruct) -> WarpStruct:
    """Copy a Warp struct but not its arrays, so that fields of the copy can be set."""
    out = type(data)()
    out.assign(data)
    return out


def observed(snapshot: Snapshot, query: Query, observer: str, first: np.ndarray, fetches: int = 0, steps: int = 0) -> WarpStruct:
    """Trace the query with an observer (Units.observer), and return its Recorder. first: as there; fetches, steps: lengths of arrays."""
    own, device = copied(snapshot.data), snapshot.device  # a copy, because each call needs a recorder of its own
    own.recorder.counts = wp.zeros(len(query.out[0]), dtype=Counts, device=device)
    own.recorder.first = upload(first, wp.int64, device)
    own.recorder.fetches = wp.zeros(fetches, dtype=wp.int64, device=device)
    own.recorder.steps = wp.zeros(steps, dtype=of.Step, device=device)
    trace_query(snapshot.observed(own, observer), query)
    return own.recorder


def counted(snapshot: Snapshot, query: Query, fetches_too: bool) -> Counters:
    """Trace the query and count its costs. fetches_too: record each fetch in a second run, after a first run that counts fetches."""
    refuse_capture(snapshot.device)
    counts = on_host(observed(snapshot, query, "sum", np.zeros(0, np.int64)).counts)
    first, fetches = np.zeros(len(counts) + 1, np.int64), np.zeros(0, np.int64)
    if fetches_too:
        np.cumsum(counts["nodes"].astype(np.int64) + counts["primitives"], out=first[1:])
        fetches = on_host(observed(snapshot, query, "sum", first, fetches=int(first[-1])).fetches)
    return Counters(counts, first, fetches // int(SIZE_RANGE), fetches % int(SIZE_RANGE))


def record_steps(accel: object, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0,
                 t_max: ArrayLike = np.inf) -> RecordedSteps:
    """Trace closest hits and record every step. Raises InputError for invalid rays, and for instances."""
    snapshot = getattr(accel, "snapshot", None)
    if not isinstance(snapshot, Snapshot):
        raise InputError(f"must be a structure (wrt.build), got {shown(accel)}", argument="accel")
    if snapshot.structure.units.instances:
        raise InputError("must be a structure over one mesh, not over instances", argument="accel",
                         hint="wrt.build(mesh) over one of the meshes, or wrt.build(wrt.Scene.of(meshes)) over all")
    rays, _ = rays_of(np.asarray(origins), np.asarray(directions), t_min, t_max, True, snapshot.geometry.origin)
    out = answer_arrays(HIT_TYPES, None, (len(rays.origins),), None)
    query, first = Query(rays, out, thread_count(None)), np.zeros(len(rays.origins) + 1, np.int64)
    np.cumsum(on_host(observed(snapshot, query, "log", np.zeros(len(rays.origins), np.int64)).first), out=first[1:])
    recorder = observed(snapshot, query, "log", first[:-1].copy(), steps=int(first[-1]))
    counts, steps = on_host(recorder.counts), on_host(recorder.steps)
    origin, direction = np.array(rays.origins, np.float32), np.array(rays.directions, np.float32)
    t, u, v, prim_id = map(np.asarray, out)
    return RecordedSteps(snapshot.structure.accel.name, origin, direction, t, u, v, prim_id, counts, first, steps,
                         int(counts["node_bytes"].sum(dtype=np.int64)) // max(int(counts["nodes"].sum(dtype=np.int64)), 1),
                         size_of(snapshot.structure.units.triangle_test.record))
