"""The inner loop of the builders from the top down, on the CPU backend: ranges of primitives are split in place.

In the end the records stand in the order of the leaves. The host launches it once for the top of the tree and then once a
subtree, on all cores. What differs between builders is how a range is split: CHOOSE is the table of the ways there are.
"""

from functools import cache

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.traverse_bvh2 import STACK_SIZE, Bvh2Node

BIN_COUNT = 32
BINS = wp.constant(BIN_COUNT)
# Up to here a range is swept, not binned: that is better, and no slower.
SMALL_COUNT = 16
SMALL = wp.constant(SMALL_COUNT)
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
    """A range of records that becomes a child of `parent` (-1: the root): a leaf, or the inner node `slot`.

    lo, hi: its box; center_lo, center_hi: the box of its centroids; limit: the end of the room that it has (spatial splits).
    """

    begin: int
    end: int
    limit: int
    slot: int
    parent: int
    side: int
    depth: int
    lo: wp.vec3
    hi: wp.vec3
    center_lo: wp.vec3
    center_hi: wp.vec3


@wp.struct
class BuildOptions:
    """Leaves hold at most max_leaf primitives; the costs are those of the surface area heuristic."""

    max_leaf: int
    cost_traversal: float
    cost_intersection: float


@wp.struct
class BuildData:
    """records: rearranged; codes: Morton codes of the records, ascending (LBVH); of the sweep: boxes: the records as they were,
    order: for each axis, one after another, the boxes by centroid; area, left, scratch: room, one entry a record."""

    records: wp.array(dtype=BuildRecord)
    nodes: wp.array(dtype=Bvh2Node)
    used: wp.array(dtype=wp.uint8)
    codes: wp.array(dtype=wp.uint64)
    boxes: wp.array(dtype=BuildRecord)
    order: wp.array(dtype=wp.int32)
    area: wp.array(dtype=wp.float32)
    left: wp.array(dtype=wp.uint8)
    scratch: wp.array(dtype=wp.int32)


@wp.struct
class Split:
    """The chosen split: records whose bin along `axis` is below `bin` go left. axis < 0: none was found."""

    axis: int
    bin: int
    cost: float


@wp.func
def area_scale(task: BuildTask) -> float:
    """The factor that makes a range's longest side 1, so that no area under- or overflows: what `half_area` wants."""
    e = 0.5 * task.hi - 0.5 * task.lo
    return 1.0 / wp.max(wp.max(wp.max(e[0], e[1]), e[2]), 2.0**-126.0)


@wp.func
def half_area(lo: wp.vec3, hi: wp.vec3, scale: float) -> float:
    """Half the surface of a box, in units of a range's own size; 0 for an empty one."""
    e = wp.max((0.5 * hi - 0.5 * lo) * scale, wp.vec3(0.0, 0.0, 0.0))
    return e[0] * e[1] + e[1] * e[2] + e[2] * e[0]


@wp.func
def center_of(record: BuildRecord) -> wp.vec3:
    return 0.5 * record.lo + 0.5 * record.hi


@wp.func
def bin_of(center: wp.vec3, axis: int, origin: wp.vec3, scale: wp.vec3) -> int:
    """Binning and partition call this one function, so that they agree to the last bit."""
    return wp.clamp(int((center[axis] - origin[axis]) * scale[axis]), 0, BINS - 1)


@wp.func
def levels(n: int) -> int:
    """ceil(log2(n)): the depth of a balanced tree over n primitives."""
    result = int(0)
    while result < 31 and (1 << result) < n:  # 1 << 31 is negative
        result = result + 1
    return result


@wp.func
def bin_scale(task: BuildTask) -> wp.vec3:
    """Bins a unit of length along each axis; 0 where the centroids cannot be told apart.

    That is where they coincide, or are so close together (or so far apart) that the scale over- or underflows.
    """
    out = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        scale = float(BINS) * 0.999999 / (task.center_hi[axis] - task.center_lo[axis])
        if task.center_hi[axis] > task.center_lo[axis] and wp.isfinite(scale):
            out[axis] = scale
    return out


