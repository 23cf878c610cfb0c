"""The k-d tree's split: the plane that the surface area heuristic (SAH) calls cheapest.

Wald and Havran 2006, "On building fast kd-Trees for Ray Tracing, and on doing that in O(N log N)": every face of every
reference's box is a candidate, and a sweep over the sorted faces finds the best. Cells of more than `perfect_below` references
are split between bins before, at the same costs: wrt.accel.cells.kdtree_build.binned_split.
"""

import warp as wp

from wrt.kernels.build.shape import half_area


@wp.struct
class KdEvent:
    """A face of a reference's box. code = 8 * (number of the reference) + 2 * axis + (1 where the box begins, 0: ends)."""

    position: float
    code: int


@wp.struct
class KdOptions:
    """A cell becomes a leaf with max_leaf references, at max_depth, or (by_cost) where no split costs less. empty_bonus: part
    of its cost that a split is let off which cuts off empty space."""

    max_leaf: int
    max_depth: int
    by_cost: int
    cost_traversal: wp.float64
    cost_intersection: wp.float64
    empty_bonus: wp.float64


@wp.struct
class KdTask:
    """A cell to build. first, count: its events; budget: leaves' references (an empty leaf counts as one) that it may come to
    in the end; slot: its node."""

    lo: wp.vec3
    hi: wp.vec3
    first: int
    count: int
    budget: int
    depth: int
    slot: int


@wp.struct
class KdWork:
    """Memory of one subtree of n references. prim_id (n), side (n): of each; lo, hi (n): their boxes in the root's cell; events
    (6 budget): a stack of the lists of all cells that wait; kept_*, fresh_*, scratch (6 n each): the lists of one split."""

    prim_id: wp.array(dtype=wp.int32)
    lo: wp.array(dtype=wp.vec3)
    hi: wp.array(dtype=wp.vec3)
    side: wp.array(dtype=wp.uint8)
    events: wp.array(dtype=KdEvent)
    kept_left: wp.array(dtype=KdEvent)
    kept_right: wp.array(dtype=KdEvent)
    fresh_left: wp.array(dtype=KdEvent)
    fresh_right: wp.array(dtype=KdEvent)
    scratch: wp.array(dtype=KdEvent)


@wp.struct
class KdSplit:
    """axis < 0: none. n_left, n_right: references on each side, those that straddle the plane on both."""

    axis: int
    position: float
    cost: wp.float64
    n_left: int
    n_right: int


@wp.func
def split_cost(options: KdOptions, scale: wp.float64, face: wp.vec2d, below: wp.float64, above: wp.float64, left: wp.float64,
               right: wp.float64) -> wp.float64:
    """Of a plane across an axis with so many references on each side, `below` and `above` it so far to the cell's ends. face: the
    cell's extent along the two other axes; scale: the cost of a reference over the cell's half area.

    The host takes it too, of arrays: `split_cost.func`.
    """
    caps = face[0] * face[1]
    rim = face[0] + face[1]
    return options.cost_traversal + scale * ((below * rim + caps) * left + (above * rim + caps) * right)


@wp.func
def cheapest_split(work: KdWork, task: KdTask, options: KdOptions) -> KdSplit:
    """The plane of least expected cost, if (by_cost) it is below the cost of a leaf and the references are in the budget."""
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
