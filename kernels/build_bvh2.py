"""The inner loop of the builders from the top down, on the CPU backend: ranges of primitives are split in place.

In the end the records stand in the order of the leaves. The host launches it once for the top of the tree and then once a
subtree, on all cores. What differs between builders is how a range is split: SPLIT is the table of the ways there are.
"""

from functools import cache

import warp as wp

from wrt.kernels.lanes import row_type
from wrt.kernels.structs import kernel
from wrt.kernels.traverse_bvh2 import STACK_SIZE, Bvh2Node

BIN_COUNT = 32
BINS = wp.constant(BIN_COUNT)
# From here on a range is halved by number, which takes ceil(log2(n)) more levels, whatever the SAH would like.
MAX_DEPTH = wp.constant(STACK_SIZE - 2)

# A box as one row, low corner and negated high one (two lanes are not used): the lower numbers of two rows are the box around both.
Row = row_type(8)
# Of all bins of the three axes. (The stride of an array would be read from memory each time.)
BinBoxes = wp.types.matrix((3 * BIN_COUNT, 8), wp.float32)
BinCounts = wp.types.vector(3 * BIN_COUNT, wp.int32)
BinCosts = wp.types.vector(BIN_COUNT, wp.float32)


@wp.struct
class BuildRecord:
    """A primitive's box and which one it is."""

    lo: wp.vec3
    hi: wp.vec3
    prim_id: int


@wp.struct
class Measures:
    """The box of some records, and that of their centroids."""

    box: Row
    centers: Row


@wp.struct
class BuildTask:
    """A range of records that becomes a child of `parent` (-1: the root): a leaf, or the inner node `slot`.

    limit: the end of the room that it has (spatial splits).
    """

    begin: int
    end: int
    limit: int
    slot: int
    parent: int
    side: int
    depth: int
    measures: Measures


@wp.struct
class BuildOptions:
    """Leaves hold at most max_leaf primitives; the costs are those of the surface area heuristic: of a node, and of a row of
    primitives, which are tested at once."""

    max_leaf: int
    row: int
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
class Bins:
    """Bins of centroids along each axis, 1 / scale long, from origin on. scale is 0 where the centroids cannot be told apart:
    where they coincide, or are so close together (or so far apart) that it over- or underflows."""

    count: int
    origin: wp.vec3
    scale: wp.vec3


@wp.struct
class Split:
    """The chosen split: records whose bin along `axis` is below `bin` go left. axis < 0: none was found. Boxes of both sides."""

    axis: int
    bin: int
    cost: float
    box_0: Row
    box_1: Row


@wp.struct
class Halves:
    """A split range whose records stand in their places: where the right side begins, and what both measure."""

    middle: int
    left: Measures
    right: Measures


@wp.func
def rows_of(options: BuildOptions, n: int) -> float:
    """How many rows n primitives fill."""
    return float((n + options.row - 1) / options.row)


@wp.func
def row_of(lo: wp.vec3, hi: wp.vec3) -> Row:
    return Row(lo[0], lo[1], lo[2], -hi[0], -hi[1], -hi[2], 0.0, 0.0)


@wp.func
def empty_row() -> Row:
    return Row(wp.inf, wp.inf, wp.inf, wp.inf, wp.inf, wp.inf, 0.0, 0.0)


@wp.func
def low_of(row: Row) -> wp.vec3:
    return wp.vec3(row[0], row[1], row[2])


@wp.func
def high_of(row: Row) -> wp.vec3:
    return wp.vec3(-row[3], -row[4], -row[5])


@wp.func
def lower(a: Row, b: Row) -> Row:
    """The lower number of each lane. (Warp's own minimum minds NaN, which takes three times as long.)"""
    out = Row()
    for k in range(8):
        out[k] = wp.where(b[k] < a[k], b[k], a[k])
    return out


@wp.func
def area_scale(box: Row) -> float:
    """The factor that makes a range's longest side 1, so that no area under- or overflows: what `half_area` wants."""
    e = 0.5 * high_of(box) - 0.5 * low_of(box)
    return 1.0 / wp.max(wp.max(wp.max(e[0], e[1]), e[2]), 2.0**-126.0)