@wp.func
def binned_split(data: BuildData, task: BuildTask, bins: wp.vec3) -> Split:
    """Wald 2007, "On fast Construction of SAH-based Bounding Volume Hierarchies": the cheapest split between two bins.

    Cost: the sum over both sides of half area x count, in units of area_scale.
    """
    scale = area_scale(task)
    count = wp.zeros(shape=wp.static(3 * BIN_COUNT), dtype=wp.int32)
    lo = wp.zeros(shape=wp.static(3 * BIN_COUNT), dtype=wp.vec3)
    hi = wp.zeros(shape=wp.static(3 * BIN_COUNT), dtype=wp.vec3)
    right_cost = wp.zeros(shape=wp.static(BIN_COUNT), dtype=wp.float32)
    for b in range(3 * BINS):
        lo[b] = wp.vec3(wp.inf, wp.inf, wp.inf)
        hi[b] = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for i in range(task.begin, task.end):
        record = data.records[i]
        center = center_of(record)
        for axis in range(3):
            b = axis * BINS + bin_of(center, axis, task.center_lo, bins)
            count[b] = count[b] + 1
            lo[b] = wp.min(lo[b], record.lo)
            hi[b] = wp.max(hi[b], record.hi)

    best = Split()
    best.axis = -1
    best.cost = float(wp.inf)
    for axis in range(3):
        if bins[axis] > 0.0:
            side_lo = wp.vec3(wp.inf, wp.inf, wp.inf)
            side_hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            n = int(0)
            for k in range(BINS - 1):
                b = axis * BINS + BINS - 1 - k
                side_lo = wp.min(side_lo, lo[b])
                side_hi = wp.max(side_hi, hi[b])
                n = n + count[b]
                cost = half_area(side_lo, side_hi, scale) * float(n)
                right_cost[BINS - 1 - k] = wp.where(n == 0, float(wp.inf), cost)
            side_lo = wp.vec3(wp.inf, wp.inf, wp.inf)
            side_hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            n = int(0)
            for k in range(1, BINS):
                b = axis * BINS + k - 1
                side_lo = wp.min(side_lo, lo[b])
                side_hi = wp.max(side_hi, hi[b])
                n = n + count[b]
                cost = half_area(side_lo, side_hi, scale) * float(n) + right_cost[k]
                if n > 0 and cost < best.cost:
                    best.axis = axis
                    best.bin = k
                    best.cost = cost
    return best


@wp.func
def sort_by(records: wp.array(dtype=BuildRecord), begin: int, end: int, axis: int):
    """Insertion sort of a small range by centroid."""
    for i in range(begin + 1, end):
        record = records[i]
        key = center_of(record)[axis]
        j = int(i)
        while j > begin and center_of(records[j - 1])[axis] > key:
            records[j] = records[j - 1]
            j = j - 1
        records[j] = record


@wp.func
def choose_small(data: BuildData, task: BuildTask) -> int:
    """The cheapest of all splits of a range of up to SMALL records by their order along an axis."""
    scale = area_scale(task)
    right_cost = wp.zeros(shape=wp.static(SMALL_COUNT), dtype=wp.float32)
    best_axis = int(0)
    best_cost = float(wp.inf)
    best = int(task.begin + (task.end - task.begin) / 2)
    for axis in range(3):
        if task.center_hi[axis] > task.center_lo[axis]:
            sort_by(data.records, task.begin, task.end, axis)
            lo = wp.vec3(wp.inf, wp.inf, wp.inf)
            hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            for k in range(task.begin + 1, task.end):
                i = task.begin + task.end - k
                lo = wp.min(lo, data.records[i].lo)
                hi = wp.max(hi, data.records[i].hi)
                right_cost[i - task.begin] = half_area(lo, hi, scale) * float(task.end - i)
            lo = wp.vec3(wp.inf, wp.inf, wp.inf)
            hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            for i in range(task.begin + 1, task.end):
                lo = wp.min(lo, data.records[i - 1].lo)
                hi = wp.max(hi, data.records[i - 1].hi)
                cost = half_area(lo, hi, scale) * float(i - task.begin) + right_cost[i - task.begin]
                if cost < best_cost:
                    best_cost = cost
                    best_axis = axis
                    best = i
    if best_axis < 2:  # they stand in the order of the last axis that they were sorted by
        sort_by(data.records, task.begin, task.end, best_axis)
    return best


@wp.func
def choose_binned(data: BuildData, task: BuildTask) -> int:
    """The first record of the right side, after the records of the left side have gone to the front. So each `choose`."""
    half = task.begin + (task.end - task.begin) / 2
    if task.depth + levels(task.end - task.begin) >= MAX_DEPTH:
        return half
    if task.end - task.begin <= SMALL:
        return choose_small(data, task)
    bins = bin_scale(task)
    split = binned_split(data, task, bins)
    if split.axis < 0:
        return half
    i = int(task.begin)
    j = int(task.end)
    while i < j:
        record = data.records[i]
        if bin_of(center_of(record), split.axis, task.center_lo, bins) < split.bin:
            i = i + 1
        else:
            j = j - 1
            data.records[i] = data.records[j]
            data.records[j] = record
    return i


