"""What the builders of binary BVHs from the top down work on: records, ranges of them, and what ranges measure."""

import warp as wp

from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node
from wrt.kernels.wide.lanes import row_type

# From here on a range is halved by number, which takes ceil(log2(n)) more levels, whatever the SAH would like.
MAX_DEPTH = wp.constant(STACK_SIZE - 2)
# A box as one row, low corner and negated high one (two lanes are not used): the lower numbers of two rows are the box around both.
Row = row_type(8)


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
    """records: rearranged; of the sweep: boxes: the records as they were, order: for each axis, one after another, the boxes by
    centroid; area, left, scratch: room, one entry a record.

    Of spatial splits: boxes: room; left: which records are in leaves; corners: of triangle i from 3 i on (what is no triangle, a
    sphere, is cut by its box); min_overlap: the least overlap of an object split's sides for a spatial split to be tried, in units
    of the scene's own size: scale is its area_scale.
    """

    records: wp.array(dtype=BuildRecord)
    nodes: wp.array(dtype=Bvh2Node)
    used: wp.array(dtype=wp.uint8)
    boxes: wp.array(dtype=BuildRecord)
    order: wp.array(dtype=wp.int32)
    area: wp.array(dtype=wp.float32)
    left: wp.array(dtype=wp.uint8)
    scratch: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.vec3)
    scale: float
    min_overlap: float


@wp.struct
class Halves:
    """A split range: where the right side begins, how many records both sides have, and what they measure."""

    middle: int
    count_0: int
    count_1: int
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
    """The factor that makes a range's longest side 1, so that no area under- or overflows: what `row_area` wants."""
    e = 0.5 * high_of(box) - 0.5 * low_of(box)
    return 1.0 / wp.max(wp.max(wp.max(e[0], e[1]), e[2]), 2.0**-126.0)


@wp.func
def row_area(box: Row, scale: float) -> float:
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
def levels(n: int) -> int:
    """ceil(log2(n)): the depth of a balanced tree over n primitives."""
    result = int(0)
    while result < 31 and (1 << result) < n:  # 1 << 31 is negative
        result = result + 1
    return result


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
def parted_at(task: BuildTask, middle: int) -> Halves:
    """Not yet measured."""
    out = Halves()
    out.middle = middle
    out.count_0 = middle - task.begin
    out.count_1 = task.end - middle
    return out


@wp.func
def halves_at(data: BuildData, task: BuildTask, middle: int) -> Halves:
    out = parted_at(task, middle)
    out.left = measured(data, task.begin, middle)
    out.right = measured(data, middle, task.end)
    return out


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
