"""The inner loop of top-down builders of binary BVHs, on the CPU: it splits ranges of primitives in place.
At the end, the records are in the order of the leaves. The host launches it for the root. That launch defers small ranges, and further
launches build them on all cores. The builders differ in the function that splits a range: SPLIT is the table of these functions."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.build.records import (
    MAX_DEPTH,
    BuildData,
    BuildOptions,
    BuildTask,
    Halves,
    Row,
    area_scale,
    balanced_depth,
    center_of,
    empty_row,
    high_of,
    link_to_parent,
    low_of,
    lower,
    measure,
    measure_halves,
    row_area,
    row_count,
    row_of,
    unmeasured_halves,
)
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node

BIN_COUNT = 32
BINS = wp.constant(BIN_COUNT)
# Matrices and vectors hold the bins of all three axes. With arrays, each access would read the array's stride from memory.
BinBoxes = wp.types.matrix((3 * BIN_COUNT, 8), wp.float32)
BinCounts = wp.types.vector(3 * BIN_COUNT, wp.int32)
BinCosts = wp.types.vector(BIN_COUNT, wp.float32)


@wp.struct
class Bins:
    """Bins of centroids, `count` along each axis. Bin k of an axis begins at the coordinate origin[axis] + k / scale[axis].
    The scale is 0 on an axis that cannot separate the centroids: these coincide, or the scale would over- or underflow."""

    count: int
    origin: wp.vec3
    scale: wp.vec3


@wp.struct
class Split:
    """The best split: records whose bin along `axis` is below `bin` go to the left side; axis < 0: no split."""

    axis: int
    bin: int
    cost: float  # As in binned_split.
    box_0: Row  # Box of the left side.
    box_1: Row  # Box of the right side.


@wp.func
def bin_of(center: wp.vec3, axis: int, bins: Bins) -> int:
    """Return the bin of a centroid along an axis. Binning and partition share this function, so that they agree to the last bit."""
    return wp.clamp(int((center[axis] - bins.origin[axis]) * bins.scale[axis]), 0, bins.count - 1)


@wp.func
def bins_of(task: BuildTask) -> Bins:
    """Make the bins of a range. Their number along each axis is 8, plus 1 for every 8 records, but at most BIN_COUNT."""
    out = Bins()
    out.count = wp.min(8 + (task.end - task.begin) / 8, BINS)
    low = low_of(task.measures.centers)
    high = high_of(task.measures.centers)
    out.origin = low
    for axis in range(3):
        scale = float(out.count) * 0.999999 / (high[axis] - low[axis])
        if high[axis] > low[axis] and wp.isfinite(scale):
            out.scale[axis] = scale
    return out


@wp.func
def binned_split(data: BuildData, task: BuildTask, bins: Bins) -> Split:
    """Find the cheapest split between two bins (Wald 2007, "On fast Construction of SAH-based Bounding Volume Hierarchies").
    The cost is the sum over both halves of half the surface area (row_area, with area_scale of the range) times the number of records."""
    scale = area_scale(task.measures.box)
    count = BinCounts()
    box = BinBoxes()
    right_cost = BinCosts()
    for axis in range(3):
        for k in range(bins.count):
            box[axis * BINS + k] = empty_row()
    for i in range(task.begin, task.end):
        record = data.records[i]
        center = center_of(record)
        row = row_of(record.lo, record.hi)
        for axis in range(3):
            b = axis * BINS + bin_of(center, axis, bins)
            count[b] = count[b] + 1
            box[b] = lower(box[b], row)

    best = Split()
    best.axis = -1
    best.cost = float(wp.inf)
    axes = int(3)  # a variable: Warp unrolls constant loops, and the compiler would take a tenth longer
    for axis in range(axes):
        if bins.scale[axis] > 0.0:
            side = empty_row()
            n = int(0)
            for j in range(bins.count - 1):
                k = bins.count - 1 - j
                side = lower(side, box[axis * BINS + k])
                n = n + count[axis * BINS + k]
                right_cost[k] = wp.where(n == 0, float(wp.inf), row_area(side, scale) * float(n))
            side = empty_row()
            n = int(0)
            for k in range(1, bins.count):
                side = lower(side, box[axis * BINS + k - 1])
                n = n + count[axis * BINS + k - 1]
                cost = row_area(side, scale) * float(n) + right_cost[k]
                if n > 0 and cost < best.cost:
                    best.axis = axis
                    best.bin = k
                    best.cost = cost
                    best.box_0 = side
    if best.axis >= 0:
        best.box_1 = empty_row()
        for k in range(best.bin, bins.count):
            best.box_1 = lower(best.box_1, box[best.axis * BINS + k])
    return best


@wp.func
def partition_by_bin(data: BuildData, task: BuildTask, bins: Bins, split: Split) -> Halves:
    """Partition the records in place, with the left side in front; return both halves with their bounds.
    Lomuto's partition, without its unpredictable branch. Every record is swapped with the first record of the right side. If the record
    belongs to the left side, the beginning of the right side then moves on by one."""
    middle = int(task.begin)
    empty = empty_row()
    centers_0 = empty_row()
    centers_1 = empty_row()
    for i in range(task.begin, task.end):
        record = data.records[i]
        data.records[i] = data.records[middle]
        data.records[middle] = record
        center = center_of(record)
        row = row_of(center, center)
        left = bin_of(center, split.axis, bins) < split.bin
        middle = middle + wp.where(left, 1, 0)
        centers_0 = lower(centers_0, wp.where(left, row, empty))
        centers_1 = lower(centers_1, wp.where(left, empty, row))
    out = unmeasured_halves(task, middle)
    out.left.box = split.box_0
    out.left.centers = centers_0
    out.right.box = split.box_1
    out.right.centers = centers_1
    return out


@wp.func
def split_binned(data: BuildData, task: BuildTask) -> Halves:
    """Split at the cheapest boundary between bins. If no axis separates the centroids, or the tree gets too deep, halve the list."""
    n = task.end - task.begin
    if n > 2 and task.depth + balanced_depth(n) < MAX_DEPTH:
        bins = bins_of(task)
        split = binned_split(data, task, bins)
        if split.axis >= 0:
            return partition_by_bin(data, task, bins, split)
    return measure_halves(data, task, task.begin + n / 2)


@wp.func
def choose_median(data: BuildData, task: BuildTask) -> int:
    """Partition the records at the median centroid along the axis on which centroids spread most; return the first index of the right side.
    Half the records go to each side: Hoare 1961, "Algorithm 65: Find", with the middle element as the pivot."""
    e = 0.5 * high_of(task.measures.centers) - 0.5 * low_of(task.measures.centers)
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
def choose_sweep(data: BuildData, task: BuildTask) -> int:
    """Partition at the cheapest of all splits of the records sorted by centroid along an axis; return the first index of the right side.
    MacDonald and Booth 1990, "Heuristics for ray tracing using space subdivision". A stable partition keeps both sides sorted along all
    three axes."""
    n = data.boxes.shape[0]
    scale = area_scale(task.measures.box)
    best_axis = int(0)
    best_cost = float(wp.inf)
    best = int(task.begin + (task.end - task.begin) / 2)
    if task.depth + balanced_depth(task.end - task.begin) < MAX_DEPTH:
        for axis in range(3):
            side = empty_row()
            for k in range(task.begin + 1, task.end):
                i = task.begin + task.end - k
                box = data.boxes[data.order[axis * n + i]]
                side = lower(side, row_of(box.lo, box.hi))
                data.area[i] = row_area(side, scale) * float(task.end - i)
            side = empty_row()
            for i in range(task.begin + 1, task.end):
                box = data.boxes[data.order[axis * n + i - 1]]
                side = lower(side, row_of(box.lo, box.hi))
                cost = row_area(side, scale) * float(i - task.begin) + data.area[i]
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


def split_at(choose: Any) -> Any:
    """Make split(data, task) -> Halves from choose(data, task), which partitions a range and returns the right side's first index."""

    @wp.func
    def split(data: BuildData, task: BuildTask) -> Halves:
        return measure_halves(data, task, choose(data, task))

    return split


