"""The cost of a ray: counts of fetches and tests, and a trace of the addresses that the traversal fetches.
They are compiled in only with `Units.counters`. Otherwise, every function here returns its argument `counts`, and the compiler removes the
call. A traversal counts in a local `Counts`, and adds it to the structure's `Recorder` at the end."""

from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.steps import NODE, Step, simple_step

# An entry of a trace is address * SIZE_RANGE + size, both in bytes. Nodes have addresses from 0 on, primitives from PRIMITIVE_SPACE on.
PRIMITIVE_SPACE = wp.constant(wp.int64(1 << 40))
SIZE_RANGE = wp.constant(wp.int64(1 << 12))


@wp.struct
class Counts:
    """Counts of one ray or of several rays."""

    probes: int  # Rays.
    nodes: int  # Fetches of a node, or of a grid's cell.
    boxes: int  # Boxes tested.
    box_operations: int  # Operations of the box unit: tests of a node's boxes, or of a plane of a k-d or BSP tree.
    primitives: int  # Primitives fetched and tested.
    leaves: int  # Leaves visited.
    pushes: int
    pops: int
    stack: int  # Largest number of entries on the stack.
    node_bytes: int  # Bytes of all fetched nodes, repeated fetches included.
    primitive_bytes: int  # Bytes of all fetched primitives, repeated fetches included.


@wp.struct
class Recorder:
    """Arrays to which a traversal adds its counts and its traces."""

    counts: wp.array(dtype=Counts)  # Indexed by Ray.slot.
    # The trace of slot i begins at fetches[first[i]]. Length 0: write no traces. With Units.steps: number of the next step of slot i.
    first: wp.array(dtype=wp.int64)
    fetches: wp.array(dtype=wp.int64)
    steps: wp.array(dtype=Step)  # With Units.steps. Length 0: count the steps in `first`, but do not store them.
    base: wp.int64  # Address at which this structure begins, if there are several; added to all addresses.


@wp.func
def write_fetch(recorder: Recorder, slot: int, counts: Counts, address: wp.int64, size: int):
    """Append a fetch of `size` bytes at `address` to the trace of a slot (one ray). `counts` does not yet include this fetch."""
    if recorder.first.shape[0] > 0:
        before = recorder.counts[slot]  # counts of the structures that the ray has left
        place = recorder.first[slot] + wp.int64(before.nodes + before.primitives + counts.nodes + counts.primitives)
        recorder.fetches[place] = (recorder.base + address) * SIZE_RANGE + wp.int64(size)


@wp.func
def write_step(recorder: Recorder, slot: int, step: Step):
    """Append a step to those of a slot."""
    place = recorder.first[slot]
    recorder.first[slot] = place + wp.int64(1)
    if recorder.steps.shape[0] > 0:
        recorder.steps[place] = step


@wp.func
def add_counts(recorder: Recorder, slot: int, counts: Counts):
    """Add `counts` to the recorder's counts of a slot; the entry `stack` becomes the maximum of both."""
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
    """Make fetch_node, fetch_primitive, push and finish. The first three return the new counts. node_bytes: size of a node."""
    on = units.counters
    node_size = int(node_bytes)
    primitive_size = size_of(units.triangle_test.record)

    @wp.func
    def fetch_node(recorder: Recorder, ray: Ray, counts: Counts, index: int, boxes: int) -> Counts:
        """Count the fetch of node `index`, and one operation of the box unit that tests `boxes` boxes."""
        if wp.static(on):
            size = wp.static(node_size)
            if wp.static(units.steps):
                write_step(recorder, ray.slot, simple_step(NODE, index, 0))
            else:
                write_fetch(recorder, ray.slot, counts, wp.int64(index) * wp.int64(wp.static(node_size)), size)
            counts.nodes += 1
            counts.node_bytes += size
            counts.boxes += boxes
            counts.box_operations += 1
        return counts

    @wp.func
    def fetch_primitive(recorder: Recorder, ray: Ray, counts: Counts, index: int) -> Counts:
        """Count the fetch of primitive `index`, which is then tested."""
        if wp.static(on):
            size = wp.static(primitive_size)
            if wp.static(not units.steps):  # recording.py writes the step, which needs the test's result
                write_fetch(recorder, ray.slot, counts, PRIMITIVE_SPACE + wp.int64(index) * wp.int64(wp.static(primitive_size)), size)
            counts.primitives += 1
            counts.primitive_bytes += size
        return counts

    @wp.func
    def push(counts: Counts, size: int) -> Counts:
        """Count a push; `size`: number of stack entries after the push."""
        if wp.static(on):
            counts.pushes += 1
            counts.stack = wp.max(counts.stack, size)
        return counts

    @wp.func
    def finish(recorder: Recorder, ray: Ray, counts: Counts, best: Hit) -> Hit:
        """Add the counts to the recorder, and return the traversal's result; a miss gets t = inf and prim_id = -1."""
        if wp.static(on):
            if wp.static(not units.instances):  # with instances, the upper level counts the ray
                counts.probes += 1
            add_counts(recorder, ray.slot, counts)
        if best.prim_id == NO_HIT:
            best.t = float(wp.inf)
            best.prim_id = -1
        return best

    return fetch_node, fetch_primitive, push, finish
