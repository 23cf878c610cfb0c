"""The builder of k-d trees, octrees and BSP trees, on the CPU: it splits cells from the root down, until no split is cheaper than a leaf.
A reference is a primitive and the box of its part in a cell. The host launches the builder once for the top of the tree, which defers small
cells, and then on all cores for the deferred cells. A launch works depth first, so that it stores only the references along one path. The
trees differ in how a cell is split: kernels.build.cell_splits."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.build.clip import Shapes
from wrt.kernels.build.records import BuildRecord
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.plane_layouts import LEAF, BspNode, OctreeLayout
from wrt.kernels.traverse.planes import STACK_SIZE

DEFERRED = wp.constant(-1)  # `axis` of a node that a later launch builds; `first` is the index of its cell in CellOutput.deferred
OCTANTS = wp.constant(5)  # `axis` of the node of an octree's cell; `count` is the mask of its octants


@wp.struct
class Cell:
    """A cell to build. It has the references first .. first + count - 1."""

    lo: wp.vec3  # lo, hi: its box. The cell of a BSP tree may be smaller.
    hi: wp.vec3
    corner: wp.vec3i  # Octree: lowest corner, in units of the finest cells.
    area: wp.float64  # Half its surface area; in a BSP tree estimated from the parts of boxes.
    wall_0: wp.vec3  # BSP tree: normals, inwards, of the last planes above the cell that are not across an axis.
    wall_1: wp.vec3
    first: int
    count: int
    budget: int  # Largest sum of the numbers of references in all leaves of the cell.
    depth: int  # Depth of the cell; the root's is 0.
    slot: int  # Index of the cell's node.


@wp.struct
class CellOptions:
    """Limits and SAH costs of a builder. A cell becomes a leaf if it has at most max_leaf references, or the depth max_depth."""

    max_leaf: int
    max_depth: int
    by_cost: int  # Octree: 1: a cell becomes a leaf if its octants do not cost less.
    cost_intersection: wp.float64  # Cost of a primitive.
    cost_node: wp.float64  # Cost of a node.
    empty_bonus: wp.float64  # k-d tree: fraction by which the cost of a split is reduced if one side is empty.
    sampled: int  # Largest number of references whose boxes propose planes across an axis.
    triangles: int  # BSP tree: largest number of triangles that propose other planes.
    keep: int  # Cells of keep / 8 to `keep` references are deferred; 0: none.
    leaf_visit: int  # 1: the SAH cost counts leaves as nodes.
    layout: OctreeLayout  # Octree.


@wp.struct
class CellWork:
    """Scratch of a launch with n references and a budget: the references of pending cells, as a stack, and arrays for one split."""

    references: wp.array(dtype=BuildRecord)  # Length: the budget.
    parts: wp.array(dtype=BuildRecord)  # Length: the budget.
    sides: wp.array(dtype=wp.uint8)  # sides[i]: mask of the parts of the cell that list reference i. Length: the budget.
    lows: wp.array(dtype=wp.float32)  # lows, highs: scratch of a sweep. Length: n.
    highs: wp.array(dtype=wp.float32)


@wp.struct
class CellTotals:
    """Totals of a launch."""

    nodes: int
    leaves: int
    references: int  # In leaves.
    deferred: int  # Deferred cells.
    records: int  # References of deferred cells.
    depth: int  # Number of nodes on the longest path.
    cost: wp.float64  # Sum of half surface areas: of each inner node, and of each leaf times its number of references.


@wp.struct
class CellOutput:
    """The output of a launch."""

    nodes: wp.array(dtype=BspNode)  # The root first. Children are consecutive.
    order: wp.array(dtype=wp.int32)  # prim_id of the primitives, leaf after leaf.
    deferred: wp.array(dtype=Cell)  # Cells for later launches, with the references `records` from `first` on.
    records: wp.array(dtype=BuildRecord)
    totals: wp.array(dtype=CellTotals)  # Length 1.


@wp.struct
class Split:
    """A plane that splits a cell, or the octants of a cell. Points p with dot(normal, p) + offset = 0 are in the plane."""

    axis: int  # As BspNode.axis; OCTANTS: the octants; LEAF: no split.
    normal: wp.vec3d
    offset: wp.float64
    tolerance: float  # As BspNode.tolerance.
    pad: wp.float64  # BSP tree: a reference that extends beyond the plane by at most `pad` is not listed on that side.
    low_flat: bool  # BSP tree: references in the plane are listed below the plane (True) or above it.
    cost: wp.float64


class Rule(NamedTuple):
    """How the cells of a tree are split into parts: below and above a plane, or octants."""

    parts: int
    keeps_empty: bool  # True: a part without references has a node.
    choose: Any  # (shapes, work, cell, options) -> Split, which also writes work.sides
    part: Any  # (cell, split, options, k) -> Cell: box, corner and area of part k
    clip: Any  # (shapes, reference, split, k, straddles) -> Box of the reference in part k; straddles: other parts list it, too


@wp.func
def write_leaf(work: CellWork, cell: Cell, options: CellOptions, out: CellOutput, totals: CellTotals) -> CellTotals:
    node = BspNode()
    node.axis = LEAF
    node.first = totals.references
    node.count = cell.count
    out.nodes[cell.slot] = node
    for i in range(cell.count):
        out.order[totals.references + i] = work.references[cell.first + i].prim_id
    totals.references += cell.count
    totals.leaves += 1
    totals.cost += cell.area * wp.float64(cell.count + options.leaf_visit)
    return totals


@wp.func
def write_node(out: CellOutput, cell: Cell, split: Split, first: int, mask: int):
    """Write an inner node, whose children are consecutive from `first` on; mask: the parts that have a node."""
    node = BspNode()
    node.normal = wp.vec3(split.normal)
    node.offset = float(split.offset)
    node.tolerance = split.tolerance
    node.axis = split.axis
    node.first = first
    node.count = mask
    out.nodes[cell.slot] = node


@wp.func
def defer(work: CellWork, cell: Cell, out: CellOutput, totals: CellTotals) -> CellTotals:
    """Store a cell and its references for a later launch."""
    node = BspNode()
    node.axis = DEFERRED
    node.first = totals.deferred
    out.nodes[cell.slot] = node
    for i in range(cell.count):
        out.records[totals.records + i] = work.references[cell.first + i]
    cell.first = totals.records
    out.deferred[totals.deferred] = cell
    totals.deferred += 1
    totals.records += cell.count
    return totals


def make_divide(rule: Rule) -> Any:
    """Make divide(shapes, work, cell, split, options, k, total) -> Cell."""
    part_of, clip = rule.part, rule.clip

    @wp.func
    def divide(shapes: Shapes, work: CellWork, cell: Cell, split: Split, options: CellOptions, k: int, total: int) -> Cell:
        """Append the references in part k of a cell to work.parts, which has `total` references. Return the part; its `budget` is the
        number of references that work.sides lists."""
        part = part_of(cell, split, options, k)
        part.first = cell.first + total
        part.count = 0
        part.budget = 0
        for i in range(cell.first, cell.first + cell.count):
            sides = int(work.sides[i])
            if (sides >> k) & 1 != 0:
                reference = work.references[i]
                box = clip(shapes, reference, split, k, (sides & (sides - 1)) != 0)
                part.budget += 1
                if box.lo[0] < box.hi[0]:
                    reference.lo = box.lo
                    reference.hi = box.hi
                    work.parts[total + part.count] = reference
                    part.count += 1
        return part

    return divide


@cache
def make_build_cells(rule: Rule) -> Any:
    """Make the kernel build_cells of a kind of tree."""
    parts, choose, divide = rule.parts, rule.choose, make_divide(rule)

    @kernel
    def build_cells(shapes: Shapes, records: wp.array(dtype=BuildRecord), roots: wp.array(dtype=Cell), options: CellOptions,
                    work: CellWork, out: CellOutput):
        """Build the subtree of the cell roots[0], whose references are `records`, in one thread."""
        stack = wp.zeros(shape=wp.static((parts - 1) * STACK_SIZE + 2), dtype=Cell)
        stack[0] = roots[0]
        for i in range(stack[0].count):
            work.references[i] = records[i]
        size = int(1)
        totals = CellTotals()
        totals.nodes = 1
        while size > 0:
            size = size - 1
            cell = stack[size]
            if cell.count <= options.keep and 8 * cell.count > options.keep:
                totals = defer(work, cell, out, totals)
                continue
            totals.depth = wp.max(totals.depth, cell.depth + 1)
            split = Split()
            split.axis = LEAF
            if cell.count > options.max_leaf and cell.depth < options.max_depth and totals.nodes + parts <= out.nodes.shape[0]:
                split = choose(shapes, work, cell, options)
            if split.axis == LEAF:
                totals = write_leaf(work, cell, options, out, totals)
                continue

            # The parts replace the cell on the stack of references. Each gets a share of the cell's budget in proportion to its references.
            begin = size
            total = int(0)
            listed = int(0)
            mask = int(0)
            for k in range(parts):
                part = divide(shapes, work, cell, split, options, k, total)
                total += part.count
                if part.count > 0 or wp.static(rule.keeps_empty):
                    mask = mask | (1 << k)
                    part.budget = wp.max(part.budget, 1)
                    listed += part.budget
                    part.depth = cell.depth + 1
                    stack[size] = part
                    size = size + 1
            for i in range(total):
                work.references[cell.first + i] = work.parts[i]
            write_node(out, cell, split, totals.nodes, mask)
            totals.cost += cell.area
            for k in range(begin, size):
                stack[k].slot = totals.nodes + k - begin
                stack[k].budget = int(wp.int64(cell.budget) * wp.int64(stack[k].budget) / wp.int64(listed))
            totals.nodes += size - begin
        out.totals[0] = totals

    return build_cells
