"""Traversal of trees of planes: k-d tree, octree and BSP tree. A plane divides a cell into two, which are visited from front to back.

A k-d tree has planes across an axis. In an octree, three such planes in turn divide a cell through its middle. A BSP tree (Ize, Wald and
Parker 2008, "Ray Tracing with the BSP Tree") has planes of any orientation. The trees differ in how nodes are stored (`Layout`). With the
stack of Havran 2000, "Heuristic Ray Shooting Algorithms", appendix C, a plane cuts the ray's part (t_0, t_1) in a cell. The walk visits
the nearer child at once, and pushes the farther child with its part. It ends when no pending part begins before the best hit.

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
4. The builder lists X on a side of the plane if a point of X, grown by 8 u E, lies there. In a BSP tree, it need not if such points lie
   beyond the plane by at most the builder's share of node.tolerance. The computed value of plane(P) differs from plane(Q) by
   |n|_1 8 u (D + E) + 7 u |n|_1 D (dot products) + 3 u |n|_1 D (distances), and by 4 u (sum |n_i Q_i| + |d|) unless the plane is across an
   axis, whose distance from the origin is rounded only once. The terms without D are in the growth of X or in node.tolerance. The other
   terms sum to 18 u |n|_1 D <= 31.2 u D. The walk uses 2^-19 D, with the largest D of the ray's part in this cell.

So each plane becomes a slab of this half thickness. The walk visits a child if the ray is on the child's side or in the slab. Then t' is in
the ray's interval of a leaf that lists X. The leaf is visited unless it begins more than `reach` behind the best hit. For a ray parallel to
the plane, the divisor is 0 or tiny: its distances lie outside the interval or are NaN, and the walk visits one child or both.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, bit_count, largest, size_of
from wrt.kernels.traverse import plane_layouts as at
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import Mailbox, make_leaf, make_mailbox_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer
from wrt.kernels.traverse.plane_layouts import BspNode, KdNode, Octants, OctreeNode, octree_child, octree_plane, octree_planes
from wrt.kernels.traverse.steps import ENTERED, INNER, box_step, part_step, plane_step
from wrt.kernels.units.box import BoxRay, slab_interval

# Stack entries. The walk pushes at most one child per plane, so that builders keep at most STACK_SIZE planes above each other.
STACK_SIZE = 64
REACH = wp.constant(2.0**-19)
SMALLEST = wp.constant(2.0**-120)  # Added to margins: larger than any error by underflow in the proof.


@wp.struct
class Reach:
    """The part of a ray that the walk follows, and two tolerances that keep rounding from losing a hit."""

    t_0: float  # t where the part begins.
    t_1: float  # t where the part ends.
    beyond: float  # Upper bound on the error of a hit's t. The walk visits cells that begin up to this far behind the best hit.
    drift: float  # A plane counts as a slab of half thickness tolerance + drift * |t|, with the largest |t| in the cell.


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


@wp.struct
class Cut:
    """A ray's part in a cell, cut by the cell's plane."""

    up: bool  # True: the ray goes upwards, so that the nearer child is below the plane.
    meets_near: bool
    meets_far: bool
    near_t_1: float  # Latest t at which the ray leaves the nearer child.
    far_t_0: float  # Earliest t at which the ray enters the farther child.


@wp.func
def cut_part(plane: wp.vec3, part: wp.vec2, drift: float) -> Cut:
    """Cut the ray's part (t_0, t_1) by a plane (height, inv, tolerance). The origin is `height` below the plane, inv is 1 / (normal .
    direction). tolerance, drift: see Reach.drift."""
    thick = plane[2] + drift * wp.max(-part[0], part[1])
    out = Cut()
    out.up = not plane[1] < 0.0
    slab = wp.where(out.up, thick, -thick)
    near_end = (plane[0] + slab) * plane[1]
    far_begin = (plane[0] - slab) * plane[1]
    # Comparisons with NaN are false: the child is visited.
    out.meets_near = not (part[0] > near_end)
    out.meets_far = not (far_begin > part[1])
    out.near_t_1 = wp.where(near_end < part[1], near_end, part[1])
    out.far_t_0 = wp.where(far_begin > part[0], far_begin, part[0])
    return out


class Layout(NamedTuple):
    """How a tree is stored. A `place` is what the walk's stack holds of a cell."""

    node: Any  # Warp struct of a node.
    place: Any  # Type of a place: int, the index of a node, or Octants.
    root: Any  # (accel) -> place
    index: Any  # (place) -> index of the node
    leaf: Any  # (node) -> (first, count) of a leaf; count < 0: an inner node
    plane: Any  # (accel, node, place, probe) -> (height, inv, tolerance): see cut_part
    child: Any  # (node, place, above) -> place of the child below or above the plane
    has_child: Any  # (node, place, above) -> whether that child may list primitives
    normal: Any = None  # (node) -> (normal, offset) of the plane; None: an octree

    @property
    def octants(self) -> bool:
        """Whether the tree is an octree: a place may be a part of a node, and leaves list indices of primitives."""
        return self.normal is None

    def make_struct(self, record: Any) -> Any:
        """Make the structure's type, for primitives stored as `record`; nodes[0] is the root."""
        return make_octree(record) if self.octants else make_plane_tree(record, self.node)

    def make_traversal(self, units: Units, any_hit: bool, accepts: Any = None) -> Any:
        """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found. Units.box has no effect."""
        probe_of = make_probe(units)
        walk = make_walk(self, units, any_hit, accepts)
        observe = make_observer(units, 0)
        struct = self.make_struct(units.triangle_test.record)

        @wp.func
        def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
            probe = probe_of(ray)
            best = no_hit(ray)
            reach = reach_of(probe.box, ray, best.t, accel.lo, accel.hi, accel.extent)
            meets = reach.t_0 <= reach.t_1
            observe.root(accel.recorder, ray, accel.lo, accel.hi, wp.where(meets, reach.t_0, float(wp.inf)))
            if meets:
                best = walk(accel, surfaces, probe, reach)
            return observe.finish(accel.recorder, ray, best)

        return traverse


