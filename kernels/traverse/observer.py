"""The observer of a walk: what a ray fetches, tests, pushes and pops.

| Units.observer | the observer is compiled as |
| --- | --- |
| "" | nothing: its functions are empty, and the compiler removes their calls |
| "sum" | a sum, `Counts` of each ray; with `Recorder.fetches`, it also writes the address of each fetch |
| "log" | a log, which also writes each step (kernels.traverse.steps); not for instances |

A walk calls it in four places: at a node, at a test (`make_test`), at a push, and at a pop. To count something new, add a field to `Counts`
and a line to the function of its place."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.common import Probe, Units, make_intersect
from wrt.kernels.traverse.steps import BEFORE, BEHIND, CLOSEST, INNER, LEAF, MISSED, NODE, POP, PUSH, TEST, Step, box_step, make_step
from wrt.kernels.units.triangle import edge_areas, to_ray_space

# An entry of Recorder.fetches is address * SIZE_RANGE + size, both in bytes. Nodes have addresses from 0 on, primitives from
# PRIMITIVE_SPACE on.
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
    """Arrays to which an observer adds its counts, and in which it writes fetches or steps."""

    counts: wp.array(dtype=Counts)  # Indexed by Ray.slot.
    # "sum": index in `fetches` of the first fetch of slot i; length 0: write no fetches. "log": index of the next step of slot i.
    first: wp.array(dtype=wp.int64)
    fetches: wp.array(dtype=wp.int64)
    steps: wp.array(dtype=Step)  # "log". Length 0: count the steps in `first`, but do not store them.
    base: wp.int64  # Address at which this structure begins, if there are several; added to all addresses.


@wp.func
def write_fetch(recorder: Recorder, slot: int, address: wp.int64, size: int):
    """Append a fetch of `size` bytes at `address` to those of a slot, before the fetch is counted."""
    if recorder.first.shape[0] > 0:
        place = recorder.first[slot] + wp.int64(recorder.counts[slot].nodes + recorder.counts[slot].primitives)
        recorder.fetches[place] = (recorder.base + address) * SIZE_RANGE + wp.int64(size)


@wp.func
def write_step(recorder: Recorder, slot: int, step: Step):
    """Append a step to those of a slot."""
    place = recorder.first[slot]
    recorder.first[slot] = place + wp.int64(1)
    if recorder.steps.shape[0] > 0:
        recorder.steps[place] = step


class Observer(NamedTuple):
    """The functions that a walk calls; `recorder` is the structure's Recorder."""

    node: Any  # (recorder, ray, index, boxes, operations): node `index` is fetched; the box unit tests `boxes` boxes in `operations`.
    step: Any  # (recorder, ray, step): only in a log, such as the test of a child's box.
    root: Any  # (recorder, ray, lo, hi, t): the box of node 0 is tested before the walk; t: entry distance, or inf.
    leaf: Any  # (recorder, ray, first, count): a leaf with these primitives is visited.
    primitive: Any  # (recorder, ray, index): a primitive is fetched; `make_test` calls it.
    push: Any  # (recorder, ray, index, count, t, below, size): a child goes on the stack, above `below` entries; size: entries after it.
    pop: Any  # (recorder, ray, index, count, t, result): a child leaves the stack; result: a mask of steps.ENTERED and steps.STAYS.
    finish: Any  # (recorder, ray, best) -> Hit: count the ray, and return the walk's result; a miss gets t = inf and prim_id = -1.


def make_visits(units: Units, node_bytes: int) -> Any:
    """Return node, root and leaf of an Observer."""
    observed, logged, size = units.observer != "", units.observer == "log", int(node_bytes)

    @wp.func
    def node(recorder: Recorder, ray: Ray, index: int, boxes: int, operations: int):
        if wp.static(logged):
            write_step(recorder, ray.slot, make_step(NODE, index, 0))
        if wp.static(observed):
            slot = ray.slot
            if wp.static(not logged):
                write_fetch(recorder, ray.slot, wp.int64(index) * wp.int64(wp.static(size)), wp.static(size))
            recorder.counts[slot].nodes += 1
            recorder.counts[slot].boxes += boxes
            recorder.counts[slot].box_operations += operations
            recorder.counts[slot].node_bytes += wp.static(size)

    @wp.func
    def root(recorder: Recorder, ray: Ray, lo: wp.vec3, hi: wp.vec3, t: float):
        if wp.static(logged):
            write_step(recorder, ray.slot, box_step(0, INNER, lo, hi, t))
        if wp.static(observed):
            slot = ray.slot
            recorder.counts[slot].boxes += 1
            recorder.counts[slot].box_operations += 1

    @wp.func
    def leaf(recorder: Recorder, ray: Ray, first: int, count: int):
        if wp.static(logged):
            write_step(recorder, ray.slot, make_step(LEAF, first, count))
        if wp.static(observed):
            slot = ray.slot
            recorder.counts[slot].leaves += 1

    return node, root, leaf


