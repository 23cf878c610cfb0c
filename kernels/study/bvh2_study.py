"""Traversals of the binary BVH as a design would have them, to be counted: without order, without an early stop, or with a stack of
few entries. All give the same hits as the one in use.

A short stack forgets its oldest entries; when it runs out, the walk starts again at the root and follows a trail of one bit a
level: which levels are done but for their last child (Laine 2010, "Restart Trail for Stackless BVH Traversal"; Vaidyanathan et
al. 2019, "Wide BVH Traversal with a Short Stack").
"""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces, size_of
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node, box_volumes, make_binary_traversal, make_struct
from wrt.kernels.traverse.common import Units, make_intersect, make_probe, no_hit
from wrt.kernels.traverse.counters import Counts, make_counters

LEVELS = 62  # of the tree, that a trail has bits for
TOP = wp.constant(wp.uint64(1 << 63))
NONE = wp.constant(wp.uint64(0))


class Study(NamedTuple):
    """entries: of the stack, STACK_SIZE for all that it needs; ordered: the nearer child first; early: boxes and entries beyond
    the best hit are dropped. A short stack needs both. Stands where a structure names its traversal's module."""

    entries: int = STACK_SIZE
    ordered: bool = True
    early: bool = True

    def make_struct(self, record: Any) -> Any:
        return make_struct(record)

    def make_traversal(self, units: Units, any_hit: bool, accepts: Any = None) -> Any:
        if self.entries < STACK_SIZE:
            return make_short_stack(units, self.entries, any_hit, accepts)
        volumes = box_volumes(units.triangle_test.record, units.box_test)
        return make_binary_traversal(units, volumes, any_hit, accepts, self.ordered, self.early)


def make_short_stack(units: Units, entries: int, any_hit: bool, accepts: Any = None) -> Any:
    """The closest hit, or any, with so many entries (0: none, each pop starts again at the root). The tree has LEVELS at most."""
    probe_of = make_probe(units)
    intersect = make_intersect(units, accepts)
    ray_aabb = units.box_test
    fetch_node, fetch_primitive, push, finish = make_counters(units, size_of(Bvh2Node))
    struct = make_struct(units.triangle_test.record)
    room = max(entries, 1)

    @wp.func
    def traverse(accel: struct, surfaces: Surfaces, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        counts = Counts()
        stack_first = wp.zeros(shape=wp.static(room), dtype=wp.int32)
        stack_count = wp.zeros(shape=wp.static(room), dtype=wp.int32)
        stack_t = wp.zeros(shape=wp.static(room), dtype=wp.float32)
        top = int(0)  # entries ever pushed less those popped; the newest is at (top - 1) modulo room
        size = int(0)
        first = int(0)
        count = int(0)
        trail = wp.uint64(0)
        level = TOP  # one bit, lower for each step down
        resumed = wp.uint64(0)  # the level whose last child is to be visited
        while True:
            if count > 0:
                counts.leaves += 1
                for i in range(first, first + count):
                    best = intersect(probe, surfaces, accel.primitives[i], best)
                    counts = fetch_primitive(accel.recorder, ray, counts, i)
                    if wp.static(any_hit):
                        if best.prim_id != NO_HIT:
                            return finish(accel.recorder, ray, counts, best)
            else:
                node = accel.nodes[first]
                counts = fetch_node(accel.recorder, ray, counts, first, 2)
                t_0 = ray_aabb(probe.box, node.lo_0, node.hi_0, best.t)
                t_1 = ray_aabb(probe.box, node.lo_1, node.hi_1, best.t)
                hit_0 = t_0 < wp.inf
                hit_1 = t_1 < wp.inf
                if hit_0 or hit_1:
                    level = level >> wp.uint64(1)
                    second = t_1 < t_0  # which is nearer; a miss is at infinity
                    go = bool(True)
                    if hit_0 and hit_1:
                        if (trail & level) != NONE:
                            second = not second
                        elif wp.static(entries > 0):
                            at = top % wp.static(room)
                            stack_first[at] = wp.where(second, node.first_0, node.first_1)
                            stack_count[at] = wp.where(second, node.count_0, node.count_1)
                            stack_t[at] = wp.where(second, t_0, t_1)
                            top = top + 1
                            size = wp.min(size + 1, wp.static(room))
                            counts = push(counts, size)
                    elif level != resumed:
                        trail = trail | level
                    else:
                        go = bool(False)  # only the first child is left in reach, and that is done
                    if go:
                        first = wp.where(second, node.first_1, node.first_0)
                        count = wp.where(second, node.count_1, node.count_0)
                        continue
            # On to the deepest level that has a child left: carry over those that have none.
            found = bool(False)
            while not found:
                trail = (trail & ((~level) + wp.uint64(1))) + level
                if trail >= TOP:
                    return finish(accel.recorder, ray, counts, best)
                resumed = trail & ((~trail) + wp.uint64(1))
                if size > 0:
                    size = size - 1
                    top = top - 1
                    at = top % wp.static(room)
                    counts.pops += 1
                    level = resumed
                    if stack_t[at] <= best.t:
                        first = stack_first[at]
                        count = stack_count[at]
                        found = True
                else:
                    first = int(0)
                    count = int(0)
                    level = TOP
                    found = True
        return finish(accel.recorder, ray, counts, best)

    return traverse
