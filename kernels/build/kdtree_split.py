"""The k-d tree's split: the plane of least cost by the surface area heuristic (SAH).
Wald and Havran 2006, "On building fast kd-Trees for Ray Tracing, and on doing that in O(N log N)". The candidates are all faces of the
references' boxes; a sweep over the sorted faces finds the best. The host splits cells with more than
`perfect_below` references between bins, at the same costs (wrt.accel.cells.kdtree_build.binned_split)."""

import warp as wp

from wrt.kernels.units.box import half_area


@wp.struct
class KdEvent:
    """A face of a reference's box."""

    position: float
    code: int  # 8 * index of the reference + 2 * axis + (1: the box begins, 0: it ends).


@wp.struct
class KdOptions:
    """Conditions under which a cell becomes a leaf, and the SAH costs."""

    max_leaf: int  # A cell with at most max_leaf references becomes a leaf.
    max_depth: int  # A cell at the depth max_depth becomes a leaf.
    by_cost: int  # 1: a cell becomes a leaf if no split costs less than the leaf.
    cost_traversal: wp.float64
    cost_intersection: wp.float64
    empty_bonus: wp.float64  # Fraction by which the cost of a split is reduced if one side is empty.


@wp.struct
class KdTask:
    """A cell to build."""

    lo: wp.vec3
    hi: wp.vec3
    first: int  # Index of the cell's first event.
    count: int  # Number of the cell's events: six per reference.
    budget: int  # Largest sum of the numbers of references in all leaves of the cell; an empty leaf counts as one.
    depth: int
    slot: int  # Index of the cell's node.


@wp.struct
class KdWork:
    """Input and scratch of one subtree: prim_id, lo, hi and side have an entry for each of n references."""

    prim_id: wp.array(dtype=wp.int32)
    lo: wp.array(dtype=wp.vec3)  # lo, hi: boxes of the references, clipped to the root's cell.
    hi: wp.array(dtype=wp.vec3)
    side: wp.array(dtype=wp.uint8)  # Scratch: side of the plane (kdtree.mark_sides).
    events: wp.array(dtype=KdEvent)  # The events of all pending cells, as a stack; length 6 * budget.
    kept_left: wp.array(dtype=KdEvent)  # From here on: scratch of a split, length 6 n. kept: copied; fresh: of clipped references.
    kept_right: wp.array(dtype=KdEvent)
    fresh_left: wp.array(dtype=KdEvent)
    fresh_right: wp.array(dtype=KdEvent)
    scratch: wp.array(dtype=KdEvent)


@wp.struct
class KdSplit:
    """A splitting plane; axis < 0: no split. References that straddle the plane count in both n_left and n_right."""

    axis: int
    position: float
    cost: wp.float64
    n_left: int
    n_right: int


@wp.func
def split_cost(options: KdOptions, scale: wp.float64, face: wp.vec2d, below: wp.float64, above: wp.float64, left: wp.float64,
               right: wp.float64) -> wp.float64:
    """Return the SAH cost of a plane at the distances `below` and `above` from the cell's ends, with `left` and `right` references.
    The pair `face` is the cell's extent along the two other axes; `scale` is cost_intersection divided by the cell's half surface area. The
    host calls `split_cost.func` with arrays."""
    caps = face[0] * face[1]
    rim = face[0] + face[1]
    return options.cost_traversal + scale * ((below * rim + caps) * left + (above * rim + caps) * right)


@wp.func
def cheapest_split(work: KdWork, task: KdTask, options: KdOptions) -> KdSplit:
    """Find the plane of least SAH cost with at most task.budget references in total. With by_cost, it must be cheaper than a leaf."""
    best = KdSplit()
    best.axis = -1
    n = task.count / 6
    best.cost = wp.where(options.by_cost != 0, options.cost_intersection * wp.float64(n), wp.float64(wp.inf))
    e = wp.vec3d(task.hi) - wp.vec3d(task.lo)
    scale = options.cost_intersection / half_area(e)
    n_left = wp.vec3i(0, 0, 0)
    n_right = wp.vec3i(n, n, n)
    end = task.first + task.count
    i = int(task.first)
    while i < end:
        event = work.events[i]
        position = event.position
        axis = (event.code & 7) >> 1
        starts = int(0)
        ends = int(0)
        same = bool(True)
        while same:  # all faces in this plane
            starts = starts + (event.code & 1)
            ends = ends + 1 - (event.code & 1)
            i = i + 1
            same = i < end
            if same:
                event = work.events[i]
                same = event.position == position and (event.code & 7) >> 1 == axis
        right = n_right[axis] - ends
        n_right[axis] = right
        left = n_left[axis]
        n_left[axis] = left + starts
        if position > task.lo[axis] and position < task.hi[axis] and wp.max(left, 1) + wp.max(right, 1) <= task.budget:
            face = wp.vec2d(e[(axis + 1) % 3], e[(axis + 2) % 3])
            below = wp.float64(position) - wp.float64(task.lo[axis])
            above = wp.float64(task.hi[axis]) - wp.float64(position)
            cost = split_cost(options, scale, face, below, above, wp.float64(left), wp.float64(right))
            if left == 0 or right == 0:
                cost = cost * (wp.float64(1.0) - options.empty_bonus)
            if cost < best.cost:
                best.axis = axis
                best.position = position
                best.cost = cost
                best.n_left = left
                best.n_right = right
    return best
