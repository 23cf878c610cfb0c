"""Binned SAH splits of a range of primitives (BuildRecord)."""

import warp as wp

from wrt.kernels.build.records import (
    MAX_DEPTH,
    BuildData,
    BuildTask,
    Halves,
    Row,
    area_scale,
    balanced_depth,
    center_of,
    empty_row,
    high_of,
    low_of,
    lower,
    measure_halves,
    row_area,
    row_of,
    unmeasured_halves,
)

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
