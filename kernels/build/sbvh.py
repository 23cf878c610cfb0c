"""The inner loop of the builder of binary BVHs with spatial splits, on the CPU.
Stich, Friedrich and Dietrich 2009, "Spatial Splits in Bounding Volume Hierarchies". If the sides of the best object split overlap, a plane
may split the range instead; then both sides list the primitives that the plane cuts. The array of references has spare space for the
additional references. The two sides of a range share its spare space in proportion to their sizes, so that all cores can build subtrees."""

import warp as wp

from wrt.kernels.build.bvh2 import BIN_COUNT, BINS, Split, bin_of, binned_split, bins_of
from wrt.kernels.build.records import (
    MAX_DEPTH,
    BuildData,
    BuildRecord,
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
    measure,
    row_area,
    row_of,
)
from wrt.kernels.units.box import box_pad, padded_hi, padded_lo


@wp.func
def crossing(a: wp.vec3, b: wp.vec3, axis: int, plane: float) -> wp.vec3:
    """Return the intersection of the edge from a to b with a plane across an axis. Its rounding error is far below the pads of boxes."""
    s = (wp.float64(plane) - wp.float64(a[axis])) / (wp.float64(b[axis]) - wp.float64(a[axis]))
    p = wp.vec3d(a) + s * (wp.vec3d(b) - wp.vec3d(a))
    return wp.vec3(p)


@wp.func
def clip_reference(record: BuildRecord, axis: int, low: float, high: float, corners: wp.array(dtype=wp.vec3)) -> BuildRecord:
    """Clip a reference to the part between the planes at `low` and `high` across an axis; the result has lo > hi if nothing remains.

    Conservative: the planes move outwards by the pads of the triangle's box. The box of the clipped part gets the same pads, and is cut off
    at the reference's box. A hit is within these pads of the triangle, and so of one of its parts. But t is clamped to the triangle's box.
    This moves the hit far if the ray grazes a triangle that lies in an axis plane. So if a triangle is no thicker than its pads, its box is
    clipped instead.
    """
    out = record
    out.lo[axis] = wp.max(record.lo[axis], low)
    out.hi[axis] = wp.min(record.hi[axis], high)
    first = 3 * record.prim_id
    if first >= corners.shape[0]:
        return out
    a = corners[first]
    b = corners[first + 1]
    c = corners[first + 2]
    lo = wp.min(wp.min(a, b), c)
    hi = wp.max(wp.max(a, b), c)
    pad = box_pad(lo, hi)
    e = hi - lo
    margin = 2.0 * pad + 2.0**-20.0 * wp.max(wp.max(wp.abs(lo)), wp.max(wp.abs(hi)))
    if not wp.min(e) > margin or not wp.isfinite(margin):
        return out
    part = empty_row()
    from_plane = low - margin
    to_plane = high + margin
    for k in range(3):
        p = wp.where(k == 0, a, wp.where(k == 1, b, c))
        q = wp.where(k == 0, b, wp.where(k == 1, c, a))
        if p[axis] >= from_plane and p[axis] <= to_plane:
            part = lower(part, row_of(p, p))
        if (p[axis] < from_plane) != (q[axis] < from_plane):
            x = crossing(p, q, axis, from_plane)
            part = lower(part, row_of(x, x))
        if (p[axis] > to_plane) != (q[axis] > to_plane):
            x = crossing(p, q, axis, to_plane)
            part = lower(part, row_of(x, x))
    out.lo = wp.max(out.lo, padded_lo(low_of(part), pad))
    out.hi = wp.min(out.hi, padded_hi(high_of(part), pad))
    return out


@wp.func
def is_empty(box: BuildRecord) -> bool:
    return box.lo[0] > box.hi[0] or box.lo[1] > box.hi[1] or box.lo[2] > box.hi[2]


@wp.func
def plane_of(low: float, high: float, k: int) -> float:
    """Return the coordinate of the plane between bins k - 1 and k of a range whose box extends from `low` to `high`."""
    f = float(k) / float(BINS)
    return low * (1.0 - f) + high * f


@wp.func
def spatial_bin(low: float, high: float, x: float) -> int:
    """Return the last bin that begins at or before the coordinate x. The result is consistent with `plane_of` to the last bit."""
    k = wp.clamp(int(float(BINS) * ((x - low) / (high - low))), 0, BINS - 1)
    while k > 0 and x < plane_of(low, high, k):
        k = k - 1
    while k < BINS - 1 and x >= plane_of(low, high, k + 1):
        k = k + 1
    return k


