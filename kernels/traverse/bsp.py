"""Traversal of the BSP tree: its planes have any orientation, and its cells are visited from front to back.

Ize, Wald and Parker 2008, "Ray Tracing with the BSP Tree". A plane across an axis takes only one subtraction and one multiplication, as
in a k-d tree.

**Why no hit is lost.** u = 2^-24; lengths are measured along an axis. Let X be a primitive of extent E with a hit. Its test computes t',
and clamping to X's box (`within_bounds`) changes t' to t. Let P = origin + t' direction and D = |t'| max|direction|.

1. P is within 8 u (D + E) of a point Q of X. The unit computes t' as a weighted mean of the corners' distances. Products and areas are
   exact in float64, so the weights are convex within 2^-50. The shear moves the corners by at most 7 u (D + E), and rounding t' adds u D.
   For spheres the distance is smaller.
2. |t - t'| <= reach := 2^-19 D_box / min|direction_i|, over the components that are not 0. D_box is the longest distance along an axis from
   the origin to the root box, so D <= D_box and E <= 2 D_box. P is within 24 u D_box of X's box, and the slab distances have errors of
   3 u D_box. Clamping moves t' at most to the box's plane that P lies beyond, and 27 u < 2^-19 = 32 u.
3. For a ray nearly along an axis, a second bound is smaller. Let m be the direction's longest component. The slab of X's padded box across
   m contains t' within 24 u D_box, and t within 3 u D_box and FAR_PAD's 14 u. So reach <= (E_padded + 2^-18 D_box) / |direction_m|. The
   walk uses the smaller of both bounds, with the largest E_padded of all primitives. Its segment extends by `reach` before t_min and behind
   the best hit, and is clipped to the root box grown by 2^-19 D_box.
4. The builder clips X to the cell. It lists X on a side of the plane if Q is on that side. It also does if Q is beyond the plane by at most
   the builder's share of node.tolerance (`plane_tolerance`). The value plane(P) differs from plane(Q) by |n|_1 8 u (D + E). The computed
   value differs from plane(P) by 4 u (sum |n_i Q_i| + |d|) + 7 u |n|_1 D (dot products) + 3 u |n|_1 D (distances). The terms without D
   are in node.tolerance. The other terms sum to 18 u |n|_1 D <= 31.2 u D. The walk uses 2^-19 D, with the largest D of the ray's part in
   this cell.

So each plane becomes a slab of this half thickness. The walk visits a child if the ray is on the child's side or in the slab. Then t' is in
the ray's interval of a leaf that lists X. The leaf is visited unless it begins more than `reach` behind the best hit. For a ray parallel to
the plane, the divisor is 0 or tiny: its distances lie outside the interval or are NaN, and the walk visits one child or both.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, largest, size_of
from wrt.kernels.traverse.bvh2 import Child, child_of
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer, write_step
from wrt.kernels.traverse.steps import ENTERED, cell_step, part_step, plane_step
from wrt.kernels.units.box import BoxRay, slab_interval

# Stack entries. Builders keep a tree's depth at or below STACK_SIZE, because the walk pushes at most one child per level.
STACK_SIZE = 64
REACH = wp.constant(2.0**-19)
SMALLEST = wp.constant(2.0**-120)  # Added to margins: larger than any error by underflow in the proof.
PLANE = 3  # Value of BspNode.axis for a plane that is not at right angles to an axis.
INNER = -1  # Value of `count` for a child that is an inner node.


@wp.struct
class BspNode:
    """The plane dot(normal, p) + offset = 0 and its two children: 0 below the plane (negative values), 1 above it.
    Child k is the inner node first_k (count_k = INNER), or a leaf with the count_k >= 0 primitives from index first_k on."""

    normal: wp.vec3
    offset: float
    tolerance: float  # Half of the plane's thickness, without the part proportional to the ray's distance.
    axis: int  # 0, 1, 2: the plane is p[axis] + offset = 0; PLANE: the plane has any orientation.
    first_0: int
    count_0: int
    first_1: int
    count_1: int


@wp.struct
class Reach:
    """The part of a ray that the walk follows, and two tolerances that keep rounding from losing a hit."""

    t_0: float  # t where the part begins.
    t_1: float  # t where the part ends.
    beyond: float  # Upper bound on the error of a hit's t. The walk visits cells that begin up to this far behind the best hit.
    drift: float  # A plane counts as a slab of half thickness BspNode.tolerance + drift * |t|, with the largest |t| in the node.


@wp.func
def reach_of(box: BoxRay, ray: Ray, t_max: float, lo: wp.vec3, hi: wp.vec3, extent: float) -> Reach:
    """Return the part of the ray to follow, by steps 2 and 3 of the proof; lo, hi: root box. If the ray misses it, t_0 <= t_1 is False."""
    grow = REACH * wp.max(largest(lo - ray.origin), largest(hi - ray.origin)) + SMALLEST
    margin = wp.vec3(grow, grow, grow)
    interval = slab_interval(box, lo - margin, hi + margin)
    size = wp.abs(ray.direction)
    smallest = float(wp.inf)
    for axis in range(3):
        smallest = wp.where(size[axis] > 0.0, wp.min(smallest, size[axis]), smallest)
    longest = largest(ray.direction)
    out = Reach()
    out.beyond = wp.min(grow / smallest, (extent + 2.0 * grow) / longest)
    out.drift = REACH * longest
    out.t_0 = wp.max(interval[0], ray.t_min - out.beyond)
    out.t_1 = wp.min(interval[1], t_max + out.beyond)
    return out


@cache
def make_struct(record: Any) -> Any:
    """Make the structure's type, for primitives stored as `record`. The root is a child as in BspNode, with `first` and `count`."""

    @wp.struct
    class Bsp:
        lo: wp.vec3  # lo, hi: the root box.
        hi: wp.vec3
        extent: float  # Longest side of a primitive's padded box.
        first: int
        count: int
        nodes: wp.array(dtype=BspNode)
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Bsp


