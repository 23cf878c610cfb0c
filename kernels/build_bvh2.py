"""The builder's inner loop: binned SAH over ranges of primitives, on the CPU backend.

Wald 2007, "On fast Construction of SAH-based Bounding Volume Hierarchies": the centroids of a range fall into bins along each
axis, and the split between two bins that costs least is taken. A range is split in place, so that in the end the records
stand in the order of the leaves. The host launches it once for the top of the tree and then once a subtree, on all cores.
"""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.traverse_bvh2 import STACK_SIZE, Bvh2Node

BINS = wp.constant(16)
# From here on a range is halved by number, which takes ceil(log2(n)) more levels, whatever the SAH would like.
MAX_DEPTH = wp.constant(STACK_SIZE - 2)


@wp.struct
class BuildRecord:
    """A primitive's box and which one it is."""

    lo: wp.vec3
    hi: wp.vec3
    prim_id: int


@wp.struct
class BuildTask:
    """A range of records that becomes the inner node `slot`, with the box of their centroids."""

    begin: int
    end: int
    slot: int
    depth: int


@wp.struct
class BuildOptions:
    """Leaves hold at most max_leaf primitives; the costs are those of the surface area heuristic."""

    max_leaf: int
    cost_traversal: float
    cost_intersection: float


@wp.struct
class Split:
    """The chosen split: records whose bin along `axis` is below `bin` go left. axis < 0: by number."""

    axis: int
    bin: int
    origin: float
    scale: float
    cost: float


@wp.func
def half_area(lo: wp.vec3, hi: wp.vec3) -> float:
    """Half the surface of a box; 0 for an empty one."""
    e = wp.max(hi - lo, wp.vec3(0.0, 0.0, 0.0))
    return e[0] * e[1] + e[1] * e[2] + e[2] * e[0]


@wp.func
def centroid(record: BuildRecord, axis: int) -> float:
    return 0.5 * record.lo[axis] + 0.5 * record.hi[axis]


@wp.func
def bin_of(record: BuildRecord, split: Split) -> int:
    """Binning and partition call this one function, so that they agree to the last bit."""
    return wp.clamp(int((centroid(record, split.axis) - split.origin) * split.scale), 0, BINS - 1)


@wp.func
def levels(n: int) -> int:
    """ceil(log2(n)): the depth of a balanced tree over n primitives."""
    result = int(0)
    while (1 << result) < n:
        result = result + 1
    return result


@wp.func
def split_axis(records: wp.array(dtype=BuildRecord), begin: int, end: int, axis: int, split: Split) -> Split:
    """The cheaper of `split` and the best split along `axis`. Cost: sum of (half area x count) over both sides."""
    low = float(wp.inf)
    high = float(-wp.inf)
    for i in range(begin, end):
        c = centroid(records[i], axis)
        low = wp.min(low, c)
        high = wp.max(high, c)
    trial = Split()
    trial.axis = axis
    trial.origin = low
    trial.scale = float(BINS) * 0.999999 / (high - low)
    # Not separable: one point, or so close together (or so far apart) that the scale over- or underflows.
    if not (high > low) or not wp.isfinite(trial.scale) or trial.scale == 0.0:
        return split

    count = wp.zeros(shape=16, dtype=wp.int32)
    lo = wp.zeros(shape=16, dtype=wp.vec3)
    hi = wp.zeros(shape=16, dtype=wp.vec3)
    for b in range(BINS):
        lo[b] = wp.vec3(wp.inf, wp.inf, wp.inf)
        hi[b] = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for i in range(begin, end):
        record = records[i]
        b = bin_of(record, trial)
        count[b] = count[b] + 1
        lo[b] = wp.min(lo[b], record.lo)
        hi[b] = wp.max(hi[b], record.hi)

    right_cost = wp.zeros(shape=16, dtype=wp.float32)
    side_lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    side_hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    n = int(0)
    for k in range(BINS - 1):
        b = BINS - 1 - k
        side_lo = wp.min(side_lo, lo[b])
        side_hi = wp.max(side_hi, hi[b])
        n = n + count[b]
        right_cost[b] = half_area(side_lo, side_hi) * float(n)
        if n == 0:
            right_cost[b] = float(wp.inf)
    side_lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    side_hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    n = int(0)
    for b in range(1, BINS):
        side_lo = wp.min(side_lo, lo[b - 1])
        side_hi = wp.max(side_hi, hi[b - 1])
        n = n + count[b - 1]
        cost = half_area(side_lo, side_hi) * float(n) + right_cost[b]
        if n > 0 and cost < split.cost:
            trial.bin = b
            trial.cost = cost
            split = trial
    return split


