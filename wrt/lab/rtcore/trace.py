"""Traces: every fetch of every ray with its test and result, as arrays that can be saved, changed, and given to the model again.

docs/rt_core.md describes the arrays and shows how to add an idea for hardware. The steps come from the recorder of `wrt.walk`."""

from __future__ import annotations

import io
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import Counters
from wrt.accel.queries.arguments import rays_of
from wrt.accel.queries.observed import RAYS_AT_ONCE, RecordedSteps, record_steps
from wrt.accel.queries.rays import Rays
from wrt.core.checks import as_path, require_known
from wrt.core.errors import InputError
from wrt.core.files import require_file, write_bytes
from wrt.core.types import ArrayLike, PathLike
from wrt.kernels.traverse import steps as of
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE
from wrt.lab.rtcore.caches import Prefetches
from wrt.lab.rtcore.model import Prediction, Work, packed, predict
from wrt.lab.rtcore.parameters import BASE, GPUS, Core

TESTS = ("none", "box", "plane", "cell", "primitive")
NONE, BOX, PLANE, CELL, PRIMITIVE = range(len(TESTS))
# Groups of arrays with equal lengths. A `first` array has one entry more than the rows that it divides.
PER_RAY = ("origin", "direction", "root_boxes", "t", "prim_id", "counts")
PER_FETCH = ("address", "size", "depth", "test", "tests", "result")
PER_CHILD = ("child_address", "child_size", "child_t")
PER_PREFETCH = ("prefetch_after", "prefetch_address", "prefetch_size")