@wp.func
def spatial_split(records: wp.array(dtype=BuildRecord), task: BuildTask, corners: wp.array(dtype=wp.vec3), best: Split) -> Split:
    """Return the cheapest plane between two bins, or `best` if no plane costs less. Each side must have fewer references than the range.
    A reference is clipped to each bin that it meets."""
    scale = area_scale(task.measures.box)
    n = task.end - task.begin
    for axis in range(3):
        low = task.measures.box[axis]
        high = -task.measures.box[3 + axis]
        extent = high - low
        if extent > 0.0 and wp.isfinite(extent):
            enter = wp.zeros(shape=wp.static(BIN_COUNT), dtype=wp.int32)
            leave = wp.zeros(shape=wp.static(BIN_COUNT), dtype=wp.int32)
            box = wp.zeros(shape=wp.static(BIN_COUNT), dtype=Row)
            right_cost = wp.zeros(shape=wp.static(BIN_COUNT), dtype=wp.float32)
            right_count = wp.zeros(shape=wp.static(BIN_COUNT), dtype=wp.int32)
            for b in range(BINS):
                box[b] = empty_row()
            for i in range(task.begin, task.end):
                record = records[i]
                first = spatial_bin(low, high, record.lo[axis])
                last = spatial_bin(low, high, record.hi[axis])
                enter[first] = enter[first] + 1
                leave[last] = leave[last] + 1
                for b in range(first, last + 1):
                    part = record
                    if first < last:
                        part = clip_reference(record, axis, plane_of(low, high, b), plane_of(low, high, b + 1), corners)
                    if not is_empty(part):
                        box[b] = lower(box[b], row_of(part.lo, part.hi))
            side = empty_row()
            count = int(0)
            for k in range(BINS - 1):
                b = BINS - 1 - k
                side = lower(side, box[b])
                count = count + leave[b]
                right_cost[b] = row_area(side, scale) * float(count)
                right_count[b] = count
            side = empty_row()
            count = int(0)
            for b in range(1, BINS):
                side = lower(side, box[b - 1])
                count = count + enter[b - 1]
                cost = row_area(side, scale) * float(count) + right_cost[b]
                fits = count > 0 and count < n and right_count[b] > 0 and right_count[b] < n
                if fits and count + right_count[b] <= task.limit - task.begin and cost < best.cost:
                    best.axis = axis
                    best.bin = b
                    best.cost = cost
    return best


@wp.struct
class Sides:
    """Boxes and numbers of the references on both sides of a plane. A reference that the plane cuts counts on both sides."""

    left: Row
    right: Row
    n_left: int
    n_right: int


@wp.func
def measure_sides(data: BuildData, task: BuildTask, axis: int, plane: float) -> Sides:
    """Return the boxes and numbers of references on both sides of a plane across an axis."""
    parts = Sides()
    parts.left = empty_row()
    parts.right = empty_row()
    for i in range(task.begin, task.end):
        record = data.records[i]
        if record.hi[axis] < plane:
            parts.left = lower(parts.left, row_of(record.lo, record.hi))
            parts.n_left += 1
        elif record.lo[axis] >= plane:
            parts.right = lower(parts.right, row_of(record.lo, record.hi))
            parts.n_right += 1
        else:
            part = clip_reference(record, axis, -wp.inf, plane, data.corners)
            if not is_empty(part):
                parts.left = lower(parts.left, row_of(part.lo, part.hi))
                parts.n_left += 1
            part = clip_reference(record, axis, plane, wp.inf, data.corners)
            if not is_empty(part):
                parts.right = lower(parts.right, row_of(part.lo, part.hi))
                parts.n_right += 1
    return parts


@wp.func
def cheaper_side(parts: Sides, box: Row, scale: float) -> int:
    """Return the cheapest side for a reference with this box: -1 left, 1 right, 0 both (section 4.4, "reference unsplitting")."""
    area_0 = row_area(parts.left, scale)
    area_1 = row_area(parts.right, scale)
    both = area_0 * float(parts.n_left) + area_1 * float(parts.n_right)
    only_0 = row_area(lower(parts.left, box), scale) * float(parts.n_left) + area_1 * float(parts.n_right - 1)
    only_1 = area_0 * float(parts.n_left - 1) + row_area(lower(parts.right, box), scale) * float(parts.n_right)
    if only_0 < both and only_0 <= only_1:
        return -1
    return wp.where(only_1 < both, 1, 0)


