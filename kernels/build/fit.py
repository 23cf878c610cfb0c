"""Boxes of a binary BVH from its leaves up, in one launch, on the CPU and on CUDA: for builds and for refits.

A thread begins at each node without inner children. Of the threads that come up to a node, the last one goes on, and finds below
what the others have left (Karras 2012, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees", section 4).
"""

import warp as wp

from wrt.kernels.build.records import BuildOptions, rows_of
from wrt.kernels.build.shape import half_area
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.units.triangle import lower, upper

NO_PARENT = wp.constant(-1)


@wp.struct
class Below:
    """What a node tells its parent. lo, hi: its box; size: primitives; used: inner nodes, itself with them, 0 where it is to be a
    leaf; height: of these on the longest way down; cost: half the surfaces of its boxes, times what visiting them costs; plain: the
    same where a node and a primitive cost 1 each."""

    cost: wp.float64
    plain: wp.float64
    lo: wp.vec3
    hi: wp.vec3
    size: int
    used: int
    height: int


@wp.struct
class Tree:
    """nodes: the root first, the others anywhere behind it; where a child is none, its first and count are 0; parents: of each,
    NO_PARENT for the root; order: prim_id of what the leaves name; low, high: of each prim_id; arrived: room, 0 for each node,
    and 0 again afterwards; below: room, one a node."""

    nodes: wp.array(dtype=Bvh2Node)
    parents: wp.array(dtype=wp.int32)
    order: wp.array(dtype=wp.int32)
    low: wp.array(dtype=wp.vec3)
    high: wp.array(dtype=wp.vec3)
    arrived: wp.array(dtype=wp.int32)
    below: wp.array(dtype=Below)


# What a thread wrote is there for others before they hear of it.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence();
#endif
""")
def fence() -> None: ...


Numbers = wp.types.vector(11, wp.float64)


# Past the first level of caches, which do not hear of what another multiprocessor writes. (It cannot give a record.)
@wp.func_native("""
    const volatile auto* from = below.data + i;
    wp::vec_t<11, wp::float64> out;
    out.c[0] = from->cost;
    out.c[1] = from->plain;
    for (int k = 0; k < 3; ++k) {
        out.c[2 + k] = from->lo.c[k];
        out.c[5 + k] = from->hi.c[k];
    }
    out.c[8] = from->size;
    out.c[9] = from->used;
    out.c[10] = from->height;
    return out;
""")
def fetched(below: wp.array(dtype=Below), i: int) -> Numbers: ...


@wp.func
def told(below: wp.array(dtype=Below), i: int) -> Below:
    """What another thread has written."""
    x = fetched(below, i)
    out = Below()
    out.cost = x[0]
    out.plain = x[1]
    out.lo = wp.vec3(float(x[2]), float(x[3]), float(x[4]))
    out.hi = wp.vec3(float(x[5]), float(x[6]), float(x[7]))
    out.size = int(x[8])
    out.used = int(x[9])
    out.height = int(x[10])
    return out


@wp.func
def inner_children(node: Bvh2Node) -> int:
    return (wp.where(node.count_0 == 0 and node.first_0 > 0, 1, 0) + wp.where(node.count_1 == 0 and node.first_1 > 0, 1, 0))


@wp.func
def area_of(lo: wp.vec3, hi: wp.vec3) -> wp.float64:
    """Half the surface; 0 for an empty box. float64: no float32 is too large."""
    return half_area(wp.max(wp.vec3d(hi) - wp.vec3d(lo), wp.vec3d()))


@wp.func
def child_of(tree: Tree, options: BuildOptions, first: int, count: int) -> Below:
    """What a child tells: an inner node what it wrote, a leaf what its primitives say."""
    if count == 0 and first > 0:
        return told(tree.below, first)
    out = Below()
    out.lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    out.hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for j in range(first, first + count):
        out.lo = lower(out.lo, tree.low[tree.order[j]])
        out.hi = upper(out.hi, tree.high[tree.order[j]])
    out.size = count
    area = area_of(out.lo, out.hi)
    out.cost = wp.float64(options.cost_intersection * rows_of(options, count)) * area
    out.plain = wp.float64(count) * area
    return out


@wp.func
def joined(options: BuildOptions, a: Below, b: Below, root: bool) -> Below:
    """What a node with these children tells: it becomes a leaf where that costs no more."""
    out = Below()
    out.lo = lower(a.lo, b.lo)
    out.hi = upper(a.hi, b.hi)
    out.size = a.size + b.size
    area = area_of(out.lo, out.hi)
    out.cost = wp.float64(options.cost_traversal) * area + a.cost + b.cost
    out.plain = area + a.plain + b.plain
    out.used = 1 + a.used + b.used
    out.height = 1 + wp.max(a.height, b.height)
    leaf = wp.float64(options.cost_intersection * rows_of(options, out.size)) * area
    if out.size <= options.max_leaf and leaf <= out.cost and not root:
        out.cost = leaf
        out.plain = wp.float64(out.size) * area
        out.used = 0
        out.height = 0
    return out


@kernel
def fit(tree: Tree, options: BuildOptions):
    """A thread a node. options.max_leaf 0: no node becomes a leaf. What comes out does not depend on the threads' order."""
    i = wp.tid()
    if inner_children(tree.nodes[i]) > 0:
        return
    while True:
        node = tree.nodes[i]
        a = child_of(tree, options, node.first_0, node.count_0)
        b = child_of(tree, options, node.first_1, node.count_1)
        node.lo_0 = a.lo
        node.hi_0 = a.hi
        node.lo_1 = b.lo
        node.hi_1 = b.hi
        tree.nodes[i] = node
        parent = tree.parents[i]
        tree.below[i] = joined(options, a, b, parent == NO_PARENT)
        if parent == NO_PARENT:
            return
        fence()
        expected = inner_children(tree.nodes[parent])
        if wp.atomic_add(tree.arrived, parent, 1) + 1 < expected:
            return
        fence()
        tree.arrived[parent] = 0
        i = parent


@kernel
def find_parents(nodes: wp.array(dtype=Bvh2Node), parents: wp.array(dtype=wp.int32)):
    """A thread a node. Of what is nobody's child, nothing is written."""
    i = wp.tid()
    node = nodes[i]
    if node.count_0 == 0 and node.first_0 > 0:
        parents[node.first_0] = i
    if node.count_1 == 0 and node.first_1 > 0:
        parents[node.first_1] = i