@wp.func
def choose_median(data: BuildData, task: BuildTask) -> int:
    """Half the records on each side of the median centroid along the axis where the centroids are farthest apart.

    Hoare 1961, "Algorithm 65: Find", with the middle element as the pivot.
    """
    e = 0.5 * task.center_hi - 0.5 * task.center_lo
    axis = wp.where(e[1] > e[0], 1, 0)
    axis = wp.where(e[2] > e[axis], 2, axis)
    half = task.begin + (task.end - task.begin) / 2
    low = int(task.begin)
    high = int(task.end - 1)
    while low < high:
        pivot = center_of(data.records[low + (high - low) / 2])[axis]
        i = int(low)
        j = int(high)
        while i <= j:
            while center_of(data.records[i])[axis] < pivot:
                i = i + 1
            while center_of(data.records[j])[axis] > pivot:
                j = j - 1
            if i <= j:
                record = data.records[i]
                data.records[i] = data.records[j]
                data.records[j] = record
                i = i + 1
                j = j - 1
        if half <= j:
            high = j
        elif half >= i:
            low = i
        else:
            low = high
    return half


@wp.func
def choose_morton(data: BuildData, task: BuildTask) -> int:
    """Where the highest bit in which the range's Morton codes differ turns from 0 to 1.

    Lauterbach et al. 2009, "Fast BVH Construction on GPUs". Halved where the codes are the same, or the tree gets too deep.
    """
    half = task.begin + (task.end - task.begin) / 2
    differ = data.codes[task.begin] ^ data.codes[task.end - 1]
    if differ == wp.uint64(0) or task.depth + levels(task.end - task.begin) >= MAX_DEPTH:
        return half
    low = int(task.begin)
    high = int(task.end - 1)
    while low + 1 < high:  # codes[low] has the bit off, codes[high] on
        middle = low + (high - low) / 2
        # Below the highest bit of `differ` if and only if it shares that bit with the first.
        if (data.codes[middle] ^ data.codes[task.begin]) <= (data.codes[middle] ^ data.codes[task.end - 1]):
            low = middle
        else:
            high = middle
    return high


@wp.func
def choose_sweep(data: BuildData, task: BuildTask) -> int:
    """The cheapest of all splits by the order of the centroids along an axis; the orders are kept by stable partition.

    MacDonald and Booth 1990, "Heuristics for ray tracing using space subdivision".
    """
    n = data.boxes.shape[0]
    scale = area_scale(task)
    best_axis = int(0)
    best_cost = float(wp.inf)
    best = int(task.begin + (task.end - task.begin) / 2)
    if task.depth + levels(task.end - task.begin) < MAX_DEPTH:
        for axis in range(3):
            lo = wp.vec3(wp.inf, wp.inf, wp.inf)
            hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            for k in range(task.begin + 1, task.end):
                i = task.begin + task.end - k
                box = data.boxes[data.order[axis * n + i]]
                lo = wp.min(lo, box.lo)
                hi = wp.max(hi, box.hi)
                data.area[i] = half_area(lo, hi, scale) * float(task.end - i)
            lo = wp.vec3(wp.inf, wp.inf, wp.inf)
            hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            for i in range(task.begin + 1, task.end):
                box = data.boxes[data.order[axis * n + i - 1]]
                lo = wp.min(lo, box.lo)
                hi = wp.max(hi, box.hi)
                cost = half_area(lo, hi, scale) * float(i - task.begin) + data.area[i]
                if cost < best_cost:
                    best_cost = cost
                    best_axis = axis
                    best = i
    for i in range(task.begin, task.end):
        index = data.order[best_axis * n + i]
        data.left[index] = wp.where(i < best, wp.uint8(1), wp.uint8(0))
        data.records[i] = data.boxes[index]
    for axis in range(3):
        if axis != best_axis:
            i = int(task.begin)
            j = int(task.begin)
            for k in range(task.begin, task.end):
                index = data.order[axis * n + k]
                if data.left[index] != wp.uint8(0):
                    data.order[axis * n + i] = index
                    i = i + 1
                else:
                    data.scratch[j] = index
                    j = j + 1
            for k in range(task.begin, j):
                data.order[axis * n + i + k - task.begin] = data.scratch[k]
    return best