def make_primitive(units: Units) -> Any:
    """Return `primitive` of an Observer."""
    observed, logged, size = units.observer != "", units.observer == "log", size_of(units.triangle_test.record)

    @wp.func
    def primitive(recorder: Recorder, ray: Ray, index: int):
        if wp.static(observed):
            slot = ray.slot
            if wp.static(not logged):
                address = PRIMITIVE_SPACE + wp.int64(index) * wp.int64(wp.static(size))
                write_fetch(recorder, ray.slot, address, wp.static(size))
            recorder.counts[slot].primitives += 1
            recorder.counts[slot].primitive_bytes += wp.static(size)

    return primitive


def make_stack_steps(units: Units) -> Any:
    """Return push and pop of an Observer."""
    observed, logged = units.observer != "", units.observer == "log"

    @wp.func
    def push(recorder: Recorder, ray: Ray, index: int, count: int, t: float, below: int, size: int):
        if wp.static(logged):
            step = make_step(PUSH, index, count)
            step.t = t
            step.prim_id = below
            write_step(recorder, ray.slot, step)
        if wp.static(observed):
            slot = ray.slot
            recorder.counts[slot].pushes += 1
            recorder.counts[slot].stack = wp.max(recorder.counts[slot].stack, size)

    @wp.func
    def pop(recorder: Recorder, ray: Ray, index: int, count: int, t: float, result: int):
        if wp.static(logged):
            step = make_step(POP, index, count)
            step.t = t
            step.result = result
            write_step(recorder, ray.slot, step)
        if wp.static(observed):
            slot = ray.slot
            recorder.counts[slot].pops += 1

    return push, pop


def make_observer(units: Units, node_bytes: int) -> Observer:
    """Return the observer of a walk through nodes of `node_bytes` bytes. Steps name a child by `index` and `count` (steps.py)."""

    @wp.func
    def step(recorder: Recorder, ray: Ray, step: Step):
        if wp.static(units.observer == "log"):
            write_step(recorder, ray.slot, step)

    @wp.func
    def finish(recorder: Recorder, ray: Ray, best: Hit) -> Hit:
        if wp.static(units.observer != "" and not units.instances):  # with instances, the upper level counts the ray
            slot = ray.slot
            recorder.counts[slot].probes += 1
        if best.prim_id == NO_HIT:
            best.t = float(wp.inf)
            best.prim_id = -1
        return best

    node, root, leaf = make_visits(units, node_bytes)
    push, pop = make_stack_steps(units)
    return Observer(node, step, root, leaf, make_primitive(units), push, pop, finish)


def make_test(units: Units, accepts: Any = None) -> Any:
    """Return test(recorder, probe, surfaces, primitive, index, best) -> Hit, which tests the primitive at `index` and returns the better
    hit, as common.make_intersect does, and observes the test."""
    intersect = make_intersect(units, accepts)
    count_primitive = make_primitive(units)
    record = units.triangle_test.record

    @wp.func
    def edges_of(probe: Probe, surfaces: Any, primitive: record) -> wp.vec3d:
        if wp.static(units.triangle_test.uses_shear):
            if primitive.prim_id < surfaces.n_triangles:
                origin = probe.ray.origin
                return edge_areas(wp.vec3d(to_ray_space(primitive.v0 - origin, probe.triangle)),
                                  wp.vec3d(to_ray_space(primitive.v1 - origin, probe.triangle)),
                                  wp.vec3d(to_ray_space(primitive.v2 - origin, probe.triangle)))
        none = wp.float64(wp.nan)
        return wp.vec3d(none, none, none)

    @wp.func
    def log_test(recorder: Recorder, probe: Probe, surfaces: Any, primitive: record, index: int, after: Hit):
        """Write the step of a test. Its hit is that of the whole line. after: the best hit after the test."""
        nothing = Hit()
        nothing.t = float(wp.inf)
        nothing.prim_id = NO_HIT
        line = probe
        line.ray.t_min = float(-wp.inf)
        hit = intersect(line, surfaces, primitive, nothing)
        step = make_step(TEST, index, 1)
        step.prim_id = primitive.prim_id
        if hit.prim_id == NO_HIT:
            step.result = MISSED
        else:
            step.result = wp.where(hit.t < probe.ray.t_min, BEFORE, wp.where(after.prim_id == hit.prim_id, CLOSEST, BEHIND))
        step.t = hit.t
        step.u = hit.u
        step.v = hit.v
        step.edges = edges_of(probe, surfaces, primitive)
        write_step(recorder, probe.ray.slot, step)

    @wp.func
    def test(recorder: Recorder, probe: Probe, surfaces: Any, primitive: record, index: int, best: Hit) -> Hit:
        after = intersect(probe, surfaces, primitive, best)
        if wp.static(units.observer == "log"):
            log_test(recorder, probe, surfaces, primitive, index, after)
        count_primitive(recorder, probe.ray, index)
        return after

    return test
