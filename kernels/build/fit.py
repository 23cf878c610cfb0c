"""Compute the boxes of a binary BVH from the leaves to the root, in one launch, on the CPU and on CUDA: for builds and refits.
Karras 2012, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees", section 4. One thread begins at each node without
inner children, and moves up. Where two threads meet at a node, the first ends. The second reads the results of the first, and continues."""

import warp as wp

from wrt.kernels.build.records import BuildOptions, row_count
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.units.box import half_area
from wrt.kernels.units.triangle import lower, upper

NO_PARENT = wp.constant(-1)


@wp.struct
class SubtreeSummary:
    """Properties of a subtree, which its parent reads."""

    cost: wp.float64  # SAH cost: sum over nodes and leaves of half surface area times cost of a visit.
    unit_cost: wp.float64  # SAH cost if a node and a primitive both cost 1.
    lo: wp.vec3
    hi: wp.vec3
    size: int  # Number of primitives.
    inner_nodes: int  # Number of inner nodes, including the subtree's root; 0: the subtree becomes a leaf.
    height: int  # Number of inner nodes on the longest path.


@wp.struct
class Tree:
    """A binary tree whose boxes are to be fitted. Node 0 is the root; other nodes are in any order."""

    nodes: wp.array(dtype=Bvh2Node)  # A missing child has first = count = 0.
    parents: wp.array(dtype=wp.int32)  # Index of each node's parent; NO_PARENT for the root.
    order: wp.array(dtype=wp.int32)  # prim_id of the primitives, leaf after leaf.
    low: wp.array(dtype=wp.vec3)  # low, high: boxes of the primitives, indexed by prim_id.
    high: wp.array(dtype=wp.vec3)
    arrived: wp.array(dtype=wp.int32)  # Scratch: number of threads that reached each node; 0 before and after the launch.
    summaries: wp.array(dtype=SubtreeSummary)  # Scratch, one entry per node.


# Memory fence: a thread's writes before the fence are visible to other threads before its writes after the fence.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence();
#endif
""")
def fence() -> None: ...


# Volatile loads bypass the L1 cache, which does not see writes of other multiprocessors. (A native function cannot return a struct.)
@wp.func_native("""
    const volatile int* const from = (const volatile int*)(summaries.data + i);
    int words[sizeof(out) / sizeof(int)];
    for (unsigned k = 0; k < sizeof(out) / sizeof(int); ++k) words[k] = from[k];
    memcpy(&out, words, sizeof(out));
""")
def load_summary(summaries: wp.array(dtype=SubtreeSummary), i: int, out: wp.ref[SubtreeSummary]) -> None: ...


@wp.func
def inner_child_count(node: Bvh2Node) -> int:
    return (wp.where(node.count_0 == 0 and node.first_0 > 0, 1, 0) + wp.where(node.count_1 == 0 and node.first_1 > 0, 1, 0))


@wp.func
def area_of(lo: wp.vec3, hi: wp.vec3) -> wp.float64:
    """Return half the surface area of a box, 0 for an empty box; in float64, because float32 could overflow."""
    return half_area(wp.max(wp.vec3d(hi) - wp.vec3d(lo), wp.vec3d()))


@wp.func
def child_summary(tree: Tree, options: BuildOptions, first: int, count: int) -> SubtreeSummary:
    """Return the summary of a child. For an inner node, load what another thread has stored. For a leaf, compute it from the primitives."""
    out = SubtreeSummary()
    if count == 0 and first > 0:
        load_summary(tree.summaries, first, out)
        return out
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
    """Return the summary of a node with the children a and b. If a leaf costs no more, the node becomes a leaf, except for the root."""
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
    """Fit the tree, with one thread per node, in any order of threads. If options.max_leaf is 0, no node becomes a leaf."""
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
    """Store node i in the entries of its inner children in `parents`, with one thread per node i. The root's entry is not written."""
    i = wp.tid()
    node = nodes[i]
    if node.count_0 == 0 and node.first_0 > 0:
        parents[node.first_0] = i
    if node.count_1 == 0 and node.first_1 > 0:
        parents[node.first_1] = i
