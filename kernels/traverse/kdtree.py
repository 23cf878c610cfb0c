"""The traversal unit of the k-d tree: cells from front to back, with a stack.

Havran 2000, "Heuristic Ray Shooting Algorithms", appendix C. The splitting plane cuts the part of the ray inside a cell, [t_enter,
t_exit]. The walk visits the nearer child at once and pushes the farther one with its part. Cells do not overlap: the first cell with a hit
inside ends the walk.

Rounding loses no hit. Both parts are widened by the error of the plane's distance and of the hit's t, which are proportional to the
distance. Errors proportional to the triangle are in the leaves: their triangles are clipped to larger cells (kernels.build.clip). A ray in
the splitting plane has the distance 0 * inf = NaN, and comparisons that are false for NaN send it whole to both sides.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.cell_ray import earlier, later
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.counters import Counts, Recorder, make_counters
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.units.box import slab_interval

# Builders keep the depth at or below this; a path from the root pushes at most one node a level.
STACK_SIZE = 64

# KdNode.word is 4 * (left child, or first primitive of a leaf) + LEAF, or + the axis of the plane.
LEAF = wp.constant(3)

CLAMP_RELATIVE = wp.constant(1.0 + 2.0**-19)
CLAMP_GRAZING = wp.constant(2.0**-20)


@wp.struct
class KdNode:
    """An inner node: split is the plane's coordinate, word = 4 left + axis, and the right child is left + 1. 8 bytes.
    A leaf: split is the number of primitives, word = 4 first + LEAF."""

    split: float
    word: int


@cache
def make_struct(record: Any) -> Any:
    """Make the structure over records of this kind; nodes[0] is the root, with the cell lo, hi. Primitives are in the order of the leaves,
    once in each leaf that they reach into."""

    @wp.struct
    class KdTree:
        nodes: wp.array(dtype=KdNode)
        lo: wp.vec3
        hi: wp.vec3
        reach: float  # Largest extent of a clipped triangle.
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return KdTree


@wp.func
def clamp_slack(direction: wp.vec3, inv_dir: wp.vec3, reach: float) -> float:
    """Distance by which the clamp to a triangle's box may move a hit along the ray.
    A ray that misses a triangle by rounding, 16 u of its extent, may still hit, with t clamped to the triangle's box (`within_bounds`). A
    ray that leaves the box at a shallow angle is then far from the triangle, outside the leaves around it. The distance is 16 u extent /
    |d|, for the axis with the smallest |d| that is not 0, and at most the length of the box."""
    longest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    steepest = float(0.0)
    for axis in range(3):
        inverse = wp.abs(inv_dir[axis])
        if inverse < wp.inf:
            steepest = wp.max(steepest, inverse)
    return reach * wp.min(CLAMP_GRAZING * steepest, 1.01 / longest)


@wp.func
def limit_of(t: float, slack: float) -> float:
    """Limit behind which no cell begins that holds a hit nearer than t."""
    return t * CLAMP_RELATIVE + slack


def make_walk(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Make walk(accel, surfaces, probe, part, slack, counts) -> best hit, counts; part: of the ray, (t_enter, t_exit)."""
    visit_leaf = make_leaf(units, any_hit, accepts)
    fetch_node, _, push, _ = make_counters(units, size_of(KdNode))

    @wp.func
    def walk(accel: Any, surfaces: Any, probe: Probe, part: wp.vec2, slack: float, counts: Counts):
        best = no_hit(probe.ray)
        t_enter = part[0]
        t_exit = part[1]
        stack_index = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.int32)
        stack_enter = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.float32)
        stack_exit = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.float32)
        size = int(0)
        index = int(0)
        found = bool(True)
        while found:
            node = accel.nodes[index]
            counts = fetch_node(accel.recorder, probe.ray, counts, index, 0)
            axis = node.word & 3
            first = node.word >> 2
            if axis != LEAF:
                inverse = probe.box.inv_dir[axis]
                t_split = (node.split - probe.box.origin[axis]) * inverse
                far = wp.where(inverse < 0.0, first, first + 1)
                near_exit = later(t_split)
                far_enter = wp.where(earlier(t_split) > t_enter, earlier(t_split), t_enter)
                if t_enter > near_exit:
                    index = far
                    t_enter = far_enter
                else:
                    if not t_exit < earlier(t_split):
                        stack_index[size] = far
                        stack_enter[size] = far_enter
                        stack_exit[size] = t_exit
                        size = size + 1
                        counts = push(counts, size)
                    index = wp.where(inverse < 0.0, first + 1, first)
                    t_exit = wp.where(near_exit < t_exit, near_exit, t_exit)
                continue

            counts.leaves += 1
            counts.box_operations -= 1  # a leaf has no plane to test
            best, counts = visit_leaf(accel, surfaces, probe, first, int(node.split), best, counts)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
            # Pop the next cell that does not begin beyond the closest hit. Equal t stays: a tie may have a lower prim_id there.
            limit = limit_of(best.t, slack)
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                counts.pops += 1
                index = stack_index[size]
                t_enter = stack_enter[size]
                t_exit = wp.where(limit < stack_exit[size], limit, stack_exit[size])
                found = t_enter <= t_exit
        return best, counts

    return walk


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make the unit for the closest hit, or for any hit."""
    probe_of = make_probe(units)
    ray_aabb = units.box_test
    walk = make_walk(units, any_hit, accepts)
    _, _, _, finish = make_counters(units, 0)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        counts = Counts()
        counts.boxes += 1  # the root's cell is part of the structure
        counts.box_operations += 1
        if ray_aabb(probe.box, accel.lo, accel.hi, best.t) < wp.inf:
            slack = clamp_slack(ray.direction, probe.box.inv_dir, accel.reach)
            limit = limit_of(best.t, slack)
            span = slab_interval(probe.box, accel.lo, accel.hi)
            t_enter = earlier(span[0]) - slack
            t_exit = later(span[1]) + slack
            begin = ray.t_min * (2.0 - CLAMP_RELATIVE) - slack
            part = wp.vec2(wp.where(begin > t_enter, begin, t_enter), wp.where(limit < t_exit, limit, t_exit))
            best, counts = walk(accel, surfaces, probe, part, slack, counts)
        return finish(accel.recorder, ray, counts, best)

    return traverse
