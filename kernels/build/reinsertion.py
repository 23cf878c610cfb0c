"""The inner loops that optimise a binary BVH by reinsertion, on the CPU.
Meister and Bittner 2018, "Parallel Reinsertion for Bounding Volume Hierarchy Optimization". A subtree is removed together with its parent
node, and inserted where the sum of all boxes' areas becomes smallest. All cores search places for many subtrees in the same tree. Then one
thread makes the moves, the best first, and skips moves that conflict with an earlier one."""

import warp as wp

from wrt.kernels.build.records import BuildOptions, row_count
from wrt.kernels.structs import kernel
from wrt.kernels.units.box import half_area

QUEUE = 96
QUEUE_SIZE = wp.constant(QUEUE)
Six = wp.types.vector(6, wp.int32)


@wp.struct
class Link:
    """A node of the tree during the optimisation."""

    left: int  # -1: a leaf.
    right: int
    parent: int  # -1: the root.
    lo: wp.vec3
    hi: wp.vec3


@wp.struct
class Move:
    """The move of the subtree `node`, which makes `target` its sibling."""

    node: int
    target: int
    gain: float  # Decrease of the sum of areas; 0: the subtree stays.


@wp.func
def area_of(lo: wp.vec3, hi: wp.vec3, scale: float) -> float:
    return half_area((0.5 * hi - 0.5 * lo) * scale)


@wp.func
def joined_area(a: Link, b: Link, scale: float) -> float:
    return area_of(wp.min(a.lo, b.lo), wp.max(a.hi, b.hi), scale)


@kernel
def find_moves(links: wp.array(dtype=Link), moves: wp.array(dtype=Move), first: int, scale: float):
    """Find the best target for the node of move first + tid, by branch and bound over the rest of the tree (section 3.1).
    The search visits the sibling subtree of the node and of each ancestor, upwards. The variable `saved` is the area by which the boxes up
    to this ancestor shrink without the node. An insertion costs the area of the new parent's box, and the growth of the boxes above it."""
    i = first + wp.tid()
    move = moves[i]
    node = links[move.node]
    best = float(0.0)
    target = int(-1)
    parent = links[node.parent]
    own_area = area_of(node.lo, node.hi, scale)
    saved = area_of(parent.lo, parent.hi, scale)  # the parent node is removed
    pivot = int(node.parent)
    child = int(move.node)
    # lo, hi: box of the pivot without the node.
    lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    stack = wp.zeros(shape=wp.static(QUEUE), dtype=wp.int32)
    bound = wp.zeros(shape=wp.static(QUEUE), dtype=wp.float32)
    while True:
        sibling = wp.where(links[pivot].left == child, links[pivot].right, links[pivot].left)
        stack[0] = sibling
        bound[0] = saved
        size = int(1)
        while size > 0:
            size = size - 1
            left = bound[size]
            if left - own_area <= best:
                continue
            at = stack[size]
            place = links[at]
            joined = joined_area(place, node, scale)
            gain = left - joined
            # With its old sibling as target, the move would change nothing.
            if gain > best and not (pivot == node.parent and at == sibling):
                best = gain
                target = at
            if place.left >= 0 and size + 2 <= QUEUE_SIZE:
                below = gain + area_of(place.lo, place.hi, scale)
                if below - own_area > best:
                    stack[size] = place.left
                    bound[size] = below
                    stack[size + 1] = place.right
                    bound[size + 1] = below
                    size = size + 2
        lo = wp.min(lo, links[sibling].lo)
        hi = wp.max(hi, links[sibling].hi)
        child = pivot
        pivot = links[pivot].parent
        if pivot < 0:
            break
        if links[child].parent >= 0 and child != node.parent:
            # Without the node, the box of `child` shrinks to lo .. hi.
            saved = saved + area_of(links[child].lo, links[child].hi, scale) - area_of(lo, hi, scale)
    move.target = target
    move.gain = wp.where(target >= 0, best, 0.0)
    moves[i] = move


@wp.func
def replace_child(links: wp.array(dtype=Link), parent: int, old: int, new: int):
    if links[parent].left == old:
        links[parent].left = new
    else:
        links[parent].right = new
    links[new].parent = parent