@wp.func
def half_area(box: Row, scale: float) -> float:
    """Half the surface of a box, in units of a range's own size; 0 for an empty one."""
    half = 0.5 * scale * box
    x = -(half[0] + half[3])
    y = -(half[1] + half[4])
    z = -(half[2] + half[5])
    x = wp.where(x > 0.0, x, 0.0)
    y = wp.where(y > 0.0, y, 0.0)
    z = wp.where(z > 0.0, z, 0.0)
    return x * y + y * z + z * x


@wp.func
def center_of(record: BuildRecord) -> wp.vec3:
    return 0.5 * record.lo + 0.5 * record.hi


@wp.func
def bin_of(center: wp.vec3, axis: int, bins: Bins) -> int:
    """Binning and partition call this one function, so that they agree to the last bit."""
    return wp.clamp(int((center[axis] - bins.origin[axis]) * bins.scale[axis]), 0, bins.count - 1)


@wp.func
def levels(n: int) -> int:
    """ceil(log2(n)): the depth of a balanced tree over n primitives."""
    result = int(0)
    while result < 31 and (1 << result) < n:  # 1 << 31 is negative
        result = result + 1
    return result


@wp.func
def bins_of(task: BuildTask) -> Bins:
    """The bins of a range, fewer of them for few records."""
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
    """Wald 2007, "On fast Construction of SAH-based Bounding Volume Hierarchies": the cheapest split between two bins.

    Cost: the sum over both sides of half area x count, in units of area_scale.
    """
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
    for axis in range(3):
        if bins.scale[axis] > 0.0:
            side = empty_row()
            n = int(0)
            for j in range(bins.count - 1):
                k = bins.count - 1 - j
                side = lower(side, box[axis * BINS + k])
                n = n + count[axis * BINS + k]
                right_cost[k] = wp.where(n == 0, float(wp.inf), half_area(side, scale) * float(n))
            side = empty_row()
            n = int(0)
            for k in range(1, bins.count):
                side = lower(side, box[axis * BINS + k - 1])
                n = n + count[axis * BINS + k - 1]
                cost = half_area(side, scale) * float(n) + right_cost[k]
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
def measured(data: BuildData, begin: int, end: int) -> Measures:
    out = Measures()
    out.box = empty_row()
    out.centers = empty_row()
    for i in range(begin, end):
        record = data.records[i]
        center = center_of(record)
        out.box = lower(out.box, row_of(record.lo, record.hi))
        out.centers = lower(out.centers, row_of(center, center))
    return out


@wp.func
def halves_at(data: BuildData, task: BuildTask, middle: int) -> Halves:
    out = Halves()
    out.middle = middle
    out.left = measured(data, task.begin, middle)
    out.right = measured(data, middle, task.end)
    return out


@wp.func
def part_by_bin(data: BuildData, task: BuildTask, bins: Bins, split: Split) -> Halves:
    """The records of the left side go to the front.

    Lomuto's partition without a branch, which nothing could predict: what is exchanged for nothing stays on its side.
    """
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
    out = Halves()
    out.middle = middle
    out.left.box = split.box_0
    out.left.centers = centers_0
    out.right.box = split.box_1
    out.right.centers = centers_1
    return out


@wp.func
def split_binned(data: BuildData, task: BuildTask) -> Halves:
    """The cheapest split between two bins; by number where no centroids can be told apart, or the tree gets too deep."""
    n = task.end - task.begin
    if n > 2 and task.depth + levels(n) < MAX_DEPTH:
        bins = bins_of(task)
        split = binned_split(data, task, bins)
        if split.axis >= 0:
            return part_by_bin(data, task, bins, split)
    return halves_at(data, task, task.begin + n / 2)


