"""Traversal of the binary BVH from front to back, with a stack.
A node holds the bounding volumes of both children, so that one fetch serves two tests. The walk visits the nearer child at once, and pushes
the farther child. It drops a popped node that begins behind the closest hit. The volumes are boxes here, spheres and 14-DOPs in
`bvh2_volumes.py`."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer
from wrt.kernels.traverse.stack import key_of, make_stack, reference_of, t_of
from wrt.kernels.traverse.steps import ENTERED, INNER, Step, box_step
from wrt.kernels.units.box import BoxRay

# Stack entries. Builders keep a tree's depth at or below STACK_SIZE, because the walk pushes at most one node per level.
STACK_SIZE = 64


@wp.struct
class Bvh2Node:
    """Two children. Child k has the box lo_k .. hi_k. It is the inner node first_k (count_k = 0), or a leaf with the count_k primitives
    from index first_k on. A missing child has an empty box (lo = inf, hi = -inf)."""

    lo_0: wp.vec3
    hi_0: wp.vec3
    lo_1: wp.vec3
    hi_1: wp.vec3
    first_0: int
    count_0: int
    first_1: int
    count_1: int


@cache
def make_struct(record: Any, node: Any = Bvh2Node) -> Any:
    """Make the structure's type. nodes[0] is the root; primitives are stored as `record` in the order of the leaves."""

    @wp.struct
    class Bvh2:
        nodes: wp.array(dtype=node)
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Bvh2


@wp.func
def box_of(node: Any, second: bool) -> Step:
    """Make the step of a child with a box; the caller sets the other fields."""
    return box_step(0, 0, wp.where(second, node.lo_1, node.lo_0), wp.where(second, node.hi_1, node.hi_0), 0.0)


class Volumes(NamedTuple):
    """A kind of bounding volume: types and functions for make_binary_traversal."""

    struct: Any  # Type of the structure.
    node: Any  # Type of a node, with first_0, count_0, first_1, count_1 as in Bvh2Node.
    set_up: Any  # Function (accel, probe) -> the ray set up for `enter`.
    enter: Any  # Function (ray, node, t_max) -> vec2, t where the ray enters each child; inf on a miss, never behind a hit inside.
    outline: Any = box_of  # Function (node, second) -> Step with the box around a child, and the radius if it is a sphere.
    root: Any = None  # Function (ray) -> index of the node where the walk begins; None: node 0.


@cache
def box_volumes(record: Any, box_test: Any) -> Volumes:
    """Make the Volumes of boxes; box_test: a function of the table RAY_AABB."""
    struct = make_struct(record)

    @wp.func
    def set_up(accel: struct, probe: Probe) -> BoxRay:
        return probe.box

    @wp.func
    def enter(box: BoxRay, node: Bvh2Node, t_max: float) -> wp.vec2:
        return wp.vec2(box_test(box, node.lo_0, node.hi_0, t_max), box_test(box, node.lo_1, node.hi_1, t_max))

    return Volumes(struct, Bvh2Node, set_up, enter)


@wp.struct
class Child:
    """The inner node `first` (count = 0), or a leaf with the primitives first .. first + count - 1."""

    first: int
    count: int


@wp.func
def child_of(node: Any, second: bool) -> Child:
    child = Child()
    child.first = wp.where(second, node.first_1, node.first_0)
    child.count = wp.where(second, node.count_1, node.count_0)
    return child


@wp.func
def step_count(count: int) -> int:
    """Return Step.count of a child with `count` primitives."""
    return wp.where(count > 0, count, INNER)


def make_observe_node(units: Units, volumes: Volumes) -> Any:
    """Make observe_node(recorder, ray, index, node, entry): node `index` is fetched, and the volumes of its children are tested."""
    outline, observe = volumes.outline, make_observer(units, size_of(volumes.node))

    @wp.func
    def observe_node(recorder: Recorder, ray: Ray, index: int, node: Any, entry: wp.vec2):
        observe.node(recorder, ray, index, 2, 1)
        if wp.static(units.observer == "log"):
            for k in range(2):
                child = child_of(node, k == 1)
                step = outline(node, k == 1)
                step.index = child.first
                step.count = step_count(child.count)
                step.result = wp.where(entry[k] < wp.inf, ENTERED, 0)
                step.t = entry[k]
                observe.step(recorder, ray, step)

    return observe_node


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found; accepts: common.make_better."""
    volumes = box_volumes(units.triangle_test.record, units.box_test)
    return make_binary_traversal(units, volumes, make_leaf(units, any_hit, accepts), any_hit)


def make_binary_traversal(units: Units, volumes: Volumes, visit_leaf: Any, any_hit: bool, choose: Any = None,
                          early: bool = True) -> Any:
    """Make the traversal of a tree with these volumes; visit_leaf: made by kernels.traverse.leaf.make_leaf. Two arguments are for the
    laboratory. choose: function (entry) -> True to visit child 1 first, where `entry` is the result of Volumes.enter; None: visit the
    nearer child first. early: drop nodes that begin behind the best hit."""
    probe_of = make_probe(units)
    struct, set_up, enter, root = volumes.struct, volumes.set_up, volumes.enter, volumes.root
    observe, observe_node = make_observer(units, 0), make_observe_node(units, volumes)
    # A stack entry is a key (entry distance, and inner node or first primitive) and the child's `count`.
    new_keys, put_key, key_at = make_stack(STACK_SIZE, wp.uint64)
    new_counts, put_count, count_at = make_stack(STACK_SIZE, wp.int32)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        prepared = set_up(accel, probe)
        best = no_hit(ray)
        end = best.t
        keys = new_keys()
        sizes = new_counts()
        size = int(0)
        first = int(0)
        if wp.static(root is not None):
            first = root(ray)
        count = int(0)
        while True:
            if count > 0:
                best = visit_leaf(accel, surfaces, probe, first, count, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
                if wp.static(early):
                    end = best.t
            else:
                node = accel.nodes[first]
                entry = enter(prepared, node, end)
                observe_node(accel.recorder, ray, first, node, entry)
                hit_0 = entry[0] < wp.inf
                hit_1 = entry[1] < wp.inf
                if hit_0 or hit_1:
                    second = entry[1] < entry[0]  # child 1 is visited first
                    if wp.static(choose is not None):
                        second = (choose(entry) and hit_1) or not hit_0
                    if hit_0 and hit_1:
                        far = child_of(node, not second)
                        t = wp.where(second, entry[0], entry[1])
                        put_key(keys, size, key_of(t, far.first))
                        put_count(sizes, size, far.count)
                        size = size + 1
                        observe.push(accel.recorder, ray, far.first, step_count(far.count), t, size - 1, size)
                    near = child_of(node, second)
                    first = near.first
                    count = near.count
                    continue
            # Pop the next node that begins at or before the closest hit: at the same t, it may have a hit with a lower prim_id.
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                key = key_at(keys, size)
                found = t_of(key) <= end
                first = reference_of(key)
                count = count_at(sizes, size)
                observe.pop(accel.recorder, ray, first, step_count(count), t_of(key), wp.where(found, ENTERED, 0))
            if not found:
                break
        return observe.finish(accel.recorder, ray, best)

    return traverse