SPLIT = {
    "binned": split_binned,
    "sweep": split_at(choose_sweep),
    "median": split_at(choose_median),
}


@wp.func
def child_of(task: BuildTask, halves: Halves, side: int) -> BuildTask:
    """Return the task of one side of a split range: 0 left, 1 right."""
    child = BuildTask()
    child.begin = wp.where(side == 0, task.begin, halves.middle)
    child.end = child.begin + wp.where(side == 0, halves.count_0, halves.count_1)
    child.limit = wp.where(side == 0, halves.middle, task.limit)
    child.slot = wp.where(side == 0, task.slot + 1, task.slot + halves.middle - task.begin)
    child.parent = task.slot
    child.side = side
    child.depth = task.depth + 1
    if side == 0:
        child.measures = halves.left
    else:
        child.measures = halves.right
    return child


@wp.func
def split_pays(options: BuildOptions, task: BuildTask, halves: Halves) -> bool:
    """Test whether a node with the two halves as leaves has a lower SAH cost than one leaf with the whole range."""
    scale = area_scale(task.measures.box)
    area = row_area(task.measures.box, scale)
    parts = (row_area(halves.left.box, scale) * row_count(options, halves.count_0)
             + row_area(halves.right.box, scale) * row_count(options, halves.count_1))
    split_cost = options.cost_traversal * area + options.cost_intersection * parts
    return split_cost < options.cost_intersection * row_count(options, task.end - task.begin) * area


