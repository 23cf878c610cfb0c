"""Variants of the binary BVH's traversal, to count their steps: in any order, without early stop, or with a short stack; same hits.
A short stack overwrites its oldest entries. When the stack is empty, the walk restarts at the root and follows a trail. The trail has one
bit per level of the tree. The bit is set if only the last child of the level remains to be visited. Laine 2010, "Restart Trail for
Stackless BVH Traversal"; Vaidyanathan et al. 2019, "Wide BVH Traversal with a Short Stack"."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces, size_of
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node, Child, box_volumes, child_of, make_binary_traversal, make_struct, step_count
from wrt.kernels.traverse.common import Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import make_observer
from wrt.kernels.traverse.steps import ENTERED

LEVELS = 62  # largest number of levels of a tree for which a trail has bits
TOP = wp.constant(wp.uint64(1 << 63))
NONE = wp.constant(wp.uint64(0))


@wp.func
def child_0_first(entry: wp.vec2) -> bool:
    """Visit the children in the order of the node: an argument `choose` of make_binary_traversal."""
    return False


class Study(NamedTuple):
    """A variant, in place of a structure's traversal module. With a short stack, `choose` and `early` have no effect."""

    entries: int = STACK_SIZE  # Number of stack entries; STACK_SIZE: as many as needed.
    choose: Any = None  # Argument of make_binary_traversal: a function that orders the children. None: nearer child first.
    early: bool = True  # Drop boxes and stack entries behind the best hit.

    def make_struct(self, record: Any) -> Any:
        return make_struct(record)

    def make_traversal(self, units: Units, any_hit: bool, accepts: Any = None) -> Any:
        if self.entries < STACK_SIZE:
            return make_short_stack(units, self.entries, any_hit, accepts)
        volumes = box_volumes(units.triangle_test.record, units.box_test)
        return make_binary_traversal(units, volumes, make_leaf(units, any_hit, accepts), any_hit, self.choose, self.early)


@wp.struct
class Trail:
    """The path from the root to the present node. A level is one bit: TOP for the root, and half the value with each step down."""

    done: wp.uint64  # Mask of the levels where only the last child remains.
    level: wp.uint64  # Level of the present node.
    resumed: wp.uint64  # Level whose last child is next.


@wp.func
def carry(trail: Trail) -> Trail:
    """Move on to the deepest level that has another child. If no level has one, trail.done becomes TOP or more."""
    trail.done = (trail.done & ((~trail.level) + wp.uint64(1))) + trail.level
    trail.resumed = trail.done & ((~trail.done) + wp.uint64(1))
    return trail


def make_short_stack(units: Units, entries: int, any_hit: bool, accepts: Any = None) -> Any:
    """Make the traversal with a stack of `entries` entries, for trees of at most LEVELS levels. With 0 entries, each pop is a restart."""
    probe_of = make_probe(units)
    visit_leaf = make_leaf(units, any_hit, accepts)
    ray_aabb = units.box_test
    observe = make_observer(units, size_of(Bvh2Node))
    struct = make_struct(units.triangle_test.record)
    capacity = max(entries, 1)

    @wp.func
    def traverse(accel: struct, surfaces: Surfaces, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        stack = wp.zeros(shape=wp.static(capacity), dtype=Child)
        stack_t = wp.zeros(shape=wp.static(capacity), dtype=wp.float32)
        top = int(0)  # number of pushes minus number of pops; the newest entry has the index (top - 1) modulo capacity
        size = int(0)
        child = Child()
        trail = Trail()
        trail.level = TOP
        while trail.done < TOP:
            if child.count > 0:
                best = visit_leaf(accel, surfaces, probe, child.first, child.count, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
            else:
                node = accel.nodes[child.first]
                observe.node(accel.recorder, ray, child.first, 2, 1)
                t_0 = ray_aabb(probe.box, node.lo_0, node.hi_0, best.t)
                t_1 = ray_aabb(probe.box, node.lo_1, node.hi_1, best.t)
                if t_0 < wp.inf or t_1 < wp.inf:
                    trail.level = trail.level >> wp.uint64(1)
                    second = t_1 < t_0  # visit child 1 first; for a missed child, t is inf
                    go = bool(True)
                    if t_0 < wp.inf and t_1 < wp.inf:
                        if (trail.done & trail.level) != NONE:
                            second = not second
                        elif wp.static(entries > 0):
                            far = child_of(node, not second)
                            stack[top % wp.static(capacity)] = far
                            stack_t[top % wp.static(capacity)] = wp.where(second, t_0, t_1)
                            top = top + 1
                            size = wp.min(size + 1, wp.static(capacity))
                            observe.push(accel.recorder, ray, far.first, step_count(far.count), wp.where(second, t_0, t_1), size - 1, size)
                    elif trail.level != trail.resumed:
                        trail.done = trail.done | trail.level
                    else:
                        go = bool(False)  # the walk resumes at the last child, but the ray enters only the first one, which is done
                    if go:
                        child = child_of(node, second)
                        continue
            # Pop the newest entry, which belongs to the deepest level that has another child, or restart at the root.
            found = bool(False)
            while not found:
                trail = carry(trail)
                child = Child()
                if size > 0 and trail.done < TOP:
                    size = size - 1
                    top = top - 1
                    trail.level = trail.resumed
                    t = stack_t[top % wp.static(capacity)]
                    found = t <= best.t
                    child = stack[top % wp.static(capacity)]
                    observe.pop(accel.recorder, ray, child.first, step_count(child.count), t, wp.where(found, ENTERED, 0))
                else:
                    trail.level = TOP
                    found = True
        return observe.finish(accel.recorder, ray, best)

    return traverse