@wp.func
def partition_by_plane(data: BuildData, task: BuildTask, split: Split) -> wp.vec2i:
    """Copy references left of the plane to data.boxes from task.begin upwards, references right of it from task.limit - 1 downwards.
    Return the numbers (left, right). A reference that the plane cuts is split, unless it costs less on one side, or no space is left."""
    scale = area_scale(task.measures.box)
    plane = plane_of(task.measures.box[split.axis], -task.measures.box[3 + split.axis], split.bin)
    parts = measure_sides(data, task, split.axis, plane)
    done_0 = int(0)
    done_1 = int(0)
    for i in range(task.begin, task.end):
        record = data.records[i]
        side = int(wp.where(record.hi[split.axis] < plane, -1, 1))  # as in cheaper_side
        if side > 0 and record.lo[split.axis] < plane:
            part_0 = clip_reference(record, split.axis, -wp.inf, plane, data.corners)
            part_1 = clip_reference(record, split.axis, plane, wp.inf, data.corners)
            if is_empty(part_1):
                side = -1
            elif not is_empty(part_0):
                box = row_of(record.lo, record.hi)
                side = cheaper_side(parts, box, scale)
                if side < 0:
                    parts.left = lower(parts.left, box)
                    parts.n_right -= 1
                elif side > 0:
                    parts.right = lower(parts.right, box)
                    parts.n_left -= 1
                elif done_0 + done_1 + 1 + task.end - i <= task.limit - task.begin:
                    data.boxes[task.begin + done_0] = part_0
                    done_0 = done_0 + 1
                    done_1 = done_1 + 1
                    data.boxes[task.limit - done_1] = part_1
                else:
                    side = -1
        if side < 0:
            data.boxes[task.begin + done_0] = record
            done_0 = done_0 + 1
        elif side > 0:
            done_1 = done_1 + 1
            data.boxes[task.limit - done_1] = record
    return wp.vec2i(done_0, done_1)


@wp.func
def object_split(data: BuildData, task: BuildTask) -> wp.vec2i:
    """Copy references to data.boxes as partition_by_plane does, but whole, by the bin of the centroid; return the numbers (left, right)."""
    n = task.end - task.begin
    bins = bins_of(task)
    split = Split()
    split.axis = -1
    if n > 2 and task.depth + balanced_depth(n) < MAX_DEPTH:
        split = binned_split(data, task, bins)
    done_0 = int(0)
    done_1 = int(0)
    for i in range(task.begin, task.end):
        record = data.records[i]
        left = bool(i < task.begin + n / 2)  # if no axis separates the centroids, or the tree gets too deep, halve the list
        if split.axis >= 0:
            left = bin_of(center_of(record), split.axis, bins) < split.bin
        if left:
            data.boxes[task.begin + done_0] = record
            done_0 = done_0 + 1
        else:
            done_1 = done_1 + 1
            data.boxes[task.limit - done_1] = record
    return wp.vec2i(done_0, done_1)


@wp.func
def box_of(records: wp.array(dtype=BuildRecord), begin: int, end: int) -> Row:
    out = empty_row()
    for i in range(begin, end):
        out = lower(out, row_of(records[i].lo, records[i].hi))
    return out


@wp.func
def copied_halves(data: BuildData, counts: wp.vec2i, task: BuildTask) -> Halves:
    """Return the halves, counts[0] and counts[1] references, that were copied to data.boxes. Fields `middle` and `centers` are not set."""
    out = Halves()
    out.count_0 = counts[0]
    out.count_1 = counts[1]
    out.left.box = box_of(data.boxes, task.begin, task.begin + counts[0])
    out.right.box = box_of(data.boxes, task.limit - counts[1], task.limit)
    return out


@wp.func
def split_references(data: BuildData, task: BuildTask) -> Halves:
    """Split by the best object split or, if its sides overlap and a plane costs less, by the best plane. Copy both sides to data.boxes."""
    scale = area_scale(task.measures.box)
    halves = copied_halves(data, object_split(data, task), task)
    n = task.end - task.begin
    lo = wp.max(low_of(halves.left.box), low_of(halves.right.box))
    overlap = row_area(row_of(lo, wp.min(high_of(halves.left.box), high_of(halves.right.box))), data.scale)
    if task.depth + balanced_depth(n) >= MAX_DEPTH or not overlap > data.min_overlap:
        return halves
    best = Split()
    best.axis = -1
    best.cost = (row_area(halves.left.box, scale) * float(halves.count_0)
                 + row_area(halves.right.box, scale) * float(halves.count_1))
    best = spatial_split(data.records, task, data.corners, best)
    if best.axis < 0:
        return halves
    counts = partition_by_plane(data, task, best)
    if counts[0] == 0 or counts[1] == 0:
        counts = object_split(data, task)
    return copied_halves(data, counts, task)


@wp.func
def share_space(data: BuildData, task: BuildTask, halves: Halves) -> Halves:
    """Copy both sides from data.boxes back to data.records, with free space behind each in proportion to its number of references."""
    free = task.limit - task.begin - halves.count_0 - halves.count_1
    share = int(wp.int64(free) * wp.int64(halves.count_0) / wp.int64(halves.count_0 + halves.count_1))
    middle = task.begin + halves.count_0 + share
    for i in range(halves.count_0):
        data.records[task.begin + i] = data.boxes[task.begin + i]
    for i in range(halves.count_1):
        data.records[middle + i] = data.boxes[task.limit - 1 - i]
    halves.middle = middle
    halves.left = measure(data, task.begin, task.begin + halves.count_0)
    halves.right = measure(data, middle, middle + halves.count_1)
    return halves