@wp.func
def write_node(data: BuildData, task: BuildTask, halves: Halves):
    """Write the inner node task.slot of a split range. Both children are leaves until link_to_parent makes them inner nodes."""
    data.used[task.slot] = wp.uint8(1)
    node = Bvh2Node()
    node.lo_0 = low_of(halves.left.box)
    node.hi_0 = high_of(halves.left.box)
    node.lo_1 = low_of(halves.right.box)
    node.hi_1 = high_of(halves.right.box)
    node.first_0 = task.begin
    node.count_0 = halves.count_0
    node.first_1 = halves.middle
    node.count_1 = halves.count_1
    data.nodes[task.slot] = node


@wp.func
def mark_leaf(left: wp.array(dtype=wp.uint8), begin: int, end: int):
    """Set left[begin .. end - 1] to 1: these records are in a leaf. The host removes all other records."""
    for i in range(begin, end):
        left[i] = wp.uint8(1)


@cache
def make_build_ranges(split: Any, place: Any = None) -> Any:
    """Make a builder's kernel from split(data, task) -> Halves, which moves the records to their sides. With spatial splits, `split` does
    not move them. Instead place(data, task, halves) -> Halves does, once the range is known not to become a leaf."""

    @kernel
    def build_ranges(data: BuildData, tasks: wp.array(dtype=BuildTask), options: BuildOptions, stop_size: int,
                     deferred: wp.array(dtype=BuildTask), n_deferred: wp.array(dtype=wp.int32),
                     max_depth: wp.array(dtype=wp.int32)):
        """Build the subtree of each task. Append ranges of at most stop_size records to `deferred` instead. max_depth[0] gets the depth.
        A task has at least two records. A range with space for n records owns the node slots slot .. slot + n - 2; the host removes unused
        slots. If no ranges are deferred (stop_size 0), a subtree uses its first slots without gaps."""
        stack = wp.zeros(shape=wp.static(STACK_SIZE + 2), dtype=BuildTask)
        stack[0] = tasks[wp.tid()]
        size = int(1)
        slot = int(stack[0].slot)
        while size > 0:
            size = size - 1
            task = stack[size]
            n = task.end - task.begin
            if n <= stop_size and task.parent >= 0:
                deferred[wp.atomic_add(n_deferred, 0, 1)] = task
                continue
            if task.parent < 0:
                task.measures = measure(data, task.begin, task.end)

            halves = split(data, task)
            if n <= options.max_leaf and task.parent >= 0:
                if not split_pays(options, task, halves):
                    link_to_parent(data.nodes, task, task.begin, n)
                    if wp.static(place is not None):
                        mark_leaf(data.left, task.begin, task.end)
                    continue

            if wp.static(place is not None):
                halves = place(data, task, halves)
            if stop_size == 0:
                task.slot = slot
                slot = slot + 1
            max_depth[0] = wp.max(max_depth[0], task.depth)
            link_to_parent(data.nodes, task, task.slot, 0)
            write_node(data, task, halves)
            # A single record is a leaf; longer ranges are tasks.
            if halves.count_1 > 1:
                stack[size] = child_of(task, halves, 1)
                size = size + 1
            elif wp.static(place is not None):
                mark_leaf(data.left, halves.middle, halves.middle + 1)
            if halves.count_0 > 1:
                stack[size] = child_of(task, halves, 0)
                size = size + 1
            elif wp.static(place is not None):
                mark_leaf(data.left, task.begin, task.begin + 1)

    return build_ranges
