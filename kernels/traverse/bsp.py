"""The traversal unit of the BSP tree: planes of any orientation, visited front to back with the part of the ray in each cell.

Ize, Wald and Parker 2008, "Ray Tracing with the BSP Tree". Planes across an axis are the fast path: one subtraction and one
multiplication, as in a k-d tree.

**Why no hit is lost.** u = 2^-24; all lengths along one axis. Let a primitive X of extent E have a hit, found by the unit at t'
before it is held to X's box (`within_bounds`), and reported as t. Let P = origin + t' direction and D = |t'| max|direction|.
1. P is within 8 u (D + E) of a point Q of X: t' belongs to weights that are convex to 2^-50 (products and areas are exact in
   float64) of corners that are off by at most 7 u (D + E) after the shear, u D of it the rounding of t' itself. Spheres: nearer.
2. |t - t'| <= reach := 2^-19 D_box / min|direction_i| over the components that are not 0, D_box being the longest distance along
   an axis from the origin to the root box (so that D <= D_box and E <= 2 D_box): P is within 24 u D_box of X's box, the slab
   distances carry 3 u D_box, and t' is moved no farther than to the plane that it is beyond; 27 u < 2^-19 = 32 u.
   Nor is it moved out of the slab of X's padded box across the longest component m of the direction, which holds t' but for
   24 u D_box, and t but for 3 u D_box and FAR_PAD's 14 u: reach <= (E_padded + 2^-18 D_box) / |direction_m|. That is what
   counts for a ray nearly along an axis. The smaller of the two is taken, with the largest E_padded of all primitives.
   So the segment that is walked reaches `reach` beyond t_min and the best hit at either end; it is cut by the root box, grown
   by 2^-19 D_box.
3. The builder lists each X, clipped to the cell, on a side that Q is in, or out of by at most node.tolerance's share of the
   builder (`plane_tolerance`). There |plane(P)| is off from plane(Q) by |n|_1 8 u (D + E). What is computed here differs from
   plane(P): by 4 u (sum |n_i Q_i| + |d|) + 7 u |n|_1 D through the rounding of both dot products, and by 3 u |n|_1 D through
   that of the two distances. All that does not depend on D is in node.tolerance; the rest is 18 u |n|_1 D <= 31.2 u D, and
   2^-19 D is taken, with the largest D of the part of the ray in this cell.
So a plane is a slab of that half thickness, and a child is visited wherever the ray is on its side or in the slab; t' is then in
the interval of a leaf that has X, which is visited unless it begins more than `reach` beyond the best hit. A ray along the plane
divides by 0 or nearly so: the distances are then beyond the interval, or say nothing, and the child or both are visited.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.bvh2 import Child, child_of
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.counters import Counts, Recorder, make_counters
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.units.box import BoxRay, slab_interval

# The builder keeps the depth at or below this; a path from the root pushes at most one child a level.
STACK_SIZE = 64
REACH = wp.constant(2.0**-19)
SMALLEST = wp.constant(2.0**-120)  # above what underflows in the derivation
PLANE = 3  # BspNode.axis of a plane that is not across an axis
INNER = -1  # count of a child that is an inner node


@wp.struct
class BspNode:
    """A plane normal . p + offset = 0 (axis 0 to 2: across that axis, p[axis] + offset = 0), and its children below (0) and
    above (1) it: the inner node `first` (count = -1), or the primitives first .. first + count - 1, which may be none.

    tolerance: half of the plane's thickness but for what grows with the distance from the ray's origin.
    """

    normal: wp.vec3
    offset: float
    tolerance: float
    axis: int
    first_0: int
    count_0: int
    first_1: int
    count_1: int


@wp.struct
class Reach:
    """The part of a ray that is walked, from t_0 to t_1; beyond: how far the walk goes on behind the best hit; drift: thickness
    of a plane for each unit of t."""

    t_0: float
    t_1: float
    beyond: float
    drift: float


@wp.func
def reach_of(box: BoxRay, ray: Ray, t_max: float, lo: wp.vec3, hi: wp.vec3, extent: float) -> Reach:
    """Set-up, once a ray (2. above). t_0 > t_1, or NaN, where the ray passes by the root box."""
    corner = wp.max(wp.abs(lo - ray.origin), wp.abs(hi - ray.origin))
    grow = REACH * wp.max(wp.max(corner[0], corner[1]), corner[2]) + SMALLEST
    margin = wp.vec3(grow, grow, grow)
    interval = slab_interval(box, lo - margin, hi + margin)
    size = wp.abs(ray.direction)
    smallest = float(wp.inf)
    for axis in range(3):
        smallest = wp.where(size[axis] > 0.0, wp.min(smallest, size[axis]), smallest)
    largest = wp.max(wp.max(size[0], size[1]), size[2])
    out = Reach()
    out.beyond = wp.min(grow / smallest, (extent + 2.0 * grow) / largest)
    out.drift = REACH * largest
    out.t_0 = wp.max(interval[0], ray.t_min - out.beyond)
    out.t_1 = wp.min(interval[1], t_max + out.beyond)
    return out


@cache
def make_struct(record: Any) -> Any:
    """lo, hi: the root box; extent: the longest side of a primitive's padded box; the root itself is the child (first, count),
    as in a node."""

    @wp.struct
    class Bsp:
        lo: wp.vec3
        hi: wp.vec3
        extent: float
        first: int
        count: int
        nodes: wp.array(dtype=BspNode)
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Bsp


@wp.struct
class Sides:
    """The children of a node in the order of a ray, whether the ray meets them, and where, at most, it leaves the nearer one and
    enters the farther one."""

    near: Child
    far: Child
    meets_near: bool
    meets_far: bool
    near_t_1: float
    far_t_0: float


@wp.func
def cut_by_plane(node: BspNode, box: BoxRay, direction: wp.vec3, t_0: float, t_1: float, drift: float) -> Sides:
    """The sides for the part of a ray from t_0 to t_1. drift: of Reach."""
    # The distance of the origin from the plane, against the normal, and one over the speed along the normal.
    height = float(0.0)
    inv = float(0.0)
    if node.axis < wp.static(PLANE):
        height = -node.offset - box.origin[node.axis]
        inv = box.inv_dir[node.axis]
    else:
        height = -(wp.dot(node.normal, box.origin) + node.offset)
        inv = 1.0 / wp.dot(node.normal, direction)
    thick = node.tolerance + drift * wp.max(-t_0, t_1)
    up = not inv < 0.0
    slab = wp.where(up, thick, -thick)
    near_end = (height + slab) * inv
    far_begin = (height - slab) * inv
    out = Sides()
    out.near = child_of(node, not up)
    out.far = child_of(node, up)
    # Comparisons with NaN are false: it says nothing, and the child is visited.
    out.meets_near = out.near.count != 0 and not (t_0 > near_end)
    out.meets_far = out.far.count != 0 and not (far_begin > t_1)
    out.near_t_1 = wp.where(near_end < t_1, near_end, t_1)
    out.far_t_0 = wp.where(far_begin > t_0, far_begin, t_0)
    return out


def make_walk(units: Units, any_hit: bool, accepts: Any) -> Any:
    """walk(accel, surfaces, probe, reach) -> the best hit and counts."""
    visit_leaf = make_leaf(units, any_hit, accepts)
    fetch_node, _, push, _ = make_counters(units, size_of(BspNode))

    @wp.func
    def walk(accel: Any, surfaces: Any, probe: Probe, reach: Reach):
        best = no_hit(probe.ray)
        counts = Counts()
        stack_first = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.int32)
        stack_count = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.int32)
        stack_t_0 = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.float32)
        stack_t_1 = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.float32)
        size = int(0)
        first = int(accel.first)
        count = int(accel.count)
        t_0 = float(reach.t_0)
        t_1 = float(reach.t_1)
        found = t_0 <= t_1
        while found:
            if count >= 0:
                counts.leaves += wp.where(count > 0, 1, 0)
                best, counts = visit_leaf(accel, surfaces, probe, first, count, best, counts)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
            else:
                counts = fetch_node(accel.recorder, probe.ray, counts, first, 0)
                sides = cut_by_plane(accel.nodes[first], probe.box, probe.ray.direction, t_0, t_1, reach.drift)
                if sides.meets_near:
                    if sides.meets_far:
                        stack_first[size] = sides.far.first
                        stack_count[size] = sides.far.count
                        stack_t_0[size] = sides.far_t_0
                        stack_t_1[size] = t_1
                        size = size + 1
                        counts = push(counts, size)
                    first = sides.near.first
                    count = sides.near.count
                    t_1 = sides.near_t_1
                    continue
                if sides.meets_far:
                    first = sides.far.first
                    count = sides.far.count
                    t_0 = sides.far_t_0
                    continue
            # Pop; what begins beyond the closest hit, and farther than a hit is moved, is dropped.
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                counts.pops += 1
                if stack_t_0[size] <= best.t + reach.beyond:
                    first = stack_first[size]
                    count = stack_count[size]
                    t_0 = stack_t_0[size]
                    t_1 = wp.min(stack_t_1[size], best.t + reach.beyond)
                    found = bool(True)
        return best, counts

    return walk


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """The closest hit, or any (the first that is found). The box test has no say: only the root has a box."""
    probe_of = make_probe(units)
    walk = make_walk(units, any_hit, accepts)
    _, _, _, finish = make_counters(units, 0)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        reach = reach_of(probe.box, ray, no_hit(ray).t, accel.lo, accel.hi, accel.extent)
        best, counts = walk(accel, surfaces, probe, reach)
        return finish(accel.recorder, ray, counts, best)

    return traverse