KDTREE = Layout(KdNode, wp.int32, at.root_node, at.same_index, at.kd_leaf, at.kd_plane, at.kd_child, at.kd_has_child, at.kd_normal)
BSP = Layout(BspNode, wp.int32, at.root_node, at.same_index, at.bsp_leaf, at.bsp_plane, at.bsp_child, at.bsp_has_child, at.bsp_normal)
OCTREE = Layout(OctreeNode, Octants, at.octree_root, at.octree_index, at.octree_leaf, octree_plane, octree_child, at.octree_has_child)


@cache
def make_plane_tree(record: Any, node: Any) -> Any:
    @wp.struct
    class PlaneTree:
        """A k-d tree or BSP tree. Primitives are in the order of the leaves, once for each leaf whose cell they meet."""

        lo: wp.vec3  # lo, hi: the root box.
        hi: wp.vec3
        extent: float  # Longest side of a primitive's padded box.
        nodes: wp.array(dtype=node)
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return PlaneTree


@cache
def make_octree(record: Any) -> Any:
    @wp.struct
    class Octree:
        """An octree. Primitives are in the order of prim_id."""

        lo: wp.vec3  # lo, hi, size, levels: the OctreeLayout.
        hi: wp.vec3
        size: float
        levels: int
        extent: float  # Longest side of a primitive's padded box.
        mailbox: int  # 1: use a mailbox (kernels.traverse.leaf); 0: do not.
        nodes: wp.array(dtype=OctreeNode)
        references: wp.array(dtype=wp.int32)  # Indices into `primitives`.
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Octree


