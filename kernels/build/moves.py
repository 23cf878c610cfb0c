"""Move instances on the CPU and on CUDA, in two launches with one thread per instance.
`place` writes an instance's placement and its box in world space, and counts, for each node above it, the children that will change.
`fit` goes up from the instances. Where several threads meet at a node, the last one computes the node's box and continues."""

import warp as wp

from wrt.kernels.structs import EPSILON, kernel
from wrt.kernels.transforms import Affine, Transforms, affine_of, inverted, times
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.traverse.instances import Placement
from wrt.kernels.units.box import PAD_COORDINATE
from wrt.kernels.wide.layout import WIDTH

LARGEST = 1e300  # Bound of the corners of parts' boxes: the box of all space is infinite.
SMALLEST = wp.constant(wp.float64(1e-45))  # Moves a float64 near 0 by a float32.


@wp.struct
class TopLevel:
    """Trees over instances. Instance i is row i of geometry.to_world. A slot, 2 * node + side, is a child of a binary node."""

    rows: wp.array(dtype=wp.int32)  # Instance of each value of hits.instance; -1: cannot move.
    place: wp.array(dtype=wp.int32)  # Index of each instance's placement.
    slot: wp.array(dtype=wp.int32)  # Slot of each instance.
    up: wp.array(dtype=wp.int32)  # Slot of each node in its parent; -1: a root.
    wide_slot: wp.array(dtype=wp.int32)  # Index in `wide` of the first plane of the child in each slot; -1: in no wide node.
    wide_node: wp.array(dtype=wp.int32)  # Index in `wide` of the box around all children, for the binary node at a wide node's root; -1.
    first_box: wp.array(dtype=wp.int32)  # First box of each part and, last, the number of boxes.
    center: wp.array(dtype=wp.vec3d)  # center, half: boxes around all primitives of the parts, in the parts' own spaces.
    half: wp.array(dtype=wp.vec3d)
    own_origin: wp.array(dtype=wp.vec3d)  # Point of each part's mesh that is 0 in the part's own space.
    origin: wp.vec3d  # Point of the world that is 0 for the structure.
    most_spread: wp.float64  # Largest spread (geometry.MAX_SPREAD) of valid matrices.
    reach: float  # Largest coordinate of valid boxes.
    # What a move writes:
    to_world: wp.array(dtype=wp.vec4d)  # Three rows of each instance's matrix; empty if the host keeps the matrices.
    placements: wp.array(dtype=Placement)
    low: wp.array(dtype=wp.vec3)  # low, high: box of each instance in world space; empty after an invalid move.
    high: wp.array(dtype=wp.vec3)
    slack: wp.array(dtype=float)  # Widening of each instance's box (traverse.instances.enter).
    slot_slack: wp.array(dtype=float)  # The largest of all instances below each slot.
    node_slack: wp.array(dtype=float)  # The largest of all instances below each node.
    nodes: wp.array(dtype=Bvh2Node)
    wide: wp.array(dtype=wp.float32)
    pending: wp.array(dtype=wp.int32)  # Number of each node's children that will still change; 0 before `place` and after `fit`.
    invalid: wp.array(dtype=wp.int32)  # 1 if the last move of a value of hits.instance was invalid, else 0.


@wp.struct
class Box:
    lo: wp.vec3
    hi: wp.vec3
    valid: bool


# Warp's atomic_add is atomic on CUDA only. Writes before the sum are visible to the thread that adds last.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence();
    const int before = wp::atomic_add(numbers.data + i, value);
    __threadfence();
    return before;
#else
    return __atomic_fetch_add(numbers.data + i, value, __ATOMIC_ACQ_REL);
#endif
""")
def add(numbers: wp.array(dtype=wp.int32), i: int, value: int) -> int:
    """Add to a number that several threads change; return the number before."""


@wp.func_native("""
    float* const to = (float*)(nodes.data + slot / 2) + 6 * (slot % 2);
    for (int k = 0; k < 3; ++k) {
        to[k] = lo[k];
        to[3 + k] = hi[k];
    }
