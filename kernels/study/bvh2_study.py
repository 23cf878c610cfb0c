"""Traversals of the binary BVH as a design would have them, to be counted: without order, without an early stop, or with a stack of
few entries. All give the same hits as the one in use.

A short stack forgets its oldest entries; when it runs out, the walk starts again at the root and follows a trail of one bit a
level: which levels are done but for their last child (Laine 2010, "Restart Trail for Stackless BVH Traversal"; Vaidyanathan et
al. 2019, "Wide BVH Traversal with a Short Stack").
"""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces, size_of
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node, Child, box_volumes, child_of, make_binary_traversal, make_struct
from wrt.kernels.traverse.common import Units, make_probe, no_hit
from wrt.kernels.traverse.counters import Counts, make_counters
from wrt.kernels.traverse.leaf import make_leaf

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
        return make_binary_traversal(units, volumes, make_leaf(units, any_hit, accepts), any_hit, self.ordered, self.early)


@wp.struct
class Trail:
    """done: which levels are done but for their last child; level: one bit, lower for each step down; resumed: the level whose last
    child is to be visited."""

    done: wp.uint64
    level: wp.uint64
    resumed: wp.uint64


@wp.func
def carry(trail: Trail) -> Trail:
    """On to the deepest level that has a child left, over those that have none; TOP or above: there is none."""
    trail.done = (trail.done & ((~trail.level) + wp.uint64(1))) + trail.level
    trail.resumed = trail.done & ((~trail.done) + wp.uint64(1))
    return trail


def make_short_stack(units: Units, entries: int, any_hit: bool, accepts: Any = None) -> Any:
    """The closest hit, or any, with so many entries (0: none, each pop starts again at the root). The tree has LEVELS at most."""
    probe_of = make_probe(units)
    visit_leaf = make_leaf(units, any_hit, accepts)
    ray_aabb = units.box_test
    fetch_node, _, push, finish = make_counters(units, size_of(Bvh2Node))
    struct = make_struct(units.triangle_test.record)
    room = max(entries, 1)

    @wp.func
    def traverse(accel: struct, surfaces: Surfaces, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        counts = Counts()
        stack = wp.zeros(shape=wp.static(room), dtype=Child)
        stack_t = wp.zeros(shape=wp.static(room), dtype=wp.float32)
        top = int(0)  # entries ever pushed less those popped; the newest is at (top - 1) modulo room
        size = int(0)
        child = Child()
        trail = Trail()
        trail.level = TOP
        while trail.done < TOP:
            if child.count > 0:
                counts.leaves += 1
                best, counts = visit_leaf(accel, surfaces, probe, child.first, child.count, best, counts)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
            else:
                node = accel.nodes[child.first]
                counts = fetch_node(accel.recorder, ray, counts, child.first, 2)
                t_0 = ray_aabb(probe.box, node.lo_0, node.hi_0, best.t)
                t_1 = ray_aabb(probe.box, node.lo_1, node.hi_1, best.t)
                if t_0 < wp.inf or t_1 < wp.inf:
                    trail.level = trail.level >> wp.uint64(1)
                    second = t_1 < t_0  # which is nearer; a miss is at infinity
                    go = bool(True)
                    if t_0 < wp.inf and t_1 < wp.inf:
                        if (trail.done & trail.level) != NONE:
                            second = not second
                        elif wp.static(entries > 0):
                            stack[top % wp.static(room)] = child_of(node, not second)
                            stack_t[top % wp.static(room)] = wp.where(second, t_0, t_1)
                            top = top + 1
                            size = wp.min(size + 1, wp.static(room))
                            counts = push(counts, size)
                    elif trail.level != trail.resumed:
                        trail.done = trail.done | trail.level
                    else:
                        go = bool(False)  # only the first child is left in reach, and that is done
                    if go:
                        child = child_of(node, second)
                        continue
            # The newest entry of the deepest level that has a child left, or from the root again.
            found = bool(False)
            while not found:
                trail = carry(trail)
                child = Child()
                if size > 0 and trail.done < TOP:
                    size = size - 1
                    top = top - 1
                    counts.pops += 1
                    trail.level = trail.resumed
                    found = stack_t[top % wp.static(room)] <= best.t
                    child = stack[top % wp.static(room)]
                else:
                    trail.level = TOP
                    found = True
        return finish(accel.recorder, ray, counts, best)

    return traverse
