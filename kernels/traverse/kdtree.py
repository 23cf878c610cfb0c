"""Traversal of the k-d tree: cells from front to back, with a stack.

Havran 2000, "Heuristic Ray Shooting Algorithms", appendix C. The splitting plane cuts the ray's part inside a cell, [t_enter, t_exit]. The
walk visits the nearer child at once, and pushes the farther child with its part. Cells do not overlap, so the first cell that contains its
hit ends the walk.

Rounding loses no hit. Both parts are widened by the errors of the plane's distance and of the hit's t, which are proportional to the
distance. The builder covers errors proportional to the triangle: it clips triangles to slightly larger cells (kernels.build.clip). If the
ray lies in the splitting plane, the plane's distance is 0 * inf = NaN, and the comparisons below send the whole part to both sides.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, largest, size_of
from wrt.kernels.traverse.cell_ray import earlier, later
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer, write_step
from wrt.kernels.traverse.steps import ENTERED, INNER, part_step, plane_step
from wrt.kernels.units.box import slab_interval

# Stack entries. Builders keep a tree's depth at or below STACK_SIZE, because the walk pushes at most one node per level.
STACK_SIZE = 64
LEAF = wp.constant(3)  # KdNode.word modulo 4 in a leaf

CLAMP_RELATIVE = wp.constant(1.0 + 2.0**-19)
CLAMP_GRAZING = wp.constant(2.0**-20)


@wp.struct
class KdNode:
    """A node of 8 bytes. In an inner node, `split` is the plane's coordinate, word = 4 * left + axis, and the right child is node left + 1.
    In a leaf, `split` is the number of primitives, and word = 4 * first + LEAF, where `first` is the first primitive's index."""

    split: float
    word: int


@cache
def make_struct(record: Any) -> Any:
    """Make the structure's type; nodes[0] is the root, with the cell lo .. hi. Primitives are stored as `record`, in the order of the
    leaves, once for each leaf whose cell they meet."""

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
    """Return a bound on the change of t by clamping to a triangle's box (`within_bounds`); reach: largest extent of a clipped triangle.
    The triangle unit may report a hit for a ray that misses the triangle by 16 u of its extent. After clamping t on a grazing ray, the hit
    may be far from the triangle, outside the leaves that list it. The bound is 16 u reach / |d|, for the direction's smallest component d
    that is not 0. It is at most the length of the ray's part in the box."""
    steepest = float(0.0)
    for axis in range(3):
        inverse = wp.abs(inv_dir[axis])
        if inverse < wp.inf:
            steepest = wp.max(steepest, inverse)
    return reach * wp.min(CLAMP_GRAZING * steepest, 1.01 / largest(direction))


@wp.func
def limit_of(t: float, slack: float) -> float:
    """Return an upper bound of the t where a ray enters a cell that contains a hit at or before t; slack: clamp_slack."""
    return t * CLAMP_RELATIVE + slack


@wp.func
def record_split(recorder: Recorder, ray: Ray, index: int, node: KdNode, t_split: float, part: wp.vec2):
    """Record the test of a node's plane, and both children. part: (t_enter, t_exit) of the ray in the node."""
    axis = node.word & 3
    normal = wp.vec3()
    normal[axis] = 1.0
    plane = plane_step(index, normal, -node.split, t_split)
    write_step(recorder, ray.slot, plane)
    right_is_near = 1.0 / ray.direction[axis] < 0.0
    near = wp.vec2(part[0], wp.where(later(t_split) < part[1], later(t_split), part[1]))
    far = wp.vec2(wp.where(earlier(t_split) > part[0], earlier(t_split), part[0]), part[1])
    for side in range(2):
        is_near = right_is_near == (side == 1)
        met = wp.where(is_near, not part[0] > later(t_split), part[0] > later(t_split) or not part[1] < earlier(t_split))
        write_step(recorder, ray.slot, part_step(plane, side == 1, (node.word >> 2) + side, wp.where(is_near, near, far), met))


def make_walk(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Make walk(accel, surfaces, probe, root_part, slack) -> best Hit. root_part: (t_enter, t_exit) at the root."""
    visit_leaf = make_leaf(units, any_hit, accepts)
    observe = make_observer(units, size_of(KdNode))

    @wp.func
    def walk(accel: Any, surfaces: Any, probe: Probe, root_part: wp.vec2, slack: float) -> Hit:
        best = no_hit(probe.ray)
        part = wp.vec2(root_part)
        stack_index = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.int32)
        stack_part = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.vec2)
        size = int(0)
        index = int(0)
        found = bool(True)
        while found:
            node = accel.nodes[index]
            axis = node.word & 3
            observe.node(accel.recorder, probe.ray, index, 0, wp.where(axis != LEAF, 1, 0))  # a leaf has no plane to test
            first = node.word >> 2
            if axis != LEAF:
                inverse = probe.box.inv_dir[axis]
                t_split = (node.split - probe.box.origin[axis]) * inverse
                far = wp.where(inverse < 0.0, first, first + 1)
                near_exit = later(t_split)
                far_enter = wp.where(earlier(t_split) > part[0], earlier(t_split), part[0])
                if wp.static(units.observer == "log"):
                    record_split(accel.recorder, probe.ray, index, node, t_split, part)
                if part[0] > near_exit:
                    index = far
                    part = wp.vec2(far_enter, part[1])
                else:
                    if not part[1] < earlier(t_split):
                        stack_index[size] = far
                        stack_part[size] = wp.vec2(far_enter, part[1])
                        size = size + 1
                        observe.push(accel.recorder, probe.ray, far, INNER, far_enter, size - 1, size)
                    index = wp.where(inverse < 0.0, first + 1, first)
                    part = wp.vec2(part[0], wp.where(near_exit < part[1], near_exit, part[1]))
                continue
            best = visit_leaf(accel, surfaces, probe, first, int(node.split), best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
            # Pop the next cell that begins at or before the closest hit: at the same t, it may have a hit with a lower prim_id.
            limit = limit_of(best.t, slack)
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                index = stack_index[size]
                part = wp.vec2(stack_part[size][0], wp.where(limit < stack_part[size][1], limit, stack_part[size][1]))
                found = part[0] <= part[1]
                observe.pop(accel.recorder, probe.ray, index, INNER, part[0], wp.where(found, ENTERED, 0))
        return best

    return walk


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found; accepts: common.make_better."""
    probe_of = make_probe(units)
    ray_aabb = units.box_test
    walk = make_walk(units, any_hit, accepts)
    observe = make_observer(units, 0)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        enter = ray_aabb(probe.box, accel.lo, accel.hi, best.t)
        observe.root(accel.recorder, ray, accel.lo, accel.hi, enter)
        if enter < wp.inf:
            slack = clamp_slack(ray.direction, probe.box.inv_dir, accel.reach)
            limit = limit_of(best.t, slack)
            span = slab_interval(probe.box, accel.lo, accel.hi)
            t_enter = earlier(span[0]) - slack
            t_exit = later(span[1]) + slack
            begin = ray.t_min * (2.0 - CLAMP_RELATIVE) - slack
            part = wp.vec2(wp.where(begin > t_enter, begin, t_enter), wp.where(limit < t_exit, limit, t_exit))
            best = walk(accel, surfaces, probe, part, slack)
        return observe.finish(accel.recorder, ray, best)

    return traverse