""")
def store_box(nodes: wp.array(dtype=Bvh2Node), slot: int, lo: wp.vec3, hi: wp.vec3) -> None: ...


# Volatile loads: see fit.load_summary.
@wp.func_native("""
    const volatile float* const from = (const volatile float*)(nodes.data + node);
    const volatile float* const pair = slack.data + 2 * node;
    for (int k = 0; k < 3; ++k) {
        const float low[] = {from[k], from[6 + k]}, high[] = {from[3 + k], from[9 + k]};
        lo[k] = low[0] < low[1] ? low[0] : low[1];
        hi[k] = high[0] > high[1] ? high[0] : high[1];
    }
    const float first = pair[0], second = pair[1];
    return first > second ? first : second;
""")
def load_box(nodes: wp.array(dtype=Bvh2Node), slack: wp.array(dtype=float), node: int, lo: wp.ref[wp.vec3], hi: wp.ref[wp.vec3]) -> float:
    """Set lo, hi to the box around both children of a node; return the larger slack of both."""


@wp.func
def row_of(top: TopLevel, id: int) -> int:
    """Return the instance of a value of hits.instance; -1 if there is none."""
    if id < 0 or id >= top.rows.shape[0]:
        return -1
    return top.rows[id]


@wp.func
def rounded_out(corner: wp.vec3d, sign: float, largest: wp.vec3d) -> wp.vec3:
    """Round a corner of a box outwards, with a margin for the rounding of a ray origin's coordinates. sign: -1 for the low corner, or 1.
    largest: the larger absolute value of both corners, per axis."""
    pad = wp.float64(wp.static(2.0 * (PAD_COORDINATE + float(EPSILON)))) * largest + wp.vec3d(SMALLEST, SMALLEST, SMALLEST)
    return wp.vec3(corner + wp.float64(sign) * pad)


@wp.func
def spread_of(a: wp.mat33d, inverse: wp.mat33d) -> wp.float64:
    """Return the largest row sum of |a| |inverse|, 1 or more; NaN if a row is not finite."""
    one = wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(1.0))
    sums = wp.vec3d(wp.dot(wp.abs(inverse[0]), one), wp.dot(wp.abs(inverse[1]), one), wp.dot(wp.abs(inverse[2]), one))
    rows = wp.vec3d(wp.dot(wp.abs(a[0]), sums), wp.dot(wp.abs(a[1]), sums), wp.dot(wp.abs(a[2]), sums))
    if not wp.isfinite(rows):
        return wp.float64(wp.nan)
    return wp.max(wp.max(rows), wp.float64(1.0))


@wp.func
def world_box(top: TopLevel, part: int, map: Affine) -> Box:
    """Return the box around the mapped boxes of a part. It is empty if the part has no boxes, or if it is too far away."""
    out = Box()
    out.lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    out.hi = -out.lo
    out.valid = True
    begin = top.first_box[part]
    end = top.first_box[part + 1]
    if begin == end:
        return out
    least = wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))
    most = -least
    size = wp.matrix_from_rows(wp.abs(map.a[0]), wp.abs(map.a[1]), wp.abs(map.a[2]))
    for k in range(begin, end):
        middle = map.a * top.center[k] + map.t
        reach = size * top.half[k]
        least = wp.min(least, middle - reach)
        most = wp.max(most, middle + reach)
    largest = wp.max(wp.abs(least), wp.abs(most))
    out.valid = wp.max(largest) <= wp.float64(top.reach)
    if out.valid:
        out.lo = rounded_out(least, -1.0, largest)
        out.hi = rounded_out(most, 1.0, largest)
    return out


@kernel
def place(top: TopLevel, ids: wp.array(dtype=wp.int32), transforms: Transforms, first: int):
    """Move the instance of value ids[i] of hits.instance by the i-th transform. An invalid move leaves the instance where it was, with an
    empty box, so that no ray hits it. Values that cannot move are skipped."""
    i = first + wp.tid()
    row = row_of(top, ids[i])
    if row < 0:
        return
    at = top.place[row]
    part = top.placements[at].bottom
    map = affine_of(transforms, wp.where(transforms.own, row, i))
    if transforms.outside:
        map.t = map.t + (times(map.a, top.own_origin[part]) - top.origin)
    inverse = inverted(map.a)
    spread = spread_of(map.a, inverse)
    box = Box()
    box.lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    box.hi = -box.lo
    if transforms.own:
        top.reach = wp.inf
    if wp.where(transforms.own, top.invalid[ids[i]] == 0, wp.isfinite(map.t) and spread <= top.most_spread):
        box = world_box(top, part, map)
    top.slack[row] = 0.0
    if box.valid:
        local = -times(inverse, map.t)
        top.placements[at].local_x = wp.vec4d(inverse[0][0], inverse[0][1], inverse[0][2], local[0])
        top.placements[at].local_y = wp.vec4d(inverse[1][0], inverse[1][1], inverse[1][2], local[1])
        top.placements[at].local_z = wp.vec4d(inverse[2][0], inverse[2][1], inverse[2][2], local[2])
        top.slack[row] = float(wp.float64(wp.static(32.0 * float(EPSILON))) * spread)
        if top.to_world.shape[0] > 0:
            for k in range(3):
                top.to_world[3 * row + k] = wp.vec4d(map.a[k][0], map.a[k][1], map.a[k][2], map.t[k])
    top.low[row] = box.lo
    top.high[row] = box.hi
    top.invalid[ids[i]] = wp.where(box.valid, 0, 1)
    if top.slot.shape[0] > 0:
        slot = top.slot[row]
        while slot >= 0 and add(top.pending, slot / 2, 1) == 0:
            slot = top.up[slot / 2]


@kernel
def measure(top: TopLevel, part: int, step: int, order: wp.array(dtype=int), low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3)):
    """Write the boxes of a refitted part around `step` primitives each, as wrt.accel.top_level.part_boxes, with one thread per box."""
    i = wp.tid()
    lo, hi = wp.vec3(wp.inf, wp.inf, wp.inf), wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for j in range(i * step, wp.min((i + 1) * step, order.shape[0])):
        prim = wp.where(step == 1, j, order[j])
        lo = wp.min(lo, low[prim])
        hi = wp.max(hi, high[prim])
    most = wp.float64(wp.static(LARGEST)) * wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(1.0))
    least, largest = wp.max(wp.vec3d(lo), -most), wp.min(wp.vec3d(hi), most)
    top.center[top.first_box[part] + i] = wp.float64(0.5) * (least + largest)
    top.half[top.first_box[part] + i] = wp.float64(0.5) * (largest - least)


@kernel
def fit(top: TopLevel, ids: wp.array(dtype=wp.int32), first: int):
    """Fit the nodes above the instances that `place` moved."""
    i = first + wp.tid()
    row = row_of(top, ids[i])
    if row < 0:
        return
    lo = top.low[row]
    hi = top.high[row]
    slack = float(top.slack[row])
    slot = int(top.slot[row])
    while slot >= 0:
        store_box(top.nodes, slot, lo, hi)
        top.slot_slack[slot] = slack
        if top.wide.shape[0] > 0:
            at = top.wide_slot[slot]
            if at >= 0:
                for k in range(3):
                    top.wide[at + wp.static(2 * WIDTH) * k] = lo[k]
                    top.wide[at + wp.static(2 * WIDTH) * k + WIDTH] = hi[k]
        node = slot / 2
        if add(top.pending, node, -1) > 1:
            return
        slack = load_box(top.nodes, top.slot_slack, node, lo, hi)
        top.node_slack[node] = slack
        if top.wide.shape[0] > 0:
            at = top.wide_node[node]
            if at >= 0 and lo[0] <= hi[0]:
                for k in range(3):
                    top.wide[at + k] = wp.max(lo[k], -3e38)  # finite: an infinite widening would give NaN
                    top.wide[at + 3 + k] = wp.min(hi[k], 3e38)
                top.wide[at + 6] = slack
        slot = top.up[node]
