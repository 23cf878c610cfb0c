"""The k-d tree builder's inner loop, on the CPU: it builds a subtree by the surface area heuristic, trying all planes.
Wald and Havran 2006 (kernels.build.kdtree_split). The faces of the references' boxes are events. They are sorted once per subtree, and a
sweep over them finds the best plane. A split preserves the order of events. References that straddle the plane are clipped to both cells.
The events of the clipped references are sorted and merged with the other events. The host launches one subtree per task, on all cores."""

import warp as wp

from wrt.kernels.build.clip import Clippable, clip_to_cell
from wrt.kernels.build.kdtree_split import KdEvent, KdOptions, KdSplit, KdTask, KdWork, cheapest_split
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.kdtree import LEAF, STACK_SIZE, KdNode
from wrt.kernels.units.box import half_area

BOTH = wp.constant(wp.uint8(0))
LEFT = wp.constant(wp.uint8(1))
RIGHT = wp.constant(wp.uint8(2))
RUN = wp.constant(8)  # length of the runs of events that are sorted by insertion, then merged


@wp.struct
class KdTotals:
    """Totals of a subtree."""

    nodes: int
    leaves: int
    references: int
    depth: int  # Number of nodes on the longest path.
    cost: wp.float64  # Sum of half surface areas: of each inner node, and of each leaf times its number of references.


@wp.struct
class KdOutput:
    """The output of build_subtree; `budget` is KdTask.budget of the subtree."""

    nodes: wp.array(dtype=KdNode)  # Length 2 * budget; the root first.
    references: wp.array(dtype=wp.int32)  # Length `budget`; prim_id of the primitives, leaf after leaf.
    totals: wp.array(dtype=KdTotals)  # Length 1.


@wp.func
def before(a: KdEvent, b: KdEvent) -> bool:
    """Test whether a precedes b in the sweep: by position, then by axis, with ends before begins."""
    return a.position < b.position or (a.position == b.position and (a.code & 7) < (b.code & 7))


@wp.func
def merge(a: wp.array(dtype=KdEvent), range_a: wp.vec2i, b: wp.array(dtype=KdEvent), range_b: wp.vec2i,
          out: wp.array(dtype=KdEvent), first: int):
    """Merge the sorted ranges (begin, end) of a and b, and write the result to `out` from index `first` on."""
    i = int(range_a[0])
    j = int(range_b[0])
    k = int(first)
    while i < range_a[1] or j < range_b[1]:
        take_b = i >= range_a[1]
        if not take_b and j < range_b[1]:
            take_b = before(b[j], a[i])
        if take_b:
            out[k] = b[j]
            j = j + 1
        else:
            out[k] = a[i]
            i = i + 1
        k = k + 1


@wp.func
def sort(events: wp.array(dtype=KdEvent), first: int, count: int, scratch: wp.array(dtype=KdEvent)):
    """Sort events[first : first + count]: sort runs of RUN events by insertion, then merge them. The array `scratch` is overwritten."""
    for run in range((count + RUN - 1) / RUN):
        begin = first + run * RUN
        for i in range(begin + 1, wp.min(begin + RUN, first + count)):
            event = events[i]
            j = int(i)
            while j > begin and before(event, events[wp.max(j - 1, begin)]):
                events[j] = events[j - 1]
                j = j - 1
            events[j] = event
    width = int(RUN)
    while width < count:
        for pair in range((count + 2 * width - 1) / (2 * width)):
            begin = first + pair * 2 * width
            middle = wp.min(begin + width, first + count)
            end = wp.min(middle + width, first + count)
            if middle < end and before(events[middle], events[middle - 1]):
                # Only the left run is copied to scratch: the merge never overwrites an event of the right run before it is read.
                for i in range(begin, middle):
                    scratch[i - begin] = events[i]
                merge(scratch, wp.vec2i(0, middle - begin), events, wp.vec2i(middle, end), events, begin)
        width = 2 * width


@wp.func
def add_events(events: wp.array(dtype=KdEvent), count: int, lo: wp.vec3, hi: wp.vec3, reference: int) -> int:
    """Write the six events of a reference's box, one per face, to `events` from index `count` on; return count + 6."""
    event = KdEvent()
    for axis in range(3):
        event.position = hi[axis]
        event.code = reference * 8 + 2 * axis
        events[count + 2 * axis] = event
        event.position = lo[axis]
        event.code = reference * 8 + 2 * axis + 1
        events[count + 2 * axis + 1] = event
    return count + 6


@wp.func
def moved(corner: wp.vec3, split: KdSplit) -> wp.vec3:
    """Return a corner of the cell with its coordinate along split.axis replaced by the splitting plane's."""
    out = corner
    out[split.axis] = split.position
    return out


@wp.func
def mark_sides(work: KdWork, task: KdTask, split: KdSplit):
    """Store in work.side whether each reference is LEFT or RIGHT of the plane or on BOTH sides.
    Every box has a volume, so the event where it begins comes before the event where it ends."""
    begins = 2 * split.axis + 1
    for i in range(task.first, task.first + task.count):
        event = work.events[i]
        kind = event.code & 7
        if kind == begins:
            work.side[event.code >> 3] = wp.where(event.position >= split.position, RIGHT, BOTH)
        elif kind == begins - 1:
            if event.position <= split.position:
                work.side[event.code >> 3] = LEFT