@wp.func
def partition(records: wp.array(dtype=BuildRecord), begin: int, end: int, split: Split) -> int:
    """Left records to the front; the first of the right ones."""
    if split.axis < 0:
        return begin + (end - begin) / 2
    i = int(begin)
    j = int(end)
    while i < j:
        record = records[i]
        if bin_of(record, split) < split.bin:
            i = i + 1
        else:
            j = j - 1
            records[i] = records[j]
            records[j] = record
    return i


@kernel
def build_ranges(
    records: wp.array(dtype=BuildRecord),
    nodes: wp.array(dtype=Bvh2Node),
    used: wp.array(dtype=wp.uint8),
    tasks: wp.array(dtype=BuildTask),
    first_task: int,
    options: BuildOptions,
    stop_size: int,
    left_over: wp.array(dtype=BuildTask),
    n_left_over: wp.array(dtype=wp.int32),
    max_depth: wp.array(dtype=wp.int32),
):
    """Build the subtree of one task, down to ranges of at most stop_size records, which are listed in left_over.

    Every task has more records than a leaf may hold, or is the root. Inner nodes of a range of n records take the slots
    slot .. slot + n - 2; those that stay free are squeezed out by the host.
    """
    tid = first_task + wp.tid()
    stack = wp.zeros(shape=wp.static(STACK_SIZE + 2), dtype=BuildTask)
    stack[0] = tasks[tid]
    size = int(1)
    while size > 0:
        size = size - 1
        task = stack[size]
        n = task.end - task.begin
        max_depth[tid] = wp.max(max_depth[tid], task.depth)

        split = Split()
        split.axis = -1
        split.cost = float(wp.inf)
        if task.depth + levels(n) < MAX_DEPTH:
            for axis in range(3):
                split = split_axis(records, task.begin, task.end, axis, split)
        middle = partition(records, task.begin, task.end, split)
        node = Bvh2Node()
        for side in range(2):
            begin = wp.where(side == 0, task.begin, middle)
            end = wp.where(side == 0, middle, task.end)
            lo = wp.vec3(wp.inf, wp.inf, wp.inf)
            hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            for i in range(begin, end):
                lo = wp.min(lo, records[i].lo)
                hi = wp.max(hi, records[i].hi)
            child = BuildTask()
            child.begin = begin
            child.end = end
            child.slot = wp.where(side == 0, task.slot + 1, task.slot + middle - task.begin)
            child.depth = task.depth + 1
            first = child.slot
            count = int(0)
            if end - begin <= options.max_leaf:
                first = begin
                count = end - begin
                # A child of 2 to max_leaf records is split all the same where that is the cheaper thing to do.
                if count > 1 and task.depth + 1 + levels(count) < MAX_DEPTH:
                    trial = Split()
                    trial.axis = -1
                    trial.cost = float(wp.inf)
                    for axis in range(3):
                        trial = split_axis(records, begin, end, axis, trial)
                    area = half_area(lo, hi)
                    whole = options.cost_intersection * float(count) * area
                    if options.cost_traversal * area + options.cost_intersection * trial.cost < whole:
                        first = child.slot
                        count = 0
            if count == 0 and end > begin:
                if end - begin <= stop_size:
                    left_over[wp.atomic_add(n_left_over, 0, 1)] = child
                else:
                    stack[size] = child
                    size = size + 1
            if side == 0:
                node.lo_0 = lo
                node.hi_0 = hi
                node.first_0 = first
                node.count_0 = count
            else:
                node.lo_1 = lo
                node.hi_1 = hi
                node.first_1 = first
                node.count_1 = count
        nodes[task.slot] = node
        used[task.slot] = wp.uint8(1)
