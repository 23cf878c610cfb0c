"""The BSP builder, on the CPU: it splits cells, and clips their primitives, until no split is cheaper than a leaf.
The host launches it once for the top of the tree, which defers small cells. It then launches it on all cores for the deferred cells. A
launch works depth first, so that it stores only the pieces (clipped primitives) along one path."""

import warp as wp

from wrt.kernels.build.bsp_cell import Cells, box_cell, cell_area, clip_cell, copy_cell, crossing, plane_side
from wrt.kernels.build.bsp_split import (
    OUTWARDS,
    BspSplit,
    BspTools,
    Pieces,
    Scope,
    best_across,
    best_plane,
    extent_on,
    plane_tolerance,
    sides_of,
)
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bsp import INNER, STACK_SIZE, BspNode

MAX_CORNERS = wp.constant(16)  # a piece that would get more corners is not clipped further, and sticks out of its cell
CELL_SLOTS = STACK_SIZE + 1
CURRENT = wp.constant(STACK_SIZE)  # slot of the cell that is being split
DEFERRED = wp.constant(-2)  # `count` of a child that a later launch builds; `first` is its index in BspOutput.deferred

# Indices in BspOutput.results. FULL: 1 if an array was too short, and the output is unusable.
N_NODES = wp.constant(0)
N_ORDER = wp.constant(1)
N_DEFERRED = wp.constant(2)
DEPTH = wp.constant(3)
LEAVES = wp.constant(4)
FULL = wp.constant(5)
ROOT_FIRST = wp.constant(6)
ROOT_COUNT = wp.constant(7)
N_RESULTS = 8


@wp.struct
class BspTask:
    """A cell to build. It contains the pieces begin .. end - 1."""

    begin: int
    end: int
    points_end: int  # Index behind the last point of the pieces.
    parent: int  # Index of the parent node; < 0: the cell is the root.
    side: int  # Side of the parent's plane: 0 below, 1 above.
    depth: int  # Depth of the cell; the root's is 0.
    budget: int  # Largest sum of the numbers of references in all leaves of the cell.


@wp.struct
class BspOutput:
    """Results of a launch."""

    nodes: wp.array(dtype=BspNode)
    order: wp.array(dtype=wp.int32)  # prim_id of the primitives, leaf after leaf.
    deferred: wp.array(dtype=BspTask)  # Tasks for later launches.
    deferred_cells: Cells  # Cells of the deferred tasks.
    results: wp.array(dtype=wp.int32)  # N_RESULTS counts and flags.
    cost: wp.array(dtype=wp.float64)  # cost[0]: expected number of nodes and primitives that a line through the root box visits.


@wp.func
def copy_piece(source: Pieces, i: int, target: Pieces, to: int):
    """Copy all fields of piece i to piece `to`. The copy shares the points of piece i."""
    target.prim_id[to] = source.prim_id[i]
    target.first[to] = source.first[i]
    target.count[to] = source.count[i]
    target.lo[to] = source.lo[i]
    target.hi[to] = source.hi[i]
    target.ball[to] = source.ball[i]
    target.extent[to] = source.extent[i]


@wp.func
def clip_piece(pieces: Pieces, i: int, to: int, size: int, split: BspSplit, side: int) -> int:
    """Clip piece i to one side of a plane (0 below, 1 above), and store it as piece `to`, with its points from index `size` on.
    Return the index behind its last point."""
    copy_piece(pieces, i, pieces, to)
    count = pieces.count[i]
    first = pieces.first[i]
    zero = wp.float64(0.0)
    sign = wp.where(side == 0, wp.float64(-1.0), wp.float64(1.0))
    n = int(0)
    lo = wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))
    hi = -lo
    for k in range(count):
        p = pieces.points[first + k]
        q = pieces.points[first + (k + 1) % count]
        s_p = sign * plane_side(split.normal, split.offset, p)
        s_q = sign * plane_side(split.normal, split.offset, q)
        if n + 2 > MAX_CORNERS:
            return size
        if s_p >= zero:
            pieces.points[size + n] = p
            lo = wp.min(lo, p)
            hi = wp.max(hi, p)
            n = n + 1
        if (s_p >= zero) != (s_q >= zero):
            c = crossing(p, q, s_p, s_q)
            pieces.points[size + n] = c
            lo = wp.min(lo, c)
            hi = wp.max(hi, c)
            n = n + 1
    if n == 0:
        return size  # the piece is a sphere; spheres are not clipped
    center = wp.float64(0.5) * (lo + hi)
    radius = zero
    for k in range(n):
        radius = wp.max(radius, wp.length(pieces.points[size + k] - center))
    pieces.first[to] = size
    pieces.count[to] = n
    pieces.lo[to] = lo
    pieces.hi[to] = hi
    pieces.ball[to] = wp.vec4d(center[0], center[1], center[2], radius * OUTWARDS)
    return size + n


