"""The cost of a ray: counters of the RT core's units, and the addresses that they fetch.
They are compiled in only with `Units.counters`. Without it, every function here returns its argument, and the compiler removes the call. A
traversal unit counts into a local `Counts`, and adds it to the structure's `Recorder` at its end."""

from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.common import Units

# Nodes and primitives have separate address spaces; an entry of the trace is address * 2^12 + size in bytes.
PRIMITIVE_SPACE = wp.constant(wp.int64(1 << 40))
SIZE_RANGE = wp.constant(wp.int64(1 << 12))


@wp.struct
class Counts:
    """Counts of one or several rays."""

    probes: int  # Rays.
    nodes: int  # Fetches of a node, or of a grid's cell.
    boxes: int  # Box tests.
    box_operations: int  # Operations of the box unit: rows of boxes, or plane tests of a k-d or BSP tree.
    primitives: int  # Tests of the triangle unit.
    leaves: int  # Leaves entered.
    pushes: int
    pops: int
    stack: int  # Most entries at a time.
    node_bytes: int  # Bytes fetched, with repetitions.
    primitive_bytes: int  # Bytes fetched, with repetitions.


@wp.struct
class Recorder:
    """Where counts and traces go."""

    counts: wp.array(dtype=Counts)  # By Ray.slot.
    first: wp.array(dtype=wp.int64)  # The trace of slot i begins at fetches[first[i]]; length 0: no traces.
    fetches: wp.array(dtype=wp.int64)
    base: wp.int64  # Added to all addresses: where this of several structures begins.


@wp.func
def write_fetch(recorder: Recorder, slot: int, counts: Counts, address: wp.int64, size: int):
    """Append a fetch to the ray's trace; `counts`: those before this fetch. No other ray writes to that trace."""
    if recorder.first.shape[0] > 0:
        before = recorder.counts[slot]  # fetches in structures before this one
        place = recorder.first[slot] + wp.int64(before.nodes + before.primitives + counts.nodes + counts.primitives)
        recorder.fetches[place] = (recorder.base + address) * SIZE_RANGE + wp.int64(size)


@wp.func
def add_counts(recorder: Recorder, slot: int, counts: Counts):
    """Add to the slot's counts; `stack` keeps the maximum."""
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
    """Make fetch_node, fetch_primitive, push (each returns the next counts) and finish; node_bytes: of one node."""
    on = units.counters
    node_size = int(node_bytes)
    primitive_size = size_of(units.triangle_test.record)

    @wp.func
    def fetch_node(recorder: Recorder, ray: Ray, counts: Counts, index: int, boxes: int) -> Counts:
        """Count the fetch of node `index`, and one operation of the box unit on `boxes` boxes."""
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
        """Count the fetch of primitive `index`, and its test."""
        if wp.static(on):
            size = wp.static(primitive_size)
            write_fetch(recorder, ray.slot, counts, PRIMITIVE_SPACE + wp.int64(index) * wp.int64(wp.static(primitive_size)), size)
            counts.primitives += 1
            counts.primitive_bytes += size
        return counts

    @wp.func
    def push(counts: Counts, size: int) -> Counts:
        """Count a push; `size`: entries on the stack after it."""
        if wp.static(on):
            counts.pushes += 1
            counts.stack = wp.max(counts.stack, size)
        return counts

    @wp.func
    def finish(recorder: Recorder, ray: Ray, counts: Counts, best: Hit) -> Hit:
        """Hand the counts to the recorder, and return the answer: a miss has t = inf and prim_id = -1."""
        if wp.static(on):
            if wp.static(not units.instances):  # with instances, the level above counts the ray
                counts.probes += 1
            add_counts(recorder, ray.slot, counts)
        if best.prim_id == NO_HIT:
            best.t = float(wp.inf)
            best.prim_id = -1
        return best

    return fetch_node, fetch_primitive, push, finish
