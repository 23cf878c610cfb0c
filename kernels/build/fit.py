"""Boxes of a binary BVH from its leaves up, in one launch, on the CPU and on CUDA: for builds and refits.
A thread begins at each node without inner children. The last thread that reaches a node goes on, and reads what the others wrote below.
(Karras 2012, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees", section 4)."""

import warp as wp

from wrt.kernels.build.records import BuildOptions, row_count
from wrt.kernels.build.shape import half_area
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.units.triangle import lower, upper

NO_PARENT = wp.constant(-1)


@wp.struct
class SubtreeSummary:
    """Summary of a subtree, which a node hands to its parent."""

    cost: wp.float64  # Half surfaces of its boxes, times the SAH cost of a visit.
    unit_cost: wp.float64  # The same with a cost of 1 for a node and for a primitive.
    lo: wp.vec3
    hi: wp.vec3
    size: int  # Primitives.
    inner_nodes: int  # Inner nodes, itself included; 0: it becomes a leaf.
    height: int  # Inner nodes on the longest path.


@wp.struct
class Tree:
    """A binary tree whose boxes are fitted; the root is first, the other nodes in any order."""

    nodes: wp.array(dtype=Bvh2Node)  # A missing child has first = count = 0.
    parents: wp.array(dtype=wp.int32)  # NO_PARENT for the root.
    order: wp.array(dtype=wp.int32)  # prim_id of the leaves' primitives.
    low: wp.array(dtype=wp.vec3)  # By prim_id, as high.
    high: wp.array(dtype=wp.vec3)
    arrived: wp.array(dtype=wp.int32)  # Scratch: 0 for each node, before and after.
    summaries: wp.array(dtype=SubtreeSummary)  # Scratch, one entry a node.


# A thread's writes are visible to others before they hear of them.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence();
#endif
""")
def fence() -> None: ...


Numbers = wp.types.vector(11, wp.float64)


# It bypasses the L1 cache, which another multiprocessor's writes do not reach. (A native function cannot return a record.)
@wp.func_native("""
    const volatile auto* from = summaries.data + i;
    wp::vec_t<11, wp::float64> out;
    out.c[0] = from->cost;
    out.c[1] = from->unit_cost;
    for (int k = 0; k < 3; ++k) {
        out.c[2 + k] = from->lo.c[k];
        out.c[5 + k] = from->hi.c[k];
    }
    out.c[8] = from->size;
    out.c[9] = from->inner_nodes;
    out.c[10] = from->height;
    return out;
""")
def read_numbers(summaries: wp.array(dtype=SubtreeSummary), i: int) -> Numbers: ...


@wp.func
def read_summary(summaries: wp.array(dtype=SubtreeSummary), i: int) -> SubtreeSummary:
    """Read the summary that another thread wrote."""
    x = read_numbers(summaries, i)
    out = SubtreeSummary()
    out.cost = x[0]
    out.unit_cost = x[1]
    out.lo = wp.vec3(float(x[2]), float(x[3]), float(x[4]))
    out.hi = wp.vec3(float(x[5]), float(x[6]), float(x[7]))
    out.size = int(x[8])
    out.inner_nodes = int(x[9])
    out.height = int(x[10])
    return out


@wp.func
def inner_child_count(node: Bvh2Node) -> int:
    return (wp.where(node.count_0 == 0 and node.first_0 > 0, 1, 0) + wp.where(node.count_1 == 0 and node.first_1 > 0, 1, 0))


@wp.func
def area_of(lo: wp.vec3, hi: wp.vec3) -> wp.float64:
    """Half the surface; 0 for an empty box. In float64, so that no float32 overflows."""
    return half_area(wp.max(wp.vec3d(hi) - wp.vec3d(lo), wp.vec3d()))


@wp.func
def child_summary(tree: Tree, options: BuildOptions, first: int, count: int) -> SubtreeSummary:
    """Summary of a child: an inner node's is stored, a leaf's comes from its primitives."""
    if count == 0 and first > 0:
        return read_summary(tree.summaries, first)
    out = SubtreeSummary()
    out.lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    out.hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for j in range(first, first + count):
        out.lo = lower(out.lo, tree.low[tree.order[j]])
        out.hi = upper(out.hi, tree.high[tree.order[j]])
    out.size = count
    area = area_of(out.lo, out.hi)
    out.cost = wp.float64(options.cost_intersection * row_count(options, count)) * area
    out.unit_cost = wp.float64(count) * area
    return out


@wp.func
def merge_summaries(options: BuildOptions, a: SubtreeSummary, b: SubtreeSummary, root: bool) -> SubtreeSummary:
    """Summary of a node with these children; it becomes a leaf if that costs no more."""
    out = SubtreeSummary()
    out.lo = lower(a.lo, b.lo)
    out.hi = upper(a.hi, b.hi)
    out.size = a.size + b.size
    area = area_of(out.lo, out.hi)
    out.cost = wp.float64(options.cost_traversal) * area + a.cost + b.cost
    out.unit_cost = area + a.unit_cost + b.unit_cost
    out.inner_nodes = 1 + a.inner_nodes + b.inner_nodes
    out.height = 1 + wp.max(a.height, b.height)
    leaf = wp.float64(options.cost_intersection * row_count(options, out.size)) * area
    if out.size <= options.max_leaf and leaf <= out.cost and not root:
        out.cost = leaf
        out.unit_cost = wp.float64(out.size) * area
        out.inner_nodes = 0
        out.height = 0
    return out


@kernel
def fit(tree: Tree, options: BuildOptions):
    """Fit a node a thread; options.max_leaf 0: no node becomes a leaf. The result does not depend on the threads' order."""
    i = wp.tid()
    if inner_child_count(tree.nodes[i]) > 0:
        return
    while True:
        node = tree.nodes[i]
        a = child_summary(tree, options, node.first_0, node.count_0)
        b = child_summary(tree, options, node.first_1, node.count_1)
        node.lo_0 = a.lo
        node.hi_0 = a.hi
        node.lo_1 = b.lo
        node.hi_1 = b.hi
        tree.nodes[i] = node
        parent = tree.parents[i]
        tree.summaries[i] = merge_summaries(options, a, b, parent == NO_PARENT)
        if parent == NO_PARENT:
            return
        fence()
        expected = inner_child_count(tree.nodes[parent])
        if wp.atomic_add(tree.arrived, parent, 1) + 1 < expected:
            return
        fence()
        tree.arrived[parent] = 0
        i = parent


@kernel
def find_parents(nodes: wp.array(dtype=Bvh2Node), parents: wp.array(dtype=wp.int32)):
    """Store each node's parent, a node a thread; nodes without a parent are left alone."""
    i = wp.tid()
    node = nodes[i]
    if node.count_0 == 0 and node.first_0 > 0:
        parents[node.first_0] = i
    if node.count_1 == 0 and node.first_1 > 0:
        parents[node.first_1] = i