@wp.func
def scope_of(tools: BspTools, task: BspTask, slot: int) -> Scope:
    scope = Scope()
    scope.begin = task.begin
    scope.end = task.end
    scope.lo = wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))
    scope.hi = -scope.lo
    for i in range(task.begin, task.end):
        scope.lo = wp.min(scope.lo, tools.pieces.lo[i])
        scope.hi = wp.max(scope.hi, tools.pieces.hi[i])
        scope.extent = wp.max(scope.extent, tools.pieces.extent[i])
    scope.far = wp.max(wp.abs(scope.lo), wp.abs(scope.hi))
    scope.slot = slot
    scope.budget = task.budget
    scope.area = cell_area(tools.cells, slot)
    return scope


@wp.func
def choose(tools: BspTools, scope: Scope, depth: int) -> BspSplit:
    """Return the cheapest split of a cell at this depth; its axis is < 0 if no split is cheaper than a leaf."""
    best = BspSplit()
    best.axis = -1
    best.cost = tools.options.cost_intersection * wp.float64(scope.end - scope.begin)
    if depth < tools.options.max_depth and scope.area > wp.float64(0.0) and wp.isfinite(scope.area):
        best = best_across(tools, scope, best)
        best = best_plane(tools, scope, best)
    return best


@wp.func
def link(output: BspOutput, task: BspTask, first: int, count: int):
    """Store a cell's `first` and `count` (see BspNode and DEFERRED) in its parent node or, for the root, in output.results."""
    if task.parent < 0:
        output.results[ROOT_FIRST] = first
        output.results[ROOT_COUNT] = count
        return
    node = output.nodes[task.parent]
    if task.side == 0:
        node.first_0 = first
        node.count_0 = count
    else:
        node.first_1 = first
        node.count_1 = count
    output.nodes[task.parent] = node


@wp.func
def write_leaf(tools: BspTools, output: BspOutput, task: BspTask):
    n = output.results[N_ORDER]
    for i in range(task.begin, task.end):
        output.order[n + i - task.begin] = tools.pieces.prim_id[i]
    link(output, task, n, task.end - task.begin)
    output.results[N_ORDER] = n + task.end - task.begin
    output.results[LEAVES] += 1


@wp.func
def write_node(output: BspOutput, task: BspTask, split: BspSplit, tolerance: float) -> int:
    """Write an inner node, and return its index. Both children are empty leaves until `link` sets them."""
    index = output.results[N_NODES]
    node = BspNode()
    node.normal = wp.vec3(split.normal)
    node.offset = float(split.offset)
    node.tolerance = tolerance
    node.axis = split.axis
    output.nodes[index] = node
    link(output, task, index, INNER)
    output.results[N_NODES] = index + 1
    return index


@wp.func
def count_below(tools: BspTools, task: BspTask, split: BspSplit) -> int:
    """Return the number of the task's pieces that are listed below the plane."""
    n = int(0)
    for i in range(task.begin, task.end):
        sides = sides_of(extent_on(tools.pieces, i, split), split)
        if (sides & 1) == 1 or (sides == 0 and split.low_flat):
            n = n + 1
    return n


@wp.func
def divide(tools: BspTools, task: BspTask, split: BspSplit, base: int, middle: int, size: int) -> wp.vec2i:
    """Clip the task's pieces to both sides of the plane. Store lower pieces from index `base` on, upper pieces from `middle` on, and new
    points from `size` on. Return the indices behind the last piece and the last point; (-1, -1) if points do not fit."""
    pieces = tools.pieces
    low = int(base)
    high = int(middle)
    for i in range(task.begin, task.end):
        sides = sides_of(extent_on(pieces, i, split), split)
        if sides == 3:
            if size + 2 * MAX_CORNERS > pieces.points.shape[0]:
                return wp.vec2i(-1, -1)
            size = clip_piece(pieces, i, low, size, split, 0)
            size = clip_piece(pieces, i, high, size, split, 1)
            low = low + 1
            high = high + 1
        elif sides == 1 or (sides == 0 and split.low_flat):
            copy_piece(pieces, i, pieces, low)
            low = low + 1
        else:
            copy_piece(pieces, i, pieces, high)
            high = high + 1
    return wp.vec2i(high, size)


