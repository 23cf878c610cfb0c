"""The inner loops that fit bounding spheres and 14-DOPs to a finished binary tree, on the CPU."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.traverse.bvh2_volumes import KdopNode, SphereNode

ROUNDS = wp.constant(8)
ROUND_UP = wp.constant(wp.float64(1.0 + 2.0**-22))


@wp.func
def farthest(lo: wp.vec3, hi: wp.vec3, center: wp.vec3d) -> wp.vec3d:
    """Return the vector from `center` to the farthest corner of a box."""
    a = wp.vec3d(lo) - center
    b = wp.vec3d(hi) - center
    out = b
    for axis in range(3):
        if wp.abs(a[axis]) > wp.abs(b[axis]):
            out[axis] = a[axis]
    return out


@kernel
def fit_spheres(nodes: wp.array(dtype=Bvh2Node), spans: wp.array(dtype=wp.vec2i), order: wp.array(dtype=wp.int32),
                lo: wp.array(dtype=wp.vec3), hi: wp.array(dtype=wp.vec3), out: wp.array(dtype=SphereNode), first: int):
    """Fit a sphere for each child of node i = first + tid, around the boxes lo, hi (indexed by prim_id) of the child's primitives.
    Badoiu and Clarkson 2003, "Smaller core-sets for balls". The center begins in the middle of the child's box. In round r it moves
    1 / (r + 1) of the way to the farthest corner. The smallest sphere of all rounds is stored, with its radius rounded up. Child `side` has
    the primitives order[span[0]] .. order[span[1] - 1], with span = spans[2 i + side]."""
    i = first + wp.tid()
    for side in range(2):
        node_lo = wp.where(side == 0, nodes[i].lo_0, nodes[i].lo_1)
        node_hi = wp.where(side == 0, nodes[i].hi_0, nodes[i].hi_1)
        best = wp.vec4(0.0, 0.0, 0.0, -1.0)
        if node_lo[0] < wp.inf:
            # If the box is not finite, it has no middle, and the sphere remains all of space.
            best = wp.vec4(0.0, 0.0, 0.0, wp.inf)
            center = 0.5 * node_lo + 0.5 * node_hi
            for r in range(ROUNDS + 1):
                way = wp.vec3d()
                square = wp.float64(-1.0)
                for k in range(spans[2 * i + side][0], spans[2 * i + side][1]):
                    d = farthest(lo[order[k]], hi[order[k]], wp.vec3d(center))
                    if wp.dot(d, d) > square:
                        square = wp.dot(d, d)
                        way = d
                radius = float(wp.sqrt(square) * ROUND_UP)
                if radius < best[3]:
                    best = wp.vec4(center[0], center[1], center[2], radius)
                center = wp.vec3(wp.vec3d(center) + way / wp.float64(r + 2))
        if side == 0:
            out[i].sphere_0 = best
        else:
            out[i].sphere_1 = best


@kernel
def fit_kdops(order: wp.array(dtype=wp.int32), cut_lo: wp.array(dtype=wp.vec4), cut_hi: wp.array(dtype=wp.vec4),
              out: wp.array(dtype=KdopNode)):
    """Compute the diagonal planes of all nodes in `out`, in one thread. cut_lo, cut_hi: planes of the primitives, indexed by prim_id.
    The boxes and links of `out` are already set. A missing child gets an empty 14-DOP."""
    n = out.shape[0]
    for k in range(n):
        i = n - 1 - k
        for side in range(2):
            first = wp.where(side == 0, out[i].first_0, out[i].first_1)
            count = wp.where(side == 0, out[i].count_0, out[i].count_1)
            low = wp.vec4(wp.inf, wp.inf, wp.inf, wp.inf)
            high = wp.vec4(-wp.inf, -wp.inf, -wp.inf, -wp.inf)
            if count == 0 and wp.where(side == 0, out[i].lo_0, out[i].lo_1)[0] < wp.inf:
                low = wp.min(out[first].cut_lo_0, out[first].cut_lo_1)
                high = wp.max(out[first].cut_hi_0, out[first].cut_hi_1)
            for j in range(first, first + count):
                low = wp.min(low, cut_lo[order[j]])
                high = wp.max(high, cut_hi[order[j]])
            if side == 0:
                out[i].cut_lo_0 = low
                out[i].cut_hi_0 = high
            else:
                out[i].cut_lo_1 = low
                out[i].cut_hi_1 = high
