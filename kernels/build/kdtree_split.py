"""The k-d tree's split: the plane of least cost by the surface area heuristic (SAH).
Wald and Havran 2006, "On building fast kd-Trees for Ray Tracing, and on doing that in O(N log N)". Every face of every reference's box is
a candidate, and a sweep over the sorted faces finds the best. Larger cells, above `perfect_below` references, are first split between bins
at the same costs (wrt.accel.cells.kdtree_build.binned_split)."""

import warp as wp

from wrt.kernels.build.shape import half_area


@wp.struct
class KdEvent:
    """A face of a reference's box."""

    position: float
    code: int  # 8 * index of the reference + 2 * axis + (1: the box begins, 0: it ends).


@wp.struct
class KdOptions:
    """When a cell becomes a leaf, and the SAH costs."""

    max_leaf: int  # A cell with so many references is a leaf.
    max_depth: int  # A cell at this depth is a leaf.
    by_cost: int  # 1: a cell is a leaf if no split costs less.
    cost_traversal: wp.float64
    cost_intersection: wp.float64
    empty_bonus: wp.float64  # Part of the cost that a split saves if it cuts off empty space.


@wp.struct
class KdTask:
    """A cell to build."""

    lo: wp.vec3
    hi: wp.vec3
    first: int  # First of its events.
    count: int  # Number of its events.
    budget: int  # Most references of its leaves; an empty leaf counts as one.
    depth: int
    slot: int  # Index of its node.


@wp.struct
class KdWork:
    """Scratch of one subtree of n references."""

    prim_id: wp.array(dtype=wp.int32)  # Of each reference, as side (n).
    lo: wp.array(dtype=wp.vec3)  # Boxes of the references in the root's cell: lo, hi (n).
    hi: wp.array(dtype=wp.vec3)
    side: wp.array(dtype=wp.uint8)
    events: wp.array(dtype=KdEvent)  # A stack of the events of all pending cells (6 budget).
    kept_left: wp.array(dtype=KdEvent)  # Events of one split, from here to scratch (6 n each).
    kept_right: wp.array(dtype=KdEvent)
    fresh_left: wp.array(dtype=KdEvent)
    fresh_right: wp.array(dtype=KdEvent)
    scratch: wp.array(dtype=KdEvent)


@wp.struct
class KdSplit:
    """A plane; axis < 0: none. References that straddle it count on both sides."""

    axis: int
    position: float
    cost: wp.float64
    n_left: int
    n_right: int


@wp.func
def split_cost(options: KdOptions, scale: wp.float64, face: wp.vec2d, below: wp.float64, above: wp.float64, left: wp.float64,
               right: wp.float64) -> wp.float64:
    """SAH cost of a plane with `left` and `right` references, at distances `below` and `above` from the cell's ends.
    Its `face` is the cell's extent along the two other axes; `scale` is the cost of a reference over the cell's half area. The host calls
    `split_cost.func` with arrays."""
    caps = face[0] * face[1]
    rim = face[0] + face[1]
    return options.cost_traversal + scale * ((below * rim + caps) * left + (above * rim + caps) * right)


@wp.func
def cheapest_split(work: KdWork, task: KdTask, options: KdOptions) -> KdSplit:
    """Find the plane of least expected cost whose references are within the budget; with by_cost, only one cheaper than a leaf."""
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
