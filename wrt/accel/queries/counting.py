"""Queries that count the nodes and primitives of each ray, and can record every fetch or every step."""

import numpy as np
import warp as wp

from wrt.accel.queries.answers import Counters
from wrt.accel.queries.batches import Query, trace_query
from wrt.accel.snapshot import Snapshot
from wrt.core.device import on_host, upload
from wrt.core.types import WarpStruct
from wrt.core.warp_private import refuse_capture
from wrt.kernels.traverse.counters import SIZE_RANGE, Counts
from wrt.kernels.traverse.steps import Step


def counted(snapshot: Snapshot, query: Query, fetches_too: bool) -> Counters:
    """Trace the query and count its costs. fetches_too: record each fetch in a second run, after a first run that counts fetches."""
    n, device = len(query.out[0]), snapshot.device
    refuse_capture(device)

    def run(first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # A copy of the struct, because each call needs arrays of its own.
        own = copied(snapshot.data)
        own.recorder.counts = wp.zeros(n, dtype=Counts, device=device)
        own.recorder.first = upload(first, wp.int64, device)
        own.recorder.fetches = wp.zeros(int(first[-1]) if len(first) else 0, dtype=wp.int64, device=device)
        trace_query(snapshot.counting(own), query)
        return on_host(own.recorder.counts), on_host(own.recorder.fetches)

    counts, fetches = run(np.zeros(0, np.int64))
    first = np.zeros(n + 1, np.int64)
    if fetches_too:
        np.cumsum(counts["nodes"].astype(np.int64) + counts["primitives"], out=first[1:])
        counts, fetches = run(first)
    return Counters(counts, first, fetches // int(SIZE_RANGE), fetches % int(SIZE_RANGE))


def recorded(snapshot: Snapshot, query: Query) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trace the query and record each step; structures over one mesh only.

    Return the counts (N,), `first` (N + 1,) int64, and steps (M,), records of kernels.traverse.steps.Step: ray i has the steps
    first[i] .. first[i + 1] - 1. A first run counts the steps.
    """
    n, device = len(query.out[0]), snapshot.device

    def run(next_step: np.ndarray, length: int) -> WarpStruct:
        own = copied(snapshot.data)
        own.recorder.counts = wp.zeros(n, dtype=Counts, device=device)
        own.recorder.first = upload(next_step, wp.int64, device)
        own.recorder.steps = wp.zeros(length, dtype=Step, device=device)
        trace_query(snapshot.counting(own, steps=True), query)
        return own.recorder

    first = np.zeros(n + 1, np.int64)
    np.cumsum(on_host(run(np.zeros(n, np.int64), 0).first), out=first[1:])
    written = run(first[:-1].copy(), int(first[-1]))
    return on_host(written.counts), first, on_host(written.steps)


def copied(data: WarpStruct) -> WarpStruct:
    """Copy a Warp struct but not its arrays, so that fields of the copy can be set."""
    out = type(data)()
    out.assign(data)
    return out