@dataclass(frozen=True, eq=False)
class Trace:
    """Fetches of N rays through a structure, M in all. Successive blocks of 32 rays are warps."""

    structure: str  # Its name.
    origin: np.ndarray  # origin, direction: the rays, (N, 3) float32.
    direction: np.ndarray
    t: np.ndarray  # t, prim_id: closest hits, (N,), as in `Hits`.
    prim_id: np.ndarray
    counts: np.ndarray  # (N,) counters, as in `Counters.counts`.
    root_boxes: np.ndarray  # (N,) int16, boxes tested before the first fetch.
    first: np.ndarray  # (N + 1,) int64. Ray i has the fetches first[i] .. first[i + 1] - 1.
    address: np.ndarray  # address, size: (M,) int64, in bytes. Nodes begin at address 0, primitives at 2^40.
    size: np.ndarray
    depth: np.ndarray  # (M,) int16, links from the root to the node or leaf; -1 if the structure records no children.
    test: np.ndarray  # (M,) int16, index into TESTS: what is tested after the fetch.
    tests: np.ndarray  # (M,) int16, how many of these: children's boxes, or 1.
    # (M,) int16. Of a node: number of children that the ray enters. Of a primitive: 0 missed, 1 before t_min, 2 behind the closest hit so
    # far, 3 new closest hit.
    result: np.ndarray
    child_first: np.ndarray  # (M + 1,) int64. Fetch j has the children child_first[j] .. child_first[j + 1] - 1, in the order of the node.
    child_address: np.ndarray  # child_address, child_size: (K,) int64, node or all primitives of the leaf.
    child_size: np.ndarray
    child_t: np.ndarray  # (K,) float32, where the ray enters the child; inf if it does not.
    # Prefetches, (P,) int64: fetch that starts it, ascending; bytes. A new trace has none.
    prefetch_after: np.ndarray
    prefetch_address: np.ndarray
    prefetch_size: np.ndarray

    def __post_init__(self) -> None:
        n, m = len(self.first) - 1, len(self.address)
        lengths = {**dict.fromkeys(PER_RAY, n), **dict.fromkeys(PER_FETCH, m), "child_first": m + 1,
                   **dict.fromkeys(PER_CHILD, len(self.child_t)), **dict.fromkeys(PER_PREFETCH, len(self.prefetch_after))}
        for name, length in lengths.items():
            if len(getattr(self, name)) != length:
                raise InputError(f"has {len(getattr(self, name))} rows, and must have {length}", argument=name)
        for name, rows in (("first", m), ("child_first", len(self.child_t))):
            ends = getattr(self, name)
            if not (len(ends) and ends[0] == 0 and ends[-1] == rows and (np.diff(ends) >= 0).all()):
                raise InputError(f"must ascend from 0 to {rows}", argument=name)
        for name in ("", "prefetch_"):
            if ((getattr(self, f"{name}address") < 0) | (getattr(self, f"{name}size") <= 0)).any():
                raise InputError("must be 0 or more, with a size of at least 1 byte", argument=f"{name}address")
        after = self.prefetch_after
        if ((after < 0) | (after >= m)).any() or (np.diff(after) < 0).any():
            raise InputError(f"must ascend, from 0 to {m - 1} at most", argument="prefetch_after")
        if ((self.test < 0) | (self.test >= len(TESTS))).any():
            raise InputError(f"must be from 0 to {len(TESTS) - 1}", argument="test")

    def __len__(self) -> int:
        return len(self.first) - 1

    def __repr__(self) -> str:
        return f"Trace({self.structure}, {len(self)} rays, {len(self.address)} fetches, {len(self.prefetch_after)} prefetches)"

    @property
    def ray(self) -> np.ndarray:
        """Index of the ray of each fetch, (M,) int64."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))

    @property
    def counters(self) -> Counters:
        """Counters of the fetches as they are now; leaves, pushes, pops and stack are those of the recorded walk."""
        n, ray, node = len(self), self.ray, self.test != PRIMITIVE
        counts, tested = self.counts.copy(), node & (self.tests > 0)
        for name, rows in (("nodes", node), ("primitives", ~node), ("box_operations", tested)):
            counts[name] = np.bincount(ray[rows], minlength=n)
        for name, rows, weight in (("boxes", self.test == BOX, self.tests), ("node_bytes", node, self.size),
                                   ("primitive_bytes", ~node, self.size)):
            counts[name] = np.bincount(ray[rows], weight[rows], minlength=n)
        counts["boxes"] += self.root_boxes
        counts["box_operations"] += self.root_boxes
        return Counters(counts, self.first, self.address.astype(np.int64), self.size.astype(np.int64))

    def work(self, name: str = "") -> Work:
        """Return the input of the cache and warp models."""
        prefetches = Prefetches(*(getattr(self, each).astype(np.int64) for each in PER_PREFETCH))
        return Work(name or self.structure, self.counters, packed(len(self)), prefetches)

    def model(self, gpu: str = "rtx2080ti", core: Core = BASE) -> Prediction:
        """Predict clocks per ray and rays per second on an RT core. gpu: a name in parameters.GPUS; core: the assumptions."""
        require_known(gpu, GPUS, "GPU", "gpu")
        if not len(self.address):
            raise InputError("the trace has no fetches")
        return predict(self.work(), GPUS[gpu], core)

    def with_prefetches(self, after: ArrayLike, address: ArrayLike, size: ArrayLike) -> Trace:
        """Return the trace with more prefetches, (P,) arrays in any order: index of the fetch that starts each one, first byte, bytes."""
        added = [np.atleast_1d(np.asarray(each, np.int64)) for each in (after, address, size)]
        if len({len(each) for each in added}) > 1:
            raise InputError("must have equal lengths", argument="after, address, size")
        own = (self.prefetch_after, self.prefetch_address, self.prefetch_size)
        both = [np.concatenate(each) for each in zip(own, added, strict=True)]
        order = np.argsort(both[0], kind="stable")
        return replace(self, prefetch_after=both[0][order], prefetch_address=both[1][order], prefetch_size=both[2][order])

    def keep(self, mask: ArrayLike) -> Trace:
        """Return the trace of only some fetches, with their children and prefetches. mask: (M,) bool."""
        rows = np.asarray(mask)
        if rows.shape != self.address.shape or rows.dtype != bool:
            raise InputError(f"has shape {rows.shape} and type {rows.dtype}, and must have a bool for each of {len(self.address)} fetches",
                             argument="mask")
        children = np.repeat(rows, np.diff(self.child_first))
        chosen = {PER_FETCH: rows, PER_CHILD: children, PER_PREFETCH: rows[self.prefetch_after]}
        arrays = {name: getattr(self, name)[each] for names, each in chosen.items() for name in names}
        before, child_before = (np.concatenate([[0], np.cumsum(each)]) for each in (rows, children))
        arrays["prefetch_after"] = before[arrays["prefetch_after"]]
        return replace(self, first=before[self.first], child_first=child_before[self.child_first[np.append(rows, True)]], **arrays)

    def save(self, path: PathLike) -> None:
        """Write the trace to a .npz file, which `load` and np.load read. Raises InputError for another suffix, or if writing fails."""
        if as_path(path, "path").suffix.lower() != ".npz":
            raise InputError("the file of a trace must have the suffix .npz", path=path)
        data = io.BytesIO()
        arrays: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        np.savez_compressed(data, allow_pickle=False, **arrays)
        write_bytes(path, data.getvalue())

    @classmethod
    def load(cls, path: PathLike) -> Trace:
        """Read a trace that `save` wrote. Raises InputError if the file is missing, damaged, or not a trace."""
        require_file(as_path(path, "path"))
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays = {each.name: data[each.name] for each in fields(cls)}
            return cls(**{**arrays, "structure": str(arrays["structure"])})
        except InputError as error:
            raise error.at(path) from error
        except Exception as error:  # zipfile, zlib and NumPy raise many kinds
            raise InputError(f"is not a trace ({type(error).__name__}: {error})", path=path,
                             hint="wrt.trace(...).save(path) writes one") from error


def trace(accel: Accelerator, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Trace:
    """Record every fetch of rays that search their closest hit: what is fetched, tested and found.

    A trace can be saved, changed, and given to the model of caches and warps (docs/rt_core.md, "Traces").

    Parameters
    ----------
    accel : OneMesh
        Structure over one mesh, from `wrt.build`.
    origins, directions, t_min, t_max
        Rays, as in `OneMesh.closest_hit`. Successive blocks of 32 rays are the warps of the model.

    Returns
    -------
    Trace
        About 40 bytes per fetch, and 20 per child that a fetched node has.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    rays, _ = rays_of(np.asarray(origins), np.asarray(directions), t_min, t_max)
    parts = [Rays(*(each[begin : begin + RAYS_AT_ONCE] for each in rays)) for begin in range(0, max(len(rays.origins), 1), RAYS_AT_ONCE)]
    return joined([trace_of(record_steps(accel, *part)) for part in parts])


