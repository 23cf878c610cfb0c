"""Fit the boxes of a wide BVH to moved primitives, in place and in one launch, on the CPU and on CUDA. One thread begins at each leaf.
Of the threads that meet at a node, the last one continues with the box around its children. Compressed nodes are described in
wrt.accel.bvh.compress."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.build.moves import add
from wrt.kernels.structs import kernel
from wrt.kernels.units.triangle import lower, upper
from wrt.kernels.wide.lanes import bits
from wrt.kernels.wide.layout import NodeLayout
from wrt.kernels.wide.references import EMPTY, leaf_count, leaf_first


@wp.struct
class Tree:
    """A wide tree whose boxes are to be fitted. A slot, width * node + lane, is a child."""

    nodes: wp.array(dtype=wp.float32)
    boxes: wp.array(dtype=wp.float32)  # Six planes of each slot, as in a plain node: `nodes`, or exact boxes of compressed nodes.
    up: wp.array(dtype=wp.int32)  # Slot of each node in its parent; -1 for the root.
    children: wp.array(dtype=wp.int32)  # Number of each node's children.
    arrived: wp.array(dtype=wp.int32)  # Number of children that are fitted; 0 before and after the launch.
    starts: wp.array(dtype=wp.int32)  # Index in `order` of the first primitive of each row of a leaf.
    order: wp.array(dtype=wp.int32)  # prim_id of the primitives, leaf after leaf.
    low: wp.array(dtype=wp.vec3)  # low, high: boxes of the primitives, indexed by prim_id.
    high: wp.array(dtype=wp.vec3)


# Volatile loads: see fit.load_summary.
@wp.func_native("""
    const volatile float* from = boxes.data + first;
    for (int axis = 0; axis < 3; ++axis, from += 2 * width) {
        lo[axis] = from[0];
        hi[axis] = from[width];
        for (int lane = 1; lane < width; ++lane) {
            const float low = from[lane], high = from[width + lane];
            lo[axis] = low < lo[axis] ? low : lo[axis];
            hi[axis] = high > hi[axis] ? high : hi[axis];
        }
    }
""")
def load_around(boxes: wp.array(dtype=wp.float32), first: int, width: int, lo: wp.ref[wp.vec3], hi: wp.ref[wp.vec3]) -> None:
    """Set lo, hi to the box around the children whose planes begin at boxes[first]."""


# The steps of wrt.accel.bvh.compress: `steps`, then `nearest` for each plane.
@wp.func_native("""
    float* const node = nodes.data + (long long)i * size;
    const volatile float* const planes = boxes.data + (long long)i * 6 * width;
    const auto power = [](unsigned exponent) { float step; exponent <<= 23; memcpy(&step, &exponent, 4); return step; };
    unsigned word;
    memcpy(&word, node + 3, 4);
    const unsigned exist = word >> 24, nan = 0x7fc00000;
    word &= 0xff000000;
    for (int axis = 0; axis < 3; ++axis) {
        const float low = lo[axis] <= hi[axis] ? lo[axis] : 0.0f, high = lo[axis] <= hi[axis] ? hi[axis] : 0.0f;  // 0: no children
        const double extent = (double)high - low, part = extent / 255.0;
        unsigned long long part_word;
        memcpy(&part_word, &part, 8);
        const int biased = extent > 0.0 ? (int)(part_word >> 52) - 1023 + 127 : 1;
        unsigned exponent = biased < 1 ? 1 : biased > 255 ? 255 : biased;
        for (int k = 0; k < 3; ++k) exponent += !(low + 255.0f * power(exponent) >= high) && exponent < 255;
        const bool coarse = extent - extent != 0.0 || exponent == 255;
        const float origin = coarse ? 0.0f : low, step = power(coarse ? 1 : exponent);
        word |= (coarse ? 1 : exponent) << (8 * axis);
        memcpy(node + axis, coarse ? (const void*)&nan : (const void*)&origin, 4);
        for (int lane = 0; lane < 2 * width; ++lane) {
            const bool up = lane >= width, own = !coarse && (exist >> lane % width & 1);
            const float wanted = own ? planes[2 * width * axis + lane] : low;
            const double t = ((double)wanted - origin) / step;
            double byte = t - t != 0.0 ? 0.0 : up ? ceil(t) : floor(t);
            for (int turn = 0; turn < 3; ++turn) {
                byte = byte < 0.0 ? 0.0 : byte > 255.0 ? 255.0 : byte;
                const float plane = origin + (float)byte * step;
                if (turn < 2) byte += up ? (plane < wanted) : -(plane > wanted);
            }
            ((unsigned char*)(node + 4))[2 * width * axis + lane] = (unsigned char)byte;
        }
    }
    memcpy(node + 3, &word, 4);
""")
def compress(nodes: wp.array(dtype=wp.float32), boxes: wp.array(dtype=wp.float32), i: int, width: int, size: int, lo: wp.vec3,
             hi: wp.vec3) -> None:
    """Write the planes of compressed node i, whose children have the exact planes boxes[6 * width * i ...] and are within lo, hi."""


@kernel
def compress_all(nodes: wp.array(dtype=wp.float32), boxes: wp.array(dtype=wp.float32), width: int, size: int):
    """Write the planes of all compressed nodes around exact boxes, with one thread per node. Missing children have empty boxes."""
    i = wp.tid()
    lo, hi = wp.vec3(), wp.vec3()
    load_around(boxes, 6 * width * i, width, lo, hi)
    compress(nodes, boxes, i, width, size, lo, hi)


@cache
def make_fit(width: int, compressed: bool) -> Any:
    """Return the kernel fit(tree, first) for nodes of this layout, with one thread per slot."""
    layout = NodeLayout(width, compressed)
    references, size, stride = layout.references, layout.size, 6 * width if compressed else layout.size

    @kernel
    def fit(tree: Tree, first: int):
        slot = first + wp.tid()
        reference = bits(tree.nodes, slot / width * size + references + slot % width)
        if reference >= EMPTY:
            return
        begin = leaf_first(reference)
        if wp.static(not compressed):
            begin = tree.starts[begin]
        lo, hi = wp.vec3(wp.inf, wp.inf, wp.inf), wp.vec3(-wp.inf, -wp.inf, -wp.inf)
        for j in range(begin, begin + leaf_count(reference)):
            lo = lower(lo, tree.low[tree.order[j]])
            hi = upper(hi, tree.high[tree.order[j]])
        while slot >= 0:
            node = slot / width
            at = node * stride + slot % width
            for axis in range(3):
                tree.boxes[at + 2 * width * axis] = lo[axis]
                tree.boxes[at + 2 * width * axis + width] = hi[axis]
            if add(tree.arrived, node, 1) + 1 < tree.children[node]:
                return
            tree.arrived[node] = 0
            load_around(tree.boxes, node * stride, width, lo, hi)
            if wp.static(compressed):
                compress(tree.nodes, tree.boxes, node, width, size, lo, hi)
            slot = tree.up[node]

    return fit
