"""Collapse a binary BVH into a wide BVH of least SAH cost.
Ylitie, Karras and Laine 2017, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", section 3.1. A subtree of the
binary BVH may become up to k children ("roots") of a wide node. From the bottom up, `subtree_costs` finds the least cost of each subtree
for each k. From the top down, `collapse` writes the best choice. A leaf's cost is proportional to the rows of primitives that it fills."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node
from wrt.kernels.units.box import half_area
from wrt.kernels.wide.references import EMPTY, leaf_reference

MAX_WIDTH = wp.constant(8)


@wp.struct
class CollapseOptions:
    """Limits and SAH costs of a wide tree."""

    width: int  # Number of children of a node, and of primitives in a row.
    max_leaf: int  # Largest number of primitives in a leaf.
    cost_traversal: float  # Cost of a node.
    cost_intersection: float  # Cost of a row of primitives.
    stack: int  # Number of entries on the traversal's stack.


@wp.struct
class Subtrees:
    """Least costs of the binary nodes' subtrees. For node i and k roots, `cost` and `choice` have the entry i * MAX_WIDTH + k - 1."""

    size: wp.array(dtype=wp.int32)  # Number of primitives.
    height: wp.array(dtype=wp.int32)  # Number of inner nodes on the longest path.
    cost: wp.array(dtype=wp.float32)
    choice: wp.array(dtype=wp.uint8)  # k > 1: number of roots in the left child. k = 1: 1 for a leaf, 0 for an inner node.


@wp.struct
class WideTree:
    """The wide tree. A missing child has the reference EMPTY and an empty box."""

    children: wp.array(dtype=wp.int32)  # References, `width` per node (kernels.wide.references).
    lo: wp.array(dtype=wp.vec3)  # lo, hi: boxes of the children.
    hi: wp.array(dtype=wp.vec3)
    source: wp.array(dtype=wp.int32)  # Scratch: the children of one node, each as 2 * binary node + side.
    order: wp.array(dtype=wp.int32)  # prim_id of each primitive, row after row; -1 in the unused entries of a row.
    count: wp.array(dtype=wp.int32)  # Numbers of nodes, rows, leaves; depth.


@wp.struct
class WideTask:
    """The binary node `node`, which becomes the wide node `slot`."""

    node: int
    slot: int
    free_entries: int  # Number of stack entries that are free when a traversal visits the node.
    depth: int  # Depth of the wide node; the root's is 1.


@wp.func
def low_of(node: Bvh2Node, side: int) -> wp.vec3:
    return wp.where(side == 0, node.lo_0, node.lo_1)


@wp.func
def high_of(node: Bvh2Node, side: int) -> wp.vec3:
    return wp.where(side == 0, node.hi_0, node.hi_1)


@wp.func
def area_of(node: Bvh2Node, side: int) -> float:
    """Return half the surface area of a child's box: 0 for an empty box, at most 1e30."""
    return wp.min(half_area(wp.max(high_of(node, side) - low_of(node, side), wp.vec3())), 1.0e30)


@wp.func
def first_of(node: Bvh2Node, side: int) -> int:
    return wp.where(side == 0, node.first_0, node.first_1)


@wp.func
def count_of(node: Bvh2Node, side: int) -> int:
    return wp.where(side == 0, node.count_0, node.count_1)


@wp.func
def child_size(trees: Subtrees, node: Bvh2Node, side: int) -> int:
    """Return the number of primitives below a child."""
    n = count_of(node, side)
    if n == 0:
        n = trees.size[first_of(node, side)]
    return n


@wp.func
def leaf_cost(options: CollapseOptions, area: float, count: int) -> float:
    return options.cost_intersection * area * float((count + options.width - 1) / options.width)


@wp.func
def child_cost(trees: Subtrees, options: CollapseOptions, node: Bvh2Node, side: int, k: int) -> float:
    """Return the least cost of a child as at most k roots."""
    n = count_of(node, side)
    if n > 0:
        return leaf_cost(options, area_of(node, side), n)
    return trees.cost[first_of(node, side) * MAX_WIDTH + k - 1]


