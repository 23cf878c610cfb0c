"""Traversal of the wide BVHs for one ray. Nodes have 4 or 8 children, whose boxes are tested as one row; so are the triangles of a leaf.

Wald, Benthin and Boulos 2008, "Getting Rid of Packets"; Afra and Ernst 2008 and 2010. The test of a row of triangles only rejects triangles
that the watertight unit would reject in float32. The unit itself tests the remaining triangles, so that hits have the same bits as in other
structures. With another triangle test, the unit tests every primitive of a leaf.

The walk visits the nearest child next. It pushes the other entered children, with the nearest of these on top. It drops a popped child that
begins behind the closest hit. Any-hit rays need no order: the last child is next, and the builder puts leaves and large boxes last."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.query import LARGEST
from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of, stack_type
from wrt.kernels.traverse.common import Probe, Units, make_intersect, make_probe, no_hit
from wrt.kernels.traverse.observer import Recorder, make_observer, make_test
from wrt.kernels.traverse.stack import key_of, make_stack, reference_of, t_of
from wrt.kernels.traverse.steps import ENTERED, INNER, box_step
from wrt.kernels.units.triangle import component
from wrt.kernels.wide.lanes import LaneRay, bits, lowest, make_cull, prefetch
from wrt.kernels.wide.layout import HI_X, HI_Y, HI_Z, LO_X, LO_Y, LO_Z, STACK_SIZE, NodeLayout
from wrt.kernels.wide.nodes import far_pad, make_children, make_plane
from wrt.kernels.wide.references import DONE, EMPTY, leaf_count, leaf_first


@cache
def make_struct(record: Any) -> Any:
    """Return the type of a wide BVH whose primitives are stored as `record`.

    A row holds as many primitives as a node has children: the first float of all its records, then the second float, and so on. A leaf
    begins with a new row, and its reference counts rows. With compressed nodes, leaves follow each other without a gap, and references
    count primitives."""

    @wp.struct
    class WideBvh:
        nodes: wp.array(dtype=wp.float32)  # Nodes as in kernels.wide.nodes, the root first.
        primitives: wp.array(dtype=wp.float32)  # Rows of primitives.
        recorder: Recorder

    return WideBvh


def row_size(record: Any, width: int) -> int:
    """Return the number of floats in one row of primitives."""
    return size_of(record) // 4 * width


@wp.func
def lane_ray(probe: Probe, pad: float) -> LaneRay:
    """Set up a ray for the tests of rows; pad: nodes.far_pad."""
    out = LaneRay()
    out.box = probe.box
    out.box.t_min = probe.box.t_min + 0.0  # Turns -0 into 0, because stack entries are sorted by the bits of t.
    out.far_inv_dir = pad * probe.box.inv_dir
    out.near_x = wp.where(probe.box.inv_dir[0] < 0.0, HI_X, LO_X)
    out.near_y = wp.where(probe.box.inv_dir[1] < 0.0, HI_Y, LO_Y)
    out.near_z = wp.where(probe.box.inv_dir[2] < 0.0, HI_Z, LO_Z)
    out.kx = probe.triangle.kx
    out.ky = probe.triangle.ky
    out.kz = probe.triangle.kz
    out.shear_x = probe.triangle.shear_x
    out.shear_y = probe.triangle.shear_y
    origin = probe.ray.origin
    out.origin = wp.vec3(component(origin, out.kx), component(origin, out.ky), component(origin, out.kz))
    return out


@cache
def make_gather(record: Any, width: int) -> Any:
    """Return gather(rows, i), which loads the record whose floats are rows[i], rows[i + width], rows[i + 2 width] and so on."""

    @wp.func_native(f"""
    float numbers[sizeof(out) / sizeof(float)];
    for (unsigned k = 0; k < sizeof(out) / sizeof(float); ++k) numbers[k] = rows.data[(long long)i + {width} * k];
    memcpy(&out, numbers, sizeof(out));
    """)
    def copy_numbers(rows: wp.array(dtype=wp.float32), i: int, out: wp.ref[record]) -> None: ...

    @wp.func
    def gather(rows: wp.array(dtype=wp.float32), i: int) -> record:
        out = record()
        copy_numbers(rows, i, out)
        return out

    return gather


def make_row_test(units: Units, any_hit: bool, accepts: Any, width: int) -> Any:
    """Return test_row, which tests the primitives in the mask of the row at rows[first]; it returns the best hit so far."""
    intersect = make_intersect(units, accepts)
    gather = make_gather(units.triangle_test.record, width)
    cull = make_cull(width)
    culled = units.triangle == "watertight"

    @wp.func
    def test_row(rows: wp.array(dtype=wp.float32), first: int, mask: int, surfaces: Any, probe: Probe, ray: LaneRay,
                 best: Hit) -> Hit:
        if wp.static(culled):
            mask = cull(rows, first, mask, ray)
        while mask != 0:
            best = intersect(probe, surfaces, gather(rows, first + lowest(mask)), best)
            mask = mask & (mask - 1)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    return best
        return best

    return test_row


@cache
def make_prefetch(record: Any, layout: NodeLayout) -> Any:
    """Return prefetch_next(accel, reference), which prefetches the first cache lines of the node or leaf that `reference` points to."""
    struct, lines = make_struct(record), 2

    @wp.func
    def prefetch_next(accel: struct, reference: int):
        if reference >= 0:
            prefetch(accel.nodes, reference * wp.static(layout.size), lines)
        else:
            row = leaf_first(reference) * wp.static(layout.unit) / wp.static(layout.width)
            prefetch(accel.primitives, row * wp.static(row_size(record, layout.width)), lines)

    return prefetch_next


def make_leaf_test(units: Units, any_hit: bool, accepts: Any, layout: NodeLayout) -> Any:
    """Return visit_leaf(accel, surfaces, reference, probe, rows, best) -> best Hit; with any_hit, it stops at the first hit."""
    record, width = units.triangle_test.record, layout.width
    struct, size_of_row = make_struct(record), row_size(record, width)
    observe, test, gather = make_observer(units, 0), make_test(units, accepts), make_gather(record, width)
    test_row = make_row_test(units, any_hit, accepts, width)

    @wp.func
    def visit_leaf(accel: struct, surfaces: Any, reference: int, probe: Probe, rows: LaneRay, best: Hit) -> Hit:
        begin = leaf_first(reference) * wp.static(layout.unit)
        end = begin + leaf_count(reference)
        observe.leaf(accel.recorder, probe.ray, begin, end - begin)
        if wp.static(units.observer == "log"):
            for i in range(begin, end):  # one by one: the test of a row rejects primitives without a result to log
                best = test(accel.recorder, probe, surfaces, gather(accel.primitives, i / width * size_of_row + i % width), i, best)
            return best
        if wp.static(units.observer == "sum"):
            for i in range(begin, end):
                observe.primitive(accel.recorder, probe.ray, i)
        while begin < end:
            row = begin / width
            lane = int(0)
            if wp.static(layout.compressed):
                lane = begin - row * width
            n = wp.min(width - lane, end - begin)
            mask = ((2 << (n - 1)) - 1) << lane
            best = test_row(accel.primitives, row * size_of_row, mask, surfaces, probe, rows, best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    return best
            begin = begin + n
        return best

    return visit_leaf


def make_observed(units: Units, layout: NodeLayout) -> Any:
    """Return observe_node, observe_push and observe_pop: kernels.traverse.observer for nodes and references of wide BVHs."""
    width, struct = layout.width, make_struct(units.triangle_test.record)
    plane, _ = make_plane(width, layout.compressed)
    _, entry = make_children(width, layout.compressed, units.box)
    observe = make_observer(units, 4 * layout.size)

    @wp.func
    def index_of(reference: int) -> int:
        return wp.where(reference < 0, leaf_first(reference) * wp.static(layout.unit), reference)

    @wp.func
    def count_of(reference: int) -> int:
        return wp.where(reference < 0, leaf_count(reference), INNER)

    @wp.func
    def observe_node(accel: struct, ray: Ray, index: int, t: Any, mask: int, rows: LaneRay):
        """Node `index` is fetched, and the boxes of its children are tested; t, mask: the result of the test."""
        if wp.static(units.observer != ""):
            nodes, first, boxes = accel.nodes, index * wp.static(layout.size), int(0)
            for j in range(width):
                boxes += wp.where(bits(nodes, first + wp.static(layout.references) + j) != EMPTY, 1, 0)
            observe.node(accel.recorder, ray, index, boxes, 1)
            if wp.static(units.observer == "log"):
                for j in range(width):
                    reference = bits(nodes, first + wp.static(layout.references) + j)
                    if reference != EMPTY:
                        lo = wp.vec3(plane(nodes, first, LO_X, j), plane(nodes, first, LO_Y, j), plane(nodes, first, LO_Z, j))
                        hi = wp.vec3(plane(nodes, first, HI_X, j), plane(nodes, first, HI_Y, j), plane(nodes, first, HI_Z, j))
                        begin = wp.where((mask >> j) & 1 != 0, entry(t, nodes, first, j, rows), float(wp.inf))
                        observe.step(accel.recorder, ray, box_step(index_of(reference), count_of(reference), lo, hi, begin))

    @wp.func
    def observe_push(recorder: Recorder, ray: Ray, key: wp.uint64, below: int, size: int):
        child = reference_of(key)
        observe.push(recorder, ray, index_of(child), count_of(child), t_of(key), below, size)

    @wp.func
    def observe_pop(recorder: Recorder, ray: Ray, key: wp.uint64, taken: bool):
        child = reference_of(key)
        observe.pop(recorder, ray, index_of(child), count_of(child), t_of(key), wp.where(taken, ENTERED, 0))

    return observe_node, observe_push, observe_pop


def make_traversal(units: Units, any_hit: bool, accepts: Any, layout: NodeLayout) -> Any:
    """Return traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found."""
    struct = make_struct(units.triangle_test.record)
    children, entry = make_children(layout.width, layout.compressed, units.box)
    probe_of, finish = make_probe(units), make_observer(units, 0).finish
    prefetch_next = make_prefetch(units.triangle_test.record, layout)
    observe_node, observe_push, observe_pop = make_observed(units, layout)
    visit_leaf = make_leaf_test(units, any_hit, accepts, layout)
    new_stack, put, get = make_stack(STACK_SIZE, wp.uint64)
    entries = stack_type(wp.uint64)

    @wp.func
    def child(accel: struct, first: int, lane: int) -> int:
        """Load a reference of the node at accel.nodes[first], and prefetch its node or leaf."""
        reference = bits(accel.nodes, first + wp.static(layout.references) + lane)
        prefetch_next(accel, reference)
        return reference

    @wp.func
    def pop(recorder: Recorder, ray: Ray, stack: wp.ref[entries], size: int, best: Hit):
        """Return the next child that begins at or before the closest hit: at the same t, it may have a hit with a lower prim_id."""
        reference = int(DONE)
        while size > 0 and reference == DONE:
            size = size - 1
            key = get(stack, size)
            observe_pop(recorder, ray, key, t_of(key) <= best.t)
            if t_of(key) <= best.t:
                reference = reference_of(key)
        return reference, size

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        rows = lane_ray(probe, wp.static(far_pad(units.box)))
        best = no_hit(ray)
        best.t = wp.where(best.t < LARGEST, best.t, LARGEST)  # Finite, so that the ray enters no box that begins at infinity.
        stack = new_stack()
        size = int(0)
        reference = int(0)
        while reference != DONE:
            while reference >= 0 and reference != DONE:
                first = reference * wp.static(layout.size)
                t, mask = children(accel.nodes, first, rows, best.t)
                observe_node(accel, ray, reference, t, mask, rows)
                if mask != 0:
                    lane, mask = lowest(mask), mask & (mask - 1)
                    near = key_of(entry(t, accel.nodes, first, lane, rows), child(accel, first, lane))
                    begin = size
                    while mask != 0:
                        lane, mask = lowest(mask), mask & (mask - 1)
                        key = key_of(entry(t, accel.nodes, first, lane, rows), child(accel, first, lane))
                        if wp.static(any_hit):
                            observe_push(accel.recorder, ray, near, size, size + 1)
                            put(stack, size, near)
                            near = key
                        else:
                            far = wp.max(near, key)
                            near = wp.min(near, key)
                            # Most nodes push two or three entries, so this does not sort them fully: the nearest pushed so far is on top.
                            below = int(size)
                            if size > begin:
                                under = get(stack, size - 1)
                                below = wp.where(far < under, size, size - 1)
                                put(stack, size, wp.min(far, under))
                                put(stack, size - 1, wp.max(far, under))
                            else:
                                put(stack, size, far)
                            observe_push(accel.recorder, ray, far, below, size + 1)
                        size = size + 1
                    reference = reference_of(near)
                else:
                    reference, size = pop(accel.recorder, ray, stack, size, best)
            if reference != DONE:
                best = visit_leaf(accel, surfaces, reference, probe, rows, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        return finish(accel.recorder, ray, best)
                reference, size = pop(accel.recorder, ray, stack, size, best)
        return finish(accel.recorder, ray, best)

    return traverse


class WideTraversal:
    """The traversal of one node layout, with the functions make_struct and make_traversal like a module of kernels.traverse."""

    def __init__(self, width: int, compressed: bool = False) -> None:
        self.layout = NodeLayout(width, compressed)

    def make_struct(self, record: Any) -> Any:
        return make_struct(record)

    def make_traversal(self, units: Units, any_hit: bool, accepts: Any = None) -> Any:
        return make_traversal(units, any_hit, accepts, self.layout)
