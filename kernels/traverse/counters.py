"""What a ray costs: the counters of the RT core's units, and the addresses that they fetch.

Compiled in only where `Units.counters` asks for it: without, every function here returns what it got, and the compiler leaves
nothing of it. A traversal unit counts into a local `Counts` and hands it to the structure's `Recorder` when it ends.
"""

from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.common import Units

# Nodes and primitives have address spaces of their own; an entry of the trace is address * 2^12 + size in bytes.
PRIMITIVE_SPACE = wp.constant(wp.int64(1 << 40))
SIZE_RANGE = wp.constant(wp.int64(1 << 12))


@wp.struct
class Counts:
    """Of one or several rays. probes: rays; nodes: fetches of a node (a grid's cell is one); boxes: box tests; box_operations:
    rows of boxes handed to the box unit (plane tests of a k-d or BSP tree count here, one each, with no box); primitives: tests
    of the triangle unit; leaves: those that were entered; pushes, pops; stack: the most entries at a time; node_bytes and
    primitive_bytes: what was fetched, each time it was fetched."""

    probes: int
    nodes: int
    boxes: int
    box_operations: int
    primitives: int
    leaves: int
    pushes: int
    pops: int
    stack: int
    node_bytes: int
    primitive_bytes: int


@wp.struct
class Recorder:
    """counts: one row a Ray.slot; first, fetches: the trace of slot i begins at fetches[first[i]] (length 0: no trace).
    base: added to all addresses: where a structure begins that is one of several."""

    counts: wp.array(dtype=Counts)
    first: wp.array(dtype=wp.int64)
    fetches: wp.array(dtype=wp.int64)
    base: wp.int64


@wp.func
def write_fetch(recorder: Recorder, slot: int, counts: Counts, address: wp.int64, size: int):
    """Append to the trace; `counts` are those before this fetch. The ray alone writes to its part."""
    if recorder.first.shape[0] > 0:
        before = recorder.counts[slot]  # of what the ray met before this structure
        place = recorder.first[slot] + wp.int64(before.nodes + before.primitives + counts.nodes + counts.primitives)
        recorder.fetches[place] = (recorder.base + address) * SIZE_RANGE + wp.int64(size)


@wp.func
def add_counts(recorder: Recorder, slot: int, counts: Counts):
    """Add to the slot's row, where `stack` is the most that any has had."""
    total = recorder.counts[slot]
    total.probes += counts.probes
    total.nodes += counts.nodes
    total.boxes += counts.boxes
    total.box_operations += counts.box_operations
    total.primitives += counts.primitives
    total.leaves += counts.leaves
    total.pushes += counts.pushes
    total.pops += counts.pops
    total.stack = wp.max(total.stack, counts.stack)
    total.node_bytes += counts.node_bytes
    total.primitive_bytes += counts.primitive_bytes
    recorder.counts[slot] = total


def make_counters(units: Units, node_bytes: int) -> Any:
    """fetch_node, fetch_primitive, push: each gives the counts that it got, one step on; and finish. node_bytes: of one node."""
    on = units.counters
    node_size = int(node_bytes)
    primitive_size = size_of(units.triangle_test.record)

    @wp.func
    def fetch_node(recorder: Recorder, ray: Ray, counts: Counts, index: int, boxes: int) -> Counts:
        """Node `index`, and one operation of the box unit on so many boxes."""
        if wp.static(on):
            size = wp.static(node_size)
            write_fetch(recorder, ray.slot, counts, wp.int64(index) * wp.int64(wp.static(node_size)), size)
            counts.nodes += 1
            counts.node_bytes += size
            counts.boxes += boxes
            counts.box_operations += 1
        return counts

    @wp.func
    def fetch_primitive(recorder: Recorder, ray: Ray, counts: Counts, index: int) -> Counts:
        """Record `index` of the primitives, and its test."""
        if wp.static(on):
            size = wp.static(primitive_size)
            write_fetch(recorder, ray.slot, counts, PRIMITIVE_SPACE + wp.int64(index) * wp.int64(wp.static(primitive_size)), size)
            counts.primitives += 1
            counts.primitive_bytes += size
        return counts

    @wp.func
    def push(counts: Counts, size: int) -> Counts:
        """`size`: the entries on the stack after it."""
        if wp.static(on):
            counts.pushes += 1
            counts.stack = wp.max(counts.stack, size)
        return counts

    @wp.func
    def finish(recorder: Recorder, ray: Ray, counts: Counts, best: Hit) -> Hit:
        """The answer to the outside, and the counts to the recorder: a miss has t = inf and prim_id = -1."""
        if wp.static(on):
            if wp.static(not units.instances):  # else the ray is that of the structure over all
                counts.probes += 1
            add_counts(recorder, ray.slot, counts)
        if best.prim_id == NO_HIT:
            best.t = float(wp.inf)
            best.prim_id = -1
        return best

    return fetch_node, fetch_primitive, push, finish