@kernel
def subtree_costs(nodes: wp.array(dtype=Bvh2Node), options: CollapseOptions, trees: Subtrees):
    """Compute the costs of all subtrees in one thread, from the last node to the first: parents have lower indices than their children.
    The cost of a subtree as one root depends on its box, which its parent holds. So it is computed at the parent."""
    n_nodes = nodes.shape[0]
    for j in range(n_nodes):
        i = n_nodes - 1 - j
        node = nodes[i]
        height = int(0)
        for side in range(2):
            if count_of(node, side) == 0:
                c = first_of(node, side)
                area = area_of(node, side)
                height = wp.max(height, trees.height[c])
                inner = options.cost_traversal * area + trees.cost[c * MAX_WIDTH + options.width - 1]
                whole = leaf_cost(options, area, trees.size[c])
                leaf = trees.size[c] <= options.max_leaf and whole <= inner
                trees.choice[c * MAX_WIDTH] = wp.where(leaf, wp.uint8(1), wp.uint8(0))
                trees.cost[c * MAX_WIDTH] = wp.where(leaf, whole, inner)
                for k in range(2, options.width + 1):
                    if trees.cost[c * MAX_WIDTH + k - 2] <= trees.cost[c * MAX_WIDTH + k - 1]:
                        trees.cost[c * MAX_WIDTH + k - 1] = trees.cost[c * MAX_WIDTH + k - 2]
        trees.height[i] = height + 1
        trees.size[i] = child_size(trees, node, 0) + child_size(trees, node, 1)
        for k in range(2, options.width + 1):
            best = float(wp.inf)
            left = int(1)
            for a in range(1, k):
                cost = child_cost(trees, options, node, 0, a) + child_cost(trees, options, node, 1, k - a)
                if cost < best:
                    best = cost
                    left = a
            trees.cost[i * MAX_WIDTH + k - 1] = best
            trees.choice[i * MAX_WIDTH + k - 1] = wp.uint8(left)


@wp.func
def write_roots(nodes: wp.array(dtype=Bvh2Node), trees: Subtrees, i: int, k: int, source: wp.array(dtype=wp.int32)) -> int:
    """Write the cheapest choice of at most k roots for binary node i to `source`, as in WideTree; return their number, at least two."""
    node_of = wp.zeros(shape=wp.static(8), dtype=wp.int32)
    side_of = wp.zeros(shape=wp.static(8), dtype=wp.int32)
    k_of = wp.zeros(shape=wp.static(8), dtype=wp.int32)
    while k > 2 and trees.cost[i * MAX_WIDTH + k - 2] <= trees.cost[i * MAX_WIDTH + k - 1]:
        k = k - 1
    left = int(trees.choice[i * MAX_WIDTH + k - 1])
    node_of[0] = i
    side_of[0] = 1
    k_of[0] = k - left
    node_of[1] = i
    side_of[1] = 0
    k_of[1] = left
    size = int(2)
    n = int(0)
    while size > 0:
        size = size - 1
        parent = node_of[size]
        side = side_of[size]
        roots = k_of[size]
        c = first_of(nodes[parent], side)
        if count_of(nodes[parent], side) > 0:
            roots = int(1)
        while roots > 1 and trees.cost[c * MAX_WIDTH + roots - 2] <= trees.cost[c * MAX_WIDTH + roots - 1]:
            roots = roots - 1
        if roots == 1:
            source[n] = 2 * parent + side
            n = n + 1
            continue
        left = int(trees.choice[c * MAX_WIDTH + roots - 1])
        node_of[size] = c
        side_of[size] = 1
        k_of[size] = roots - left
        node_of[size + 1] = c
        side_of[size + 1] = 0
        k_of[size + 1] = left
        size = size + 2
    return n


@wp.func
def write_primitives(nodes: wp.array(dtype=Bvh2Node), order: wp.array(dtype=wp.int32), parent: int, side: int, out: WideTree, slot: int):
    """Write the prim_id of all primitives below child `side` of binary node `parent` to out.order, from index `slot` on."""
    stack = wp.zeros(shape=wp.static(STACK_SIZE + 2), dtype=wp.int32)
    stack[0] = 2 * parent + side
    size = int(1)
    n = int(0)
    while size > 0:
        size = size - 1
        node = nodes[stack[size] / 2]
        s = stack[size] % 2
        first = first_of(node, s)
        count = count_of(node, s)
        for j in range(count):
            out.order[slot + n] = order[first + j]
            n = n + 1
        if count == 0:
            stack[size] = 2 * first + 1
            stack[size + 1] = 2 * first
            size = size + 2


