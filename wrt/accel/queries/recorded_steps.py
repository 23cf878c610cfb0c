"""Steps of rays through a structure, from the recorder that counts: the source of `wrt.walk` and `wrt.trace`."""

from dataclasses import dataclass

import numpy as np

from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import HIT_TYPES, answer_arrays
from wrt.accel.queries.batches import Query
from wrt.accel.queries.counting import recorded
from wrt.accel.queries.rays import rays_of
from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import ArrayLike
from wrt.kernels.structs import size_of
from wrt.kernels.traverse import steps as of

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


def record_steps(accel: Accelerator, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0,
                 t_max: ArrayLike = np.inf) -> RecordedSteps:
    """Trace closest hits and record every step. Raises InputError for invalid rays, and for instances."""
    if not isinstance(accel, Accelerator):
        raise InputError(f"must be a structure (wrt.build), got {shown(accel)}", argument="accel")
    if accel.structure.units.instances:
        raise InputError("must be a structure over one mesh, not over instances", argument="accel",
                         hint="wrt.build(mesh) over one of the meshes, or wrt.build(wrt.Scene.of(meshes)) over all")
    snapshot = accel.snapshot
    rays = rays_of(np.asarray(origins), np.asarray(directions), t_min, t_max, True, snapshot.geometry.origin)
    out = answer_arrays(HIT_TYPES, None, len(rays.origins), None, False)
    counts, first, steps = recorded(snapshot, Query(rays, out, thread_count(None)))
    nodes, primitives = (int(counts[name].sum(dtype=np.int64)) for name in ("nodes", "primitives"))
    found = np.bincount(steps["kind"], minlength=len(of.KINDS))
    if found[of.NODE] != nodes or found[of.TEST] != primitives:
        raise InputError(f"records {found[of.NODE]} nodes and {found[of.TEST]} primitives, but counts {nodes} and {primitives}",
                         argument="accel", hint="test its leaves with kernels.traverse.leaf")
    origin, direction = np.array(rays.origins, np.float32), np.array(rays.directions, np.float32)
    t, u, v, prim_id = map(np.asarray, out)
    return RecordedSteps(snapshot.structure.accel.name, origin, direction, t, u, v, prim_id, counts, first, steps,
                         int(counts["node_bytes"].sum(dtype=np.int64)) // max(nodes, 1),
                         size_of(snapshot.structure.units.triangle_test.record))