@wp.func
def start_pieces(source: Pieces, begin: int, end: int, target: Pieces) -> int:
    """Copy pieces begin .. end - 1 with their points to the front of `target`. Return the number of points, or -1 if they do not fit."""
    size = int(0)
    for i in range(begin, end):
        count = source.count[i]
        if i - begin >= target.prim_id.shape[0] or size + count > target.points.shape[0]:
            return -1
        copy_piece(source, i, target, i - begin)
        for k in range(count):
            target.points[size + k] = source.points[source.first[i] + k]
        target.first[i - begin] = size
        size = size + count
    return size


@wp.func
def start_root(task: BspTask, n_points: int) -> BspTask:
    """Make a launch's first task from `task`, for the pieces and the n_points points that start_pieces has copied."""
    task.end = task.end - task.begin
    task.begin = 0
    task.points_end = n_points
    task.parent = -1
    return task


@wp.func
def defer(tools: BspTools, output: BspOutput, task: BspTask, slot: int):
    """Append the cell in slot `slot` of tools.cells, with its task, to the deferred cells for a later launch."""
    left = output.results[N_DEFERRED]
    output.deferred[left] = task
    copy_cell(tools.cells, slot, output.deferred_cells, left)
    link(output, task, left, DEFERRED)
    output.results[N_DEFERRED] = left + 1


@wp.func
def child_of(task: BspTask, index: int, side: int, pieces: wp.vec3i, points_end: int) -> BspTask:
    """Make the task of side `side` (0 below, 1 above) of node `index`, with the pieces from index pieces[side] to pieces[side + 1] - 1."""
    child = BspTask()
    child.begin = pieces[side]
    child.end = pieces[side + 1]
    child.points_end = points_end
    child.parent = index
    child.side = side
    child.depth = task.depth + 1
    child.budget = int(wp.int64(task.budget) * wp.int64(child.end - child.begin) / wp.int64(pieces[2] - pieces[0]))
    return child


@wp.func
def clip_to_side(cells: Cells, split: BspSplit, side: int, to: int):
    """Clip the cell in slot CURRENT to one side of the plane, and store it in slot `to`."""
    sign = wp.where(side == 0, wp.float64(-1.0), wp.float64(1.0))
    clip_cell(cells, CURRENT, to, sign * split.normal, sign * split.offset, split.pad)


@kernel
def build_cells(source: Pieces, tasks: wp.array(dtype=BspTask), cells: Cells, which: int, tools: BspTools,
                stack: wp.array(dtype=BspTask), output: BspOutput):
    """Build the subtree of tasks[which]. Slot `which` of `cells` has the task's cell; at depth 0, the cell is the root box."""
    keep = tools.options.keep
    size = start_pieces(source, tasks[which].begin, tasks[which].end, tools.pieces)
    if size < 0:
        output.results[FULL] = 1
        return
    box_cell(tools.cells, 0, tools.options.lo, tools.options.hi)
    root_area = cell_area(tools.cells, 0)
    if tasks[which].depth > 0:
        copy_cell(cells, which, tools.cells, 0)
    stack[0] = start_root(tasks[which], size)
    waiting = int(1)
    used = int(stack[0].end)
    while waiting > 0:
        waiting = waiting - 1
        task = stack[waiting]
        output.results[DEPTH] = wp.max(output.results[DEPTH], task.depth)
        n = task.end - task.begin
        if n <= keep and output.results[N_DEFERRED] < output.deferred.shape[0]:
            defer(tools, output, task, waiting)
            continue
        copy_cell(tools.cells, waiting, tools.cells, CURRENT)
        scope = scope_of(tools, task, CURRENT)
        share = wp.where(root_area > wp.float64(0.0), scope.area / root_area, wp.float64(1.0))
        split = choose(tools, scope, task.depth)
        if split.axis < 0:
            if output.results[N_ORDER] + n > output.order.shape[0]:
                output.results[FULL] = 1
                return
            output.cost[0] += share * wp.float64(n)
            write_leaf(tools, output, task)
            continue

        # The pieces of deferred cells must stay. If no cells are deferred, the pieces behind this cell's own are free.
        base = wp.where(keep > 0, used, task.end)
        if keep == 0:
            size = task.points_end
        if base + 2 * n > tools.pieces.prim_id.shape[0] or output.results[N_NODES] == output.nodes.shape[0]:
            output.results[FULL] = 1
            return
        middle = base + count_below(tools, task, split)
        ends = divide(tools, task, split, base, middle, size)
        if ends[0] < 0:
            output.results[FULL] = 1
            return
        used = ends[0]
        size = ends[1]
        output.cost[0] += share
        index = write_node(output, task, split, plane_tolerance(split, scope))
        for side in range(2):
            child = child_of(task, index, side, wp.vec3i(base, middle, used), size)
            if child.end > child.begin:
                clip_to_side(tools.cells, split, side, waiting)
                stack[waiting] = child
                waiting = waiting + 1