@wp.func
def write_in_order(nodes: wp.array(dtype=Bvh2Node), options: CollapseOptions, out: WideTree, base: int, n: int):
    """Sort the n children of a wide node for any-hit rays, and write their references and boxes from index `base` on.
    An any-hit ray visits the last slot first. So the slots hold, from the first to the last: empty slots, inner nodes, leaves. Inner nodes
    are sorted by ascending box area, and so are leaves. The box of child i is in the binary node and side out.source[i]."""
    reference = wp.zeros(shape=wp.static(8), dtype=wp.int32)
    source = wp.zeros(shape=wp.static(8), dtype=wp.int32)
    area = wp.zeros(shape=wp.static(8), dtype=wp.float32)
    for i in range(n):
        code = out.source[i]
        child = out.children[base + i]
        child_area = area_of(nodes[code / 2], code % 2)
        j = int(i)
        while j > 0 and ((child > 0 and reference[j - 1] < 0)
                         or ((child > 0) == (reference[j - 1] > 0) and area[j - 1] > child_area)):
            reference[j] = reference[j - 1]
            source[j] = source[j - 1]
            area[j] = area[j - 1]
            j = j - 1
        reference[j] = child
        source[j] = code
        area[j] = child_area
    first = base + options.width - n
    for i in range(base, first):
        out.children[i] = EMPTY
        out.lo[i] = wp.vec3(wp.inf, wp.inf, wp.inf)
        out.hi[i] = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for i in range(n):
        out.children[first + i] = reference[i]
        out.lo[first + i] = low_of(nodes[source[i] / 2], source[i] % 2)
        out.hi[first + i] = high_of(nodes[source[i] / 2], source[i] % 2)


@wp.func
def choose_roots(nodes: wp.array(dtype=Bvh2Node), options: CollapseOptions, trees: Subtrees, task: WideTask, out: WideTree) -> int:
    """Choose the children of a wide node, and write them to out.source; return their number.
    While a traversal is below one of n children, the other n - 1 may wait on its stack. Below that child, the traversal needs one
    free entry per level even if all nodes are binary. If the best choice leaves fewer free entries, the node gets fewer children."""
    k = int(options.width)
    n = int(0)
    while True:
        n = write_roots(nodes, trees, task.node, k, out.source)
        tallest = int(0)
        for j in range(n):
            code = out.source[j]
            if count_of(nodes[code / 2], code % 2) == 0:
                tallest = wp.max(tallest, trees.height[first_of(nodes[code / 2], code % 2)])
        if k == 2 or task.free_entries - (n - 1) >= tallest:
            break
        k = k - 1
    return n


@wp.func
def write_rows(nodes: wp.array(dtype=Bvh2Node), order: wp.array(dtype=wp.int32), code: int, count: int, width: int,
               out: WideTree) -> int:
    """Append a leaf's primitives to out.order, in rows of `width`; return the number of rows that they fill. The leaf has `count`
    primitives. Its `code` is its entry in out.source."""
    rows = (count + width - 1) / width
    first = out.count[1] * width
    write_primitives(nodes, order, code / 2, code % 2, out, first)
    for i in range(count, rows * width):
        out.order[first + i] = -1
    return rows


@kernel
def collapse(nodes: wp.array(dtype=Bvh2Node), order: wp.array(dtype=wp.int32), options: CollapseOptions, trees: Subtrees,
             out: WideTree):
    """Write the wide tree in one thread, depth first, and its totals to out.count."""
    stack = wp.zeros(shape=wp.static(8 * STACK_SIZE), dtype=WideTask)
    root = WideTask()
    root.free_entries = options.stack
    root.depth = 1
    stack[0] = root
    size = int(1)
    n_nodes = int(1)
    out.count[1] = 0
    n_leaves = int(0)
    depth = int(0)
    while size > 0:
        size = size - 1
        task = stack[size]
        depth = wp.max(depth, task.depth)
        base = task.slot * options.width
        n = choose_roots(nodes, options, trees, task, out)
        free_entries = task.free_entries - (n - 1)
        for j in range(n):
            # The inner children of a node get consecutive slots. The last of them is popped first, so its children get the next slots.
            code = out.source[j]
            node = nodes[code / 2]
            side = code % 2
            c = first_of(node, side)
            count = child_size(trees, node, side)
            if count_of(node, side) > 0 or trees.choice[c * MAX_WIDTH] == wp.uint8(1):
                out.children[base + j] = leaf_reference(out.count[1], count)
                out.count[1] += write_rows(nodes, order, code, count, options.width, out)
                n_leaves = n_leaves + 1
            else:
                child = WideTask()
                child.node = c
                child.slot = n_nodes
                child.free_entries = free_entries
                child.depth = task.depth + 1
                out.children[base + j] = n_nodes
                stack[size] = child
                size = size + 1
                n_nodes = n_nodes + 1
        write_in_order(nodes, options, out, base, n)
    out.count[0] = n_nodes
    out.count[2] = n_leaves
    out.count[3] = depth