CHOOSE = {"binned": choose_binned, "sweep": choose_sweep, "median": choose_median, "lbvh": choose_morton}


@wp.func
def measured(data: BuildData, task: BuildTask) -> BuildTask:
    """The task with the boxes of its records and of their centroids."""
    lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    center_lo = wp.vec3(wp.inf, wp.inf, wp.inf)
    center_hi = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for i in range(task.begin, task.end):
        record = data.records[i]
        center = center_of(record)
        lo = wp.min(lo, record.lo)
        hi = wp.max(hi, record.hi)
        center_lo = wp.min(center_lo, center)
        center_hi = wp.max(center_hi, center)
    task.lo = lo
    task.hi = hi
    task.center_lo = center_lo
    task.center_hi = center_hi
    return task


@wp.func
def child_of(data: BuildData, task: BuildTask, middle: int, side: int) -> BuildTask:
    """One side of a split range."""
    child = BuildTask()
    child.begin = wp.where(side == 0, task.begin, middle)
    child.end = wp.where(side == 0, middle, task.end)
    child.slot = wp.where(side == 0, task.slot + 1, task.slot + middle - task.begin)
    child.parent = task.slot
    child.side = side
    child.depth = task.depth + 1
    return measured(data, child)


@wp.func
def tell_parent(nodes: wp.array(dtype=Bvh2Node), task: BuildTask, first: int, count: int):
    """What has become of a range: a leaf (count > 0), or the inner node `first`."""
    if task.parent >= 0:
        if task.side == 0:
            nodes[task.parent].first_0 = first
            nodes[task.parent].count_0 = count
        else:
            nodes[task.parent].first_1 = first
            nodes[task.parent].count_1 = count


@cache
def make_build_ranges(builder: str):
    """The kernel of the builder of that name in CHOOSE."""
    choose = CHOOSE[builder]

    @kernel
    def build_ranges(data: BuildData, tasks: wp.array(dtype=BuildTask), first_task: int, options: BuildOptions, stop_size: int,
                     left_over: wp.array(dtype=BuildTask), n_left_over: wp.array(dtype=wp.int32),
                     max_depth: wp.array(dtype=wp.int32)):
        """Build the subtree of one task, down to ranges of at most stop_size records, which are listed in left_over.

        Every task has two records or more. Inner nodes of a range of n records take the slots slot .. slot + n - 2; those
        that stay free are squeezed out by the host.
        """
        tid = first_task + wp.tid()
        stack = wp.zeros(shape=wp.static(STACK_SIZE + 2), dtype=BuildTask)
        stack[0] = tasks[tid]
        size = int(1)
        while size > 0:
            size = size - 1
            task = stack[size]
            n = task.end - task.begin
            if n <= stop_size and task.parent >= 0:
                left_over[wp.atomic_add(n_left_over, 0, 1)] = task
                continue
            if task.parent < 0:
                task = measured(data, task)

            middle = choose(data, task)
            left = child_of(data, task, middle, 0)
            right = child_of(data, task, middle, 1)
            if n <= options.max_leaf and task.parent >= 0:
                scale = area_scale(task)
                area = half_area(task.lo, task.hi, scale)
                parts = (half_area(left.lo, left.hi, scale) * float(middle - task.begin)
                         + half_area(right.lo, right.hi, scale) * float(task.end - middle))
                split_cost = options.cost_traversal * area + options.cost_intersection * parts
                if not split_cost < options.cost_intersection * float(n) * area:
                    tell_parent(data.nodes, task, task.begin, n)
                    continue

            max_depth[tid] = wp.max(max_depth[tid], task.depth)
            tell_parent(data.nodes, task, task.slot, 0)
            data.used[task.slot] = wp.uint8(1)
            node = Bvh2Node()
            node.lo_0 = left.lo
            node.hi_0 = left.hi
            node.lo_1 = right.lo
            node.hi_1 = right.hi
            node.first_0 = left.begin
            node.count_0 = left.end - left.begin
            node.first_1 = right.begin
            node.count_1 = right.end - right.begin
            data.nodes[task.slot] = node
            # A single record is a leaf; others find out for themselves.
            if node.count_1 > 1:
                stack[size] = right
                size = size + 1
            if node.count_0 > 1:
                stack[size] = left
                size = size + 1

    return build_ranges