@wp.struct
class Sides:
    """The children of a node, ordered along a ray."""

    near: Child
    far: Child
    meets_near: bool  # True if the ray meets the nearer child, and that child is not an empty leaf.
    meets_far: bool
    near_t_1: float  # Latest t at which the ray leaves the nearer child.
    far_t_0: float  # Earliest t at which the ray enters the farther child.


@wp.func
def cut_by_plane(node: BspNode, box: BoxRay, direction: wp.vec3, part: wp.vec2, drift: float) -> Sides:
    """Order a node's children along a ray, and cut the ray's part (t_0, t_1) at the node's plane; drift: Reach.drift."""
    # `height` is the origin's distance below the plane, `inv` 1 / (normal . direction).
    height = float(0.0)
    inv = float(0.0)
    if node.axis < wp.static(PLANE):
        height = -node.offset - box.origin[node.axis]
        inv = box.inv_dir[node.axis]
    else:
        height = -(wp.dot(node.normal, box.origin) + node.offset)
        inv = 1.0 / wp.dot(node.normal, direction)
    thick = node.tolerance + drift * wp.max(-part[0], part[1])
    up = not inv < 0.0
    slab = wp.where(up, thick, -thick)
    near_end = (height + slab) * inv
    far_begin = (height - slab) * inv
    out = Sides()
    out.near = child_of(node, not up)
    out.far = child_of(node, up)
    # Comparisons with NaN are false: the child is visited.
    out.meets_near = out.near.count != 0 and not (part[0] > near_end)
    out.meets_far = out.far.count != 0 and not (far_begin > part[1])
    out.near_t_1 = wp.where(near_end < part[1], near_end, part[1])
    out.far_t_0 = wp.where(far_begin > part[0], far_begin, part[0])
    return out


@wp.func
def record_sides(recorder: Recorder, ray: Ray, index: int, node: BspNode, sides: Sides, part: wp.vec2):
    """Record the test of a node's plane, and its children. part: the part (t_0, t_1) of the ray in the node."""
    normal = node.normal
    if node.axis < wp.static(PLANE):
        normal = wp.vec3()
        normal[node.axis] = 1.0
    t = -(wp.dot(normal, ray.origin) + node.offset) / wp.dot(normal, ray.direction)
    plane = plane_step(index, normal, node.offset, t)
    write_step(recorder, ray.slot, plane)
    near_is_below = sides.near.first == node.first_0 and sides.near.count == node.count_0
    near = part_step(plane, not near_is_below, sides.near.first, wp.vec2(part[0], sides.near_t_1), sides.meets_near)
    near.count = sides.near.count
    far = part_step(plane, near_is_below, sides.far.first, wp.vec2(sides.far_t_0, part[1]), sides.meets_far)
    far.count = sides.far.count
    write_step(recorder, ray.slot, near)
    write_step(recorder, ray.slot, far)


def make_walk(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Make walk(accel, surfaces, probe, reach) -> best Hit, which visits the cells along the ray's part `reach`."""
    visit_leaf = make_leaf(units, any_hit, accepts)
    observe = make_observer(units, size_of(BspNode))

    @wp.func
    def walk(accel: Any, surfaces: Any, probe: Probe, reach: Reach) -> Hit:
        best = no_hit(probe.ray)
        stack_first = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.int32)
        stack_count = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.int32)
        stack_part = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.vec2)
        size = int(0)
        first = int(accel.first)
        count = int(accel.count)
        part = wp.vec2(reach.t_0, reach.t_1)
        found = part[0] <= part[1]
        while found:
            if count >= 0:
                best = visit_leaf(accel, surfaces, probe, first, count, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
            else:
                observe.node(accel.recorder, probe.ray, first, 0, 1)
                sides = cut_by_plane(accel.nodes[first], probe.box, probe.ray.direction, part, reach.drift)
                if wp.static(units.observer == "log"):
                    record_sides(accel.recorder, probe.ray, first, accel.nodes[first], sides, part)
                if sides.meets_near:
                    if sides.meets_far:
                        stack_first[size] = sides.far.first
                        stack_count[size] = sides.far.count
                        stack_part[size] = wp.vec2(sides.far_t_0, part[1])
                        size = size + 1
                        observe.push(accel.recorder, probe.ray, sides.far.first, sides.far.count, sides.far_t_0, size - 1, size)
                    first = sides.near.first
                    count = sides.near.count
                    part = wp.vec2(part[0], sides.near_t_1)
                    continue
                if sides.meets_far:
                    first = sides.far.first
                    count = sides.far.count
                    part = wp.vec2(sides.far_t_0, part[1])
                    continue
            # Pop the next child that begins at most reach.beyond behind the best hit.
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                first = stack_first[size]
                count = stack_count[size]
                part = wp.vec2(stack_part[size][0], wp.min(stack_part[size][1], best.t + reach.beyond))
                found = part[0] <= best.t + reach.beyond
                observe.pop(accel.recorder, probe.ray, first, count, part[0], wp.where(found, ENTERED, 0))
        return best

    return walk


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found. Units.box has no effect."""
    probe_of = make_probe(units)
    walk = make_walk(units, any_hit, accepts)
    observe = make_observer(units, 0)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        reach = reach_of(probe.box, ray, no_hit(ray).t, accel.lo, accel.hi, accel.extent)
        observe.step(accel.recorder, ray, cell_step(accel.first, accel.count, accel.lo, accel.hi, reach.t_0, reach.t_1))
        best = walk(accel, surfaces, probe, reach)
        return observe.finish(accel.recorder, ray, best)

    return traverse
