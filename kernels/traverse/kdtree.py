"""The traversal unit of the k-d tree: cells front to back, with a stack, and an early stop.

Havran 2000, "Heuristic Ray Shooting Algorithms", appendix C: the part of the ray inside a cell, [t_enter, t_exit], is cut by
the splitting plane; the nearer child is visited at once and the farther one pushed with its own part. Cells do not overlap,
so that the first one with a hit inside is the last one to visit.

No hit is lost to rounding: both parts are widened by what the plane's distance and the hit's own may be off by, in proportion
to the distance; what is off in proportion to the triangle is in the leaves, whose triangles are clipped to larger cells
(kernels.build.clip). A ray in the splitting plane has the distance 0 * inf = NaN there: comparisons that are false for NaN
send it to both sides, whole.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.cell_ray import earlier, later
from wrt.kernels.traverse.common import Units, make_intersect, make_probe, no_hit
from wrt.kernels.traverse.counters import Counts, Recorder, make_counters
from wrt.kernels.units.box import slab_interval

# Every builder keeps the tree's depth at or below this; a path from the root pushes at most one node a level.
STACK_SIZE = 64

# Node.word is 4 * (left child, or first primitive of a leaf) + this or the axis of the plane.
LEAF = wp.constant(3)

HELD_RELATIVE = wp.constant(1.0 + 2.0**-19)
HELD_GRAZING = wp.constant(2.0**-20)


@wp.struct
class KdNode:
    """8 bytes. Inner: split is the plane's coordinate, word = 4 left + axis; the right child is left + 1.
    Leaf: split is the number of primitives, word = 4 first + LEAF."""

    split: float
    word: int


@cache
def make_struct(record: Any) -> Any:
    """The structure over records of this kind: nodes[0] is the root, lo and hi its cell; primitives are in the order of the
    leaves, once in each that they reach into. reach: the largest extent of a triangle that was clipped."""

    @wp.struct
    class KdTree:
        nodes: wp.array(dtype=KdNode)
        lo: wp.vec3
        hi: wp.vec3
        reach: float
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return KdTree


@wp.func
def held_distance(direction: wp.vec3, inv_dir: wp.vec3, reach: float) -> float:
    """How far the triangle unit may move a hit along the ray from where the ray is at the triangle.

    A ray that passes by a triangle within rounding, 16 u of its extent, may be given a hit, with t held to the triangle's box
    (within_bounds). Where the ray leaves the box at a shallow angle, that is a long way from the triangle, and not in the
    leaves around. The distance is 16 u extent / |d| on the axis where |d| is least but not 0, and no more than the box is long.
    """
    longest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    steepest = float(0.0)
    for axis in range(3):
        inverse = wp.abs(inv_dir[axis])
        if inverse < wp.inf:
            steepest = wp.max(steepest, inverse)
    return reach * wp.min(HELD_GRAZING * steepest, 1.01 / longest)


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """The closest hit, or any (the first that is found)."""
    probe_of = make_probe(units)
    intersect = make_intersect(units, accepts)
    ray_aabb = units.box_test
    fetch_node, fetch_primitive, push, finish = make_counters(units, size_of(KdNode))
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        counts = Counts()
        counts.boxes += 1  # the root's cell, which comes with the structure
        counts.box_operations += 1
        if not ray_aabb(probe.box, accel.lo, accel.hi, best.t) < wp.inf:
            return finish(accel.recorder, ray, counts, best)
        held = held_distance(ray.direction, probe.box.inv_dir, accel.reach)
        limit = best.t * HELD_RELATIVE + held  # cells that begin beyond can hold nothing better
        span = slab_interval(probe.box, accel.lo, accel.hi)
        t_enter = earlier(span[0]) - held
        t_exit = later(span[1]) + held
        begin = ray.t_min * (2.0 - HELD_RELATIVE) - held
        t_enter = wp.where(begin > t_enter, begin, t_enter)
        t_exit = wp.where(limit < t_exit, limit, t_exit)
        stack_index = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.int32)
        stack_enter = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.float32)
        stack_exit = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.float32)
        size = int(0)
        index = int(0)
        while True:
            node = accel.nodes[index]
            counts = fetch_node(accel.recorder, ray, counts, index, 0)
            axis = node.word & 3
            first = node.word >> 2
            if axis != LEAF:
                inverse = probe.box.inv_dir[axis]
                t_split = (node.split - probe.box.origin[axis]) * inverse
                swap = inverse < 0.0
                near = wp.where(swap, first + 1, first)
                far = wp.where(swap, first, first + 1)
                near_exit = later(t_split)
                far_enter = earlier(t_split)
                if t_enter > near_exit:
                    index = far
                    t_enter = wp.where(far_enter > t_enter, far_enter, t_enter)
                else:
                    if not t_exit < far_enter:
                        stack_index[size] = far
                        stack_enter[size] = wp.where(far_enter > t_enter, far_enter, t_enter)
                        stack_exit[size] = t_exit
                        size = size + 1
                        counts = push(counts, size)
                    index = near
                    t_exit = wp.where(near_exit < t_exit, near_exit, t_exit)
                continue

            counts.leaves += 1
            counts.box_operations -= 1  # a leaf's record has no plane to test
            for i in range(first, first + int(node.split)):
                best = intersect(probe, surfaces, accel.primitives[i], best)
                counts = fetch_primitive(accel.recorder, ray, counts, i)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        return finish(accel.recorder, ray, counts, best)
            limit = best.t * HELD_RELATIVE + held
            # Pop; what begins beyond the closest hit is dropped. Equal stays: a tie may have a lower prim_id there.
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                counts.pops += 1
                index = stack_index[size]
                t_enter = stack_enter[size]
                t_exit = wp.where(limit < stack_exit[size], limit, stack_exit[size])
                found = t_enter <= t_exit
            if not found:
                break
        return finish(accel.recorder, ray, counts, best)

    return traverse