@wp.func
def choose_median(data: BuildData, task: BuildTask) -> int:
    """The first record of the right side, after the records of the left side have gone to the front. So each `choose`.

    Half the records on each side of the median centroid along the axis where the centroids are farthest apart:

    Hoare 1961, "Algorithm 65: Find", with the middle element as the pivot.
    """
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
    scale = area_scale(task.measures.box)
    best_axis = int(0)
    best_cost = float(wp.inf)
    best = int(task.begin + (task.end - task.begin) / 2)
    if task.depth + levels(task.end - task.begin) < MAX_DEPTH:
        for axis in range(3):
            side = empty_row()
            for k in range(task.begin + 1, task.end):
                i = task.begin + task.end - k
                box = data.boxes[data.order[axis * n + i]]
                side = lower(side, row_of(box.lo, box.hi))
                data.area[i] = half_area(side, scale) * float(task.end - i)
            side = empty_row()
            for i in range(task.begin + 1, task.end):
                box = data.boxes[data.order[axis * n + i - 1]]
                side = lower(side, row_of(box.lo, box.hi))
                cost = half_area(side, scale) * float(i - task.begin) + data.area[i]
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


def split_at(choose):
    @wp.func
    def split(data: BuildData, task: BuildTask) -> Halves:
        return halves_at(data, task, choose(data, task))

    return split


SPLIT = {
    "binned": split_binned,
    "sweep": split_at(choose_sweep),
    "median": split_at(choose_median),
    "lbvh": split_at(choose_morton),
}


@wp.func
def child_of(task: BuildTask, halves: Halves, side: int) -> BuildTask:
    """One side of a split range."""
    child = BuildTask()
    child.begin = wp.where(side == 0, task.begin, halves.middle)
    child.end = wp.where(side == 0, halves.middle, task.end)
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
def worth_it(options: BuildOptions, task: BuildTask, halves: Halves) -> bool:
    """Whether two leaves cost less than one."""
    scale = area_scale(task.measures.box)
    area = half_area(task.measures.box, scale)
    parts = (half_area(halves.left.box, scale) * rows_of(options, halves.middle - task.begin)
             + half_area(halves.right.box, scale) * rows_of(options, task.end - halves.middle))
    split_cost = options.cost_traversal * area + options.cost_intersection * parts
    return split_cost < options.cost_intersection * rows_of(options, task.end - task.begin) * area


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
    """The kernel of the builder of that name in SPLIT."""
    split = SPLIT[builder]

    @kernel
    def build_ranges(data: BuildData, tasks: wp.array(dtype=BuildTask), options: BuildOptions, stop_size: int,
                     left_over: wp.array(dtype=BuildTask), n_left_over: wp.array(dtype=wp.int32),
                     max_depth: wp.array(dtype=wp.int32)):
        """Build the subtree of one task, down to ranges of at most stop_size records, which are listed in left_over.

        Every task has two records or more. Inner nodes of a range of n records have the slots slot .. slot + n - 2 to
        themselves; those that stay free are squeezed out by the host. A whole subtree (stop_size 0) takes the first of them.
        """
        stack = wp.zeros(shape=wp.static(STACK_SIZE + 2), dtype=BuildTask)
        stack[0] = tasks[0]
        size = int(1)
        slot = int(stack[0].slot)
        while size > 0:
            size = size - 1
            task = stack[size]
            n = task.end - task.begin
            if n <= stop_size and task.parent >= 0:
                left_over[wp.atomic_add(n_left_over, 0, 1)] = task
                continue
            if task.parent < 0:
                task.measures = measured(data, task.begin, task.end)

            halves = split(data, task)
            if n <= options.max_leaf and task.parent >= 0:
                if not worth_it(options, task, halves):
                    tell_parent(data.nodes, task, task.begin, n)
                    continue

            if stop_size == 0:
                task.slot = slot
                slot = slot + 1
            max_depth[0] = wp.max(max_depth[0], task.depth)
            tell_parent(data.nodes, task, task.slot, 0)
            data.used[task.slot] = wp.uint8(1)
            node = Bvh2Node()
            node.lo_0 = low_of(halves.left.box)
            node.hi_0 = high_of(halves.left.box)
            node.lo_1 = low_of(halves.right.box)
            node.hi_1 = high_of(halves.right.box)
            node.first_0 = task.begin
            node.count_0 = halves.middle - task.begin
            node.first_1 = halves.middle
            node.count_1 = task.end - halves.middle
            data.nodes[task.slot] = node
            # A single record is a leaf; others find out for themselves.
            if node.count_1 > 1:
                stack[size] = child_of(task, halves, 1)
                size = size + 1
            if node.count_0 > 1:
                stack[size] = child_of(task, halves, 0)
                size = size + 1

    return build_ranges