def joined(parts: list[Trace]) -> Trace:
    """Join traces of the same structure."""
    out: dict[str, Any] = {"structure": parts[0].structure}
    for each in fields(Trace)[1:]:
        arrays = [getattr(part, each.name) for part in parts]
        if each.name in ("first", "child_first"):
            out[each.name] = np.concatenate([[0], np.cumsum(np.concatenate([np.diff(array) for array in arrays]))]).astype(np.int64)
        else:
            out[each.name] = np.concatenate(arrays)
    return Trace(**out)


def trace_of(recorded: RecordedSteps) -> Trace:
    """Make the trace of recorded steps."""
    steps, n = recorded.steps, len(recorded)
    ray = np.repeat(np.arange(n), np.diff(recorded.first))
    kind = steps["kind"]
    fetch = (kind == of.NODE) | (kind == of.TEST)
    rows = np.flatnonzero(fetch)
    last = np.cumsum(fetch) - 1  # the last fetch at or before each step
    owned = (last >= 0) & (ray[rows[np.maximum(last, 0)]] == ray) if len(rows) else np.zeros(len(steps), bool)
    child = ((kind == of.BOX) | (kind == of.PART)) & owned
    test = np.where(kind[rows] == of.TEST, PRIMITIVE, NONE)
    for each, name in ((of.BOX, BOX), (of.PLANE, PLANE), (of.CELL, CELL)):
        test[last[(kind == each) & owned]] = name
    boxes = np.bincount(last[child], minlength=len(rows))
    entered = np.bincount(last[child], steps["result"][child] & of.ENTERED, minlength=len(rows))
    node_size, record = recorded.node_bytes, recorded.primitive_bytes
    address, size = places(steps["index"][rows], np.where(test == PRIMITIVE, 1, of.INNER), node_size, record)
    child_address, child_size = places(steps["index"][child], steps["count"][child], node_size, record)
    first = np.concatenate([[0], np.cumsum(np.bincount(ray[rows], minlength=n))]).astype(np.int64)
    none = np.zeros(0, np.int64)
    return Trace(
        recorded.structure, recorded.origin, recorded.direction, recorded.t, recorded.prim_id, recorded.counts,
        np.bincount(ray[(kind == of.BOX) & ~owned], minlength=n).astype(np.int16), first, address, size,
        recorded.depths()[rows], test.astype(np.int16),
        np.where(test == BOX, boxes, test > NONE).astype(np.int16),
        np.where(test == PRIMITIVE, steps["result"][rows], entered).astype(np.int16),
        np.concatenate([[0], np.cumsum(boxes)]).astype(np.int64), child_address, child_size,
        np.where(steps["result"][child] & of.ENTERED, steps["t"][child], np.float32(np.inf)), none, none, none)


def places(index: np.ndarray, count: np.ndarray, node_size: int, record: int) -> tuple[np.ndarray, np.ndarray]:
    """Return address and size in bytes of nodes (count = INNER) and of runs of `count` primitives."""
    index, inner = index.astype(np.int64), count == of.INNER
    return (np.where(inner, index * node_size, int(PRIMITIVE_SPACE) + index * record),
            np.where(inner, node_size, np.maximum(count, 1).astype(np.int64) * record))