def make_log_cut(layout: Layout, units: Units) -> Any:
    """Make log_cut(accel, probe, node, place, part, reach), which logs the test of a plane, or of the octants of a cell."""
    step = make_observer(units, 0).step

    @wp.func
    def log_plane(accel: Any, probe: Probe, node: Any, place: Any, part: wp.vec2, reach: Reach):
        cut = cut_part(layout.plane(accel, node, place, probe), part, reach.drift)
        normal = layout.normal(node)
        n = wp.vec3(normal[0], normal[1], normal[2])
        plane = plane_step(place, n, normal[3], -(wp.dot(n, probe.ray.origin) + normal[3]) / wp.dot(n, probe.ray.direction))
        step(accel.recorder, probe.ray, plane)
        for side in range(2):
            above = side == 1
            near = above != cut.up
            meets = wp.where(near, cut.meets_near, cut.meets_far) and layout.has_child(node, place, above)
            child = wp.where(near, wp.vec2(part[0], cut.near_t_1), wp.vec2(cut.far_t_0, part[1]))
            step(accel.recorder, probe.ray, part_step(plane, above, layout.child(node, place, above), child, meets))

    @wp.func
    def log_octants(accel: Any, probe: Probe, node: OctreeNode, place: Octants, part: wp.vec2, reach: Reach):
        for octant in range(8):
            if place.axis == 0 and (-node.count >> octant) & 1 != 0:
                below = place
                child = wp.vec2(part)
                meets = bool(True)
                for axis in range(3):
                    above = (octant >> axis) & 1 != 0
                    cut = cut_part(octree_plane(accel, node, below, probe), child, reach.drift)
                    near = above != cut.up
                    meets = meets and wp.where(near, cut.meets_near, cut.meets_far)
                    child = wp.where(near, wp.vec2(child[0], cut.near_t_1), wp.vec2(cut.far_t_0, child[1]))
                    below = octree_child(node, below, above)
                lo = octree_planes(accel, below.corner)
                hi = octree_planes(accel, below.corner + wp.vec3i(place.half, place.half, place.half))
                step(accel.recorder, probe.ray, box_step(below.index, INNER, lo, hi, wp.where(meets, child[0], float(wp.inf))))

    return log_octants if layout.octants else log_plane


def make_walk(layout: Layout, units: Units, any_hit: bool, accepts: Any) -> Any:
    """Make walk(accel, surfaces, probe, reach) -> best Hit, which visits the cells along the ray's part `reach`."""
    visit_leaf = make_mailbox_leaf(units, any_hit, accepts) if layout.octants else make_leaf(units, any_hit, accepts)
    observe = make_observer(units, size_of(layout.node))
    log_cut = make_log_cut(layout, units)
    place_type, octants, log = layout.place, layout.octants, units.observer == "log"

    @wp.func
    def walk(accel: Any, surfaces: Any, probe: Probe, reach: Reach) -> Hit:
        best = no_hit(probe.ray)
        mailbox = Mailbox()
        stack_place = wp.zeros(shape=wp.static(STACK_SIZE), dtype=place_type)
        stack_part = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.vec2)
        size = int(0)
        place = layout.root(accel)
        part = wp.vec2(reach.t_0, reach.t_1)
        found = bool(True)
        while found:
            node = accel.nodes[layout.index(place)]
            leaf = layout.leaf(node)
            if leaf[1] >= 0:
                observe.node(accel.recorder, probe.ray, layout.index(place), 0, 0)
                if wp.static(octants):
                    mailbox, best = visit_leaf(accel, surfaces, probe, node, mailbox, best)
                else:
                    best = visit_leaf(accel, surfaces, probe, leaf[0], leaf[1], best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
            else:
                if wp.static(not octants):
                    observe.node(accel.recorder, probe.ray, place, 0, 1)
                elif place.axis == 0:
                    observe.node(accel.recorder, probe.ray, place.index, bit_count(-node.count), 1)
                if wp.static(log):
                    log_cut(accel, probe, node, place, part, reach)
                cut = cut_part(layout.plane(accel, node, place, probe), part, reach.drift)
                meets_far = cut.meets_far and layout.has_child(node, place, cut.up)
                if cut.meets_near and layout.has_child(node, place, not cut.up):
                    if meets_far:
                        far = layout.child(node, place, cut.up)
                        stack_place[size] = far
                        stack_part[size] = wp.vec2(cut.far_t_0, part[1])
                        size = size + 1
                        observe.push(accel.recorder, probe.ray, layout.index(far), INNER, cut.far_t_0, size - 1, size)
                    place = layout.child(node, place, not cut.up)
                    part = wp.vec2(part[0], cut.near_t_1)
                    continue
                if meets_far:
                    place = layout.child(node, place, cut.up)
                    part = wp.vec2(cut.far_t_0, part[1])
                    continue
            # Pop the next child that begins at most reach.beyond behind the best hit: at the same t, it may have a lower prim_id.
            limit = best.t + reach.beyond
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                place = stack_place[size]
                part = wp.vec2(stack_part[size][0], wp.min(stack_part[size][1], limit))
                found = part[0] <= part[1]
                observe.pop(accel.recorder, probe.ray, layout.index(place), INNER, part[0], wp.where(found, ENTERED, 0))
        return best

    return walk
