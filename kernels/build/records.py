"""Records of primitives, ranges of records, and their bounds, for the top-down builders of binary BVHs."""

import warp as wp

from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node
from wrt.kernels.wide.lanes import row_type

# Depth limit. A range that could exceed it is split by number of records instead of the SAH: that takes ceil(log2(n)) more levels.
MAX_DEPTH = wp.constant(STACK_SIZE - 2)
# A box as one vector: low corner, negated high corner, two unused entries. The entry-wise minimum of two rows is the box around both.
Row = row_type(8)


@wp.struct
class BuildRecord:
    """A primitive's box and prim_id."""

    lo: wp.vec3
    hi: wp.vec3
    prim_id: int


@wp.struct
class Measures:
    """Bounds of a range of records: around their boxes, and around their centroids."""

    box: Row
    centers: Row


@wp.struct
class BuildTask:
    """A range of records begin .. end - 1, which becomes child `side` of node `parent` (-1: the root): a leaf, or the inner node `slot`."""

    begin: int
    end: int
    limit: int  # With spatial splits: end of the range's space, which may be larger than the range.
    slot: int
    parent: int
    side: int
    depth: int
    measures: Measures


@wp.struct
class BuildOptions:
    """Limits and costs of a builder."""

    max_leaf: int  # Largest number of primitives in a leaf.
    row: int  # Number of primitives in a row: they are tested at once.
    cost_traversal: float  # SAH cost of a node.
    cost_intersection: float  # SAH cost of a row of primitives.


@wp.struct
class BuildData:
    """Arrays of a builder, with one entry per record unless a comment says otherwise. Some arrays serve only sweep or spatial splits."""

    records: wp.array(dtype=BuildRecord)  # The build reorders them.
    nodes: wp.array(dtype=Bvh2Node)
    used: wp.array(dtype=wp.uint8)  # 1 for each slot of `nodes` that has a node.
    boxes: wp.array(dtype=BuildRecord)  # Sweep: the records in their original order. Spatial splits: scratch.
    order: wp.array(dtype=wp.int32)  # Sweep: for each of the three axes, the indices into `boxes` sorted by centroid.
    area: wp.array(dtype=wp.float32)  # Sweep: scratch.
    left: wp.array(dtype=wp.uint8)  # Sweep: scratch. Spatial splits: 1 for records in leaves.
    scratch: wp.array(dtype=wp.int32)  # Sweep: scratch.
    corners: wp.array(dtype=wp.vec3)  # Spatial splits: triangle i has the corners from 3 i on. Spheres have none: their boxes are clipped.
    scale: float  # Spatial splits: area_scale of the scene's box.
    min_overlap: float  # Overlap of the sides of an object split, as row_area with `scale`, above which a spatial split is tried.


@wp.struct
class Halves:
    """A split range of records: the left and the right side."""

    middle: int  # Index of the first record of the right side.
    count_0: int  # Number of records on the left side.
    count_1: int  # Number of records on the right side.
    left: Measures
    right: Measures


@wp.func
def row_count(options: BuildOptions, n: int) -> float:
    """Return the number of rows of options.row primitives that n primitives fill."""
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
    """Return the entry-wise minimum: the box around both boxes. wp.min also handles NaN, and takes three times as long."""
    out = Row()
    for k in range(8):
        out[k] = wp.where(b[k] < a[k], b[k], a[k])
    return out


@wp.func
def area_scale(box: Row) -> float:
    """Return the factor that scales half of a box's longest side to 1. With this factor, `row_area` neither under- nor overflows."""
    e = 0.5 * high_of(box) - 0.5 * low_of(box)
    return 1.0 / wp.max(wp.max(wp.max(e[0], e[1]), e[2]), 2.0**-126.0)


@wp.func
def row_area(box: Row, scale: float) -> float:
    """Return half the surface area of a box whose sides are first multiplied by scale / 2; 0 for an empty box."""
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
def balanced_depth(n: int) -> int:
    """Return the depth of a balanced tree over n primitives: ceil(log2(n))."""
    result = int(0)
    while result < 31 and (1 << result) < n:  # 1 << 31 is negative
        result = result + 1
    return result


@wp.func
def measure(data: BuildData, begin: int, end: int) -> Measures:
    """Return the bounds of the records begin .. end - 1."""
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
def unmeasured_halves(task: BuildTask, middle: int) -> Halves:
    """Return the halves of a range that is split before record `middle`, without their bounds."""
    out = Halves()
    out.middle = middle
    out.count_0 = middle - task.begin
    out.count_1 = task.end - middle
    return out


@wp.func
def measure_halves(data: BuildData, task: BuildTask, middle: int) -> Halves:
    """Return the halves of a range that is split before record `middle`, with their bounds."""
    out = unmeasured_halves(task, middle)
    out.left = measure(data, task.begin, middle)
    out.right = measure(data, middle, task.end)
    return out


@wp.func
def link_to_parent(nodes: wp.array(dtype=Bvh2Node), task: BuildTask, first: int, count: int):
    """Store a finished range in its parent node: a leaf (count > 0), or the inner node `first` (count = 0)."""
    parent = task.parent
    if parent >= 0:
        if task.side == 0:
            nodes[parent].first_0 = first
            nodes[parent].count_0 = count
        else:
            nodes[parent].first_1 = first
            nodes[parent].count_1 = count