@wp.func
def divide(shapes: Clippable, work: KdWork, task: KdTask, split: KdSplit) -> wp.vec2i:
    """Replace a task's events by the events of the right child, then of the left child; return the numbers of events (right, left)."""
    middle_hi = moved(task.hi, split)
    middle_lo = moved(task.lo, split)
    kept_left = int(0)
    kept_right = int(0)
    fresh_left = int(0)
    fresh_right = int(0)
    for i in range(task.first, task.first + task.count):
        event = work.events[i]
        reference = event.code >> 3
        side = work.side[reference]
        if side == LEFT:
            work.kept_left[kept_left] = event
            kept_left = kept_left + 1
        elif side == RIGHT:
            work.kept_right[kept_right] = event
            kept_right = kept_right + 1
        elif (event.code & 7) == 1:  # one of six events of a reference that straddles the plane: the begin on axis 0
            box = clip_to_cell(shapes, work.prim_id[reference], task.lo, middle_hi)
            if box.lo[0] < box.hi[0]:
                fresh_left = add_events(work.fresh_left, fresh_left, box.lo, box.hi, reference)
            box = clip_to_cell(shapes, work.prim_id[reference], middle_lo, task.hi)
            if box.lo[0] < box.hi[0]:
                fresh_right = add_events(work.fresh_right, fresh_right, box.lo, box.hi, reference)
    sort(work.fresh_left, 0, fresh_left, work.scratch)
    sort(work.fresh_right, 0, fresh_right, work.scratch)
    n_right = kept_right + fresh_right
    merge(work.kept_right, wp.vec2i(0, kept_right), work.fresh_right, wp.vec2i(0, fresh_right), work.events, task.first)
    merge(work.kept_left, wp.vec2i(0, kept_left), work.fresh_left, wp.vec2i(0, fresh_left), work.events, task.first + n_right)
    return wp.vec2i(n_right, kept_left + fresh_left)


@wp.func
def write_leaf(out: KdOutput, work: KdWork, task: KdTask, totals: KdTotals) -> KdTotals:
    node = KdNode()
    node.split = float(task.count / 6)
    node.word = 4 * totals.references + LEAF
    out.nodes[task.slot] = node
    for i in range(task.first, task.first + task.count):
        event = work.events[i]
        if (event.code & 7) == 1:
            out.references[totals.references] = work.prim_id[event.code >> 3]
            totals.references += 1
    totals.leaves += 1
    totals.cost += half_area(wp.vec3d(task.hi) - wp.vec3d(task.lo)) * wp.float64(task.count / 6)
    totals.depth = wp.max(totals.depth, task.depth + 1)
    return totals


@kernel
def build_subtree(shapes: Clippable, work: KdWork, root: KdTask, options: KdOptions, out: KdOutput):
    """Build the subtree of the cell `root`, whose references are in `work`, in one thread."""
    stack = wp.zeros(shape=wp.static(STACK_SIZE + 2), dtype=KdTask)
    count = int(0)
    for i in range(work.prim_id.shape[0]):
        count = add_events(work.events, count, work.lo[i], work.hi[i], i)
    sort(work.events, 0, count, work.scratch)
    task = root
    task.count = count
    stack[0] = task
    size = int(1)
    totals = KdTotals()
    totals.nodes = 1
    while size > 0:
        size = size - 1
        task = stack[size]
        split = KdSplit()
        split.axis = -1
        if task.count > 6 * options.max_leaf and task.depth < options.max_depth:
            split = cheapest_split(work, task, options)
        if split.axis < 0:
            totals = write_leaf(out, work, task, totals)
            continue
        mark_sides(work, task, split)
        counts = divide(shapes, work, task, split)
        node = KdNode()
        node.split = split.position
        node.word = 4 * totals.nodes + split.axis
        out.nodes[task.slot] = node
        totals.cost += half_area(wp.vec3d(task.hi) - wp.vec3d(task.lo))

        # Each child's budget is its number of references, plus a proportional part of what remains of the cell's budget.
        left = wp.max(split.n_left, 1)
        right = wp.max(split.n_right, 1)
        spare = wp.float64(task.budget - left - right) * (wp.float64(right) / wp.float64(left + right))
        child = task
        child.depth = task.depth + 1
        child.slot = totals.nodes + 1
        child.count = counts[0]
        child.budget = right + int(spare)
        child.lo = moved(task.lo, split)
        stack[size] = child
        child.slot = totals.nodes
        child.first = task.first + counts[0]
        child.count = counts[1]
        child.budget = task.budget - (right + int(spare))
        child.lo = task.lo
        child.hi = moved(task.hi, split)
        stack[size + 1] = child
        size = size + 2
        totals.nodes += 2
    out.totals[0] = totals