@wp.func
def refit_up(links: wp.array(dtype=Link), areas: wp.array(dtype=wp.float32), start: int, scale: float):
    """Refit boxes and areas from a node towards the root; stop at the first box that does not change."""
    i = int(start)
    while i >= 0:
        link = links[i]
        left = links[link.left]
        right = links[link.right]
        lo = wp.min(left.lo, right.lo)
        hi = wp.max(left.hi, right.hi)
        if lo == link.lo and hi == link.hi:
            break
        links[i].lo = lo
        links[i].hi = hi
        areas[i] = area_of(lo, hi, scale)
        i = link.parent


@kernel
def make_moves(links: wp.array(dtype=Link), areas: wp.array(dtype=wp.float32), moves: wp.array(dtype=Move),
               touched: wp.array(dtype=wp.uint8), scale: float):
    """Make the moves in order. Skip a move that involves a node of an earlier move (touched); a later round may find it again."""
    for m in range(moves.shape[0]):
        move = moves[m]
        if move.gain > 0.0:
            node = move.node
            target = move.target
            parent = links[node].parent
            sibling = wp.where(links[parent].left == move.node, links[parent].right, links[parent].left)
            grandparent = links[parent].parent
            above = links[target].parent
            involved = Six(move.node, parent, sibling, move.target, grandparent, above)
            taken = int(0)
            for k in range(6):
                taken += int(touched[involved[k]])
            # An earlier move may have put the target into the node's subtree: then i ends at move.node, else below 0.
            i = int(move.target)
            while i >= 0 and i != move.node:
                i = links[i].parent
            if taken == 0 and i < 0 and move.target != parent and move.target != sibling:
                for k in range(6):
                    touched[involved[k]] = wp.uint8(1)
                replace_child(links, grandparent, parent, sibling)
                refit_up(links, areas, grandparent, scale)
                above = links[target].parent
                replace_child(links, above, move.target, parent)
                links[parent].left = move.node
                links[parent].right = move.target
                links[node].parent = parent
                links[target].parent = parent
                links[parent].lo = wp.min(links[node].lo, links[target].lo)
                links[parent].hi = wp.max(links[node].hi, links[target].hi)
                areas[parent] = area_of(links[parent].lo, links[parent].hi, scale)
                refit_up(links, areas, above, scale)


@wp.struct
class Walk:
    """Scratch of walks over the tree."""

    order: wp.array(dtype=wp.int32)  # Node indices, parents before children.
    level: wp.array(dtype=wp.int32)  # Level of each node; the root's is 1.
    count: wp.array(dtype=wp.int32)  # Number of records in each subtree.
    cost: wp.array(dtype=wp.float32)  # SAH cost of each subtree.
    depth: wp.array(dtype=wp.int32)  # depth[0]: number of inner nodes on the longest path.


@kernel
def order_nodes(links: wp.array(dtype=Link), walk: Walk):
    """Store the nodes in depth-first order, left before right, in walk.order; store walk.level and walk.depth."""
    stack = int(walk.order.shape[0])  # the end of walk.order is the stack: stack and finished nodes together always fit
    stack = stack - 1
    walk.order[stack] = 0
    walk.level[0] = 1
    done = int(0)
    while stack < walk.order.shape[0]:
        i = walk.order[stack]
        stack = stack + 1
        walk.order[done] = i
        done = done + 1
        link = links[i]
        if link.left >= 0:
            walk.depth[0] = wp.max(walk.depth[0], walk.level[i])
            walk.level[link.left] = walk.level[i] + 1
            walk.level[link.right] = walk.level[i] + 1
            stack = stack - 2
            walk.order[stack + 1] = link.right
            walk.order[stack] = link.left


@kernel
def choose_leaves(links: wp.array(dtype=Link), walk: Walk, options: BuildOptions, scale: float):
    """From the bottom up, turn each subtree into a leaf if that costs no more. To mark such a subtree, set its root's left to -2 - left."""
    n = walk.order.shape[0]
    for k in range(n):
        i = walk.order[n - 1 - k]
        link = links[i]
        area = area_of(link.lo, link.hi, scale)
        if link.left < 0:
            walk.count[i] = 1
            walk.cost[i] = options.cost_intersection * area
        else:
            walk.count[i] = walk.count[link.left] + walk.count[link.right]
            cost = options.cost_traversal * area + walk.cost[link.left] + walk.cost[link.right]
            whole = options.cost_intersection * row_count(options, walk.count[i]) * area
            walk.cost[i] = cost
            if walk.count[i] <= options.max_leaf and not cost < whole and i > 0:
                walk.cost[i] = whole
                links[i].left = -2 - link.left
