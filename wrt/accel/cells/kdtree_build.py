"""Builder of k-d trees: binned SAH in NumPy for large cells, and a kernel that tries all planes for the subtrees below."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.accel.cells.common import require_between
from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Built
from wrt.core.building import tally
from wrt.core.checks import shown
from wrt.core.device import launch, load_kernel, on_host, records, start, upload
from wrt.core.errors import InputError
from wrt.core.threads import run_all
from wrt.core.types import WarpStruct
from wrt.kernels.build import kdtree as kernels
from wrt.kernels.build.clip import Clippable, clip_references
from wrt.kernels.build.kdtree_split import split_cost
from wrt.kernels.traverse.kdtree import LEAF, STACK_SIZE, KdNode
from wrt.kernels.units.box import half_area

BINS = 64
# Triangles outside of these sizes are not clipped, because the error margin of clipping would underflow or be infinite.
CLIP_SIZES = (1e-30, 1e30)
MAX_IN_LEAF = 1 << 24  # primitives, because a node stores their number as a float32.
MAX_INDEX = 1 << 29  # Of a node or reference, because a node's word has 29 bits for it.
Part = tuple[np.ndarray, np.ndarray, Any]  # nodes, order and totals of a subtree.


@dataclass(frozen=True)
class KdOptions:
    """Options of the k-d tree. Raises InputError for values out of range."""

    max_leaf: int = 1  # Cells of so many primitives or fewer are not split.
    max_depth: int | None = None  # Levels below the root; None: 8 + 1.3 log2 n.
    by_cost: bool = True  # Do not split if that costs more than a leaf.
    cost_traversal: float = 2.0  # SAH cost of a node.
    cost_intersection: float = 1.0  # SAH cost of a primitive.
    empty_bonus: float = 0.1  # Discount, 0 to 1, for splits that cut off empty space.
    perfect_below: int = 65536  # Cells with more primitives are split between 64 bins, other cells at the best of all planes.
    clip: bool = True  # Clip triangles to cells exactly.
    max_growth: float = 16.0  # Limit of references and empty leaves per primitive.

    def __post_init__(self) -> None:
        if self.max_depth is not None and (isinstance(self.max_depth, bool) or not isinstance(self.max_depth, int)):
            raise InputError(f"must be int or None, got {shown(self.max_depth)}", argument="max_depth")
        require_between(max_leaf=(self.max_leaf, 1, MAX_IN_LEAF), max_depth=(self.max_depth or 0, 0, STACK_SIZE),
                        perfect_below=(self.perfect_below, 1024, 1 << 27), cost_traversal=(self.cost_traversal, 0.0, 1e6),
                        cost_intersection=(self.cost_intersection, 0.0, 1e6), empty_bonus=(self.empty_bonus, 0.0, 1.0),
                        max_growth=(self.max_growth, 1.0, 1e4))

    def depth(self, n: int) -> int:
        """Return max_depth; None: 8 + 1.3 log2 n for n primitives (Havran 2000; Pharr et al., "Physically Based Rendering", 4.4)."""
        if self.max_depth is not None:
            return self.max_depth
        return min(round(8.0 + 1.3 * np.log2(max(n, 1))), STACK_SIZE)


class Cell(NamedTuple):
    """A cell in which a subtree is built."""

    cell_lo: np.ndarray
    cell_hi: np.ndarray
    prim_id: np.ndarray  # (n,), primitives that overlap the cell
    lo: np.ndarray  # lo, hi: (n, 3), boxes of the primitives' parts in the cell
    hi: np.ndarray
    depth: int  # levels below the tree's root
    budget: int  # limit of references and empty leaves in the subtree
    slot: int  # index of the cell's node


def build_tree(geometry: Geometry, options: KdOptions, threads: int) -> Built:
    """Build the tree, which does not depend on `threads`. Built.sah_cost counts 1 per node and 1 per primitive."""
    lo, hi = geometry.bounds()
    n = len(lo)
    if n == 0:
        nodes = records(KdNode, 1)
        nodes["word"] = LEAF
        nowhere = np.full(3, np.inf, np.float32)
        return Built({"nodes": nodes, "lo": nowhere, "hi": -nowhere, "reach": np.float32(0.0)}, np.zeros(0, np.int32), 0, 1, 1, 0.0)
    hi = np.where(lo < hi, hi, np.nextafter(hi, np.float32(np.inf)))  # no box is flat
    shapes, reach = clippable(geometry, lo, hi, options.clip)
    budget = int(min(options.max_growth * n + 64, MAX_INDEX / 2))
    root = Cell(lo.min(axis=0), hi.max(axis=0), np.arange(n, dtype=np.int32), lo, hi, 0, budget, 0)
    top, tasks, area = split_top(root, shapes, options)
    parts = build_subtrees(tasks, shapes, options, threads)
    return joined(top, tasks, parts, root, area, reach)


def clippable(geometry: Geometry, lo: np.ndarray, hi: np.ndarray, clip: bool) -> tuple[WarpStruct, float]:
    """Upload the primitives as kernels.build.clip.Clippable; return them, and the largest extent of the triangles to be clipped."""
    cpu = start("cpu")
    with np.errstate(over="ignore"):
        extent = (hi - lo).max(axis=1)
    exact = (extent > CLIP_SIZES[0]) & (extent < CLIP_SIZES[1]) & (np.arange(len(lo)) < len(geometry.faces)) & clip
    shapes = Clippable()
    shapes.vertices = upload(geometry.vertices, wp.vec3, cpu)
    shapes.faces = upload(geometry.faces, wp.vec3i, cpu)
    shapes.lo, shapes.hi = upload(lo, wp.vec3, cpu), upload(hi, wp.vec3, cpu)
    shapes.exact = upload(exact.astype(np.uint8), wp.uint8, cpu)
    return shapes, float(extent[exact].max(initial=0.0))


def split_top(root: Cell, shapes: WarpStruct, options: KdOptions) -> tuple[list[tuple[float, int]], list[Cell], float]:
    """Split large cells; return nodes (split, word) as in KdNode, the cells that remain, and the sum of the split cells' half areas."""
    max_depth = options.depth(len(root.prim_id))
    nodes, tasks, area = [(0.0, 0)], [], 0.0
    todo = [root]
    while todo:
        cell = todo.pop()
        n = len(cell.prim_id)
        plane = None
        if n > max(options.perfect_below, options.max_leaf) and cell.depth < max_depth:
            plane = binned_split(cell, options)
        if plane is None:
            tasks.append(cell)
            continue
        nodes[cell.slot] = (float(plane[1]), 4 * len(nodes) + plane[0])
        area += float(half_area.func(cell.cell_hi.astype(np.float64) - cell.cell_lo))
        todo += reversed(divide(cell, plane, shapes, len(nodes)))
        nodes += [(0.0, 0), (0.0, 0)]
    return nodes, tasks, area


def binned_split(cell: Cell, options: KdOptions) -> tuple[int, np.float32] | None:
    """Return the cheapest plane (axis, position) between bins. None: no plane keeps the budget, or by_cost prefers a leaf.

    Boxes are counted in the bins where they begin and in the bins where they end (Shevtsov, Soupikov and Kapustin 2007, "Highly
    Parallel Fast KD-tree Construction").
    """
    n = len(cell.prim_id)
    best = options.cost_intersection * n if options.by_cost else np.inf
    found = None
    e = cell.cell_hi.astype(np.float64) - cell.cell_lo
    for axis in range(3):
        low, width = float(cell.cell_lo[axis]), e[axis]
        planes = (low + width / BINS * np.arange(1, BINS)).astype(np.float32)
        if not np.isfinite(width) or not (np.diff(planes) > 0.0).all():
            continue
        # A box that begins in a plane is only on the right of the plane. A box that ends in a plane is only on the left of it.
        left = np.cumsum(np.bincount(np.searchsorted(planes, cell.lo[:, axis], side="right"), minlength=BINS))[:-1]
        right = n - np.cumsum(np.bincount(np.searchsorted(planes, cell.hi[:, axis], side="left"), minlength=BINS))[:-1]
        share = planes.astype(np.float64) - low
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            cost = split_cost.func(options, options.cost_intersection / half_area.func(e), (e[axis - 2], e[axis - 1]), share,
                                   width - share, left, right)
        cost = np.where((left == 0) | (right == 0), (1.0 - options.empty_bonus) * cost, cost)
        inside = (planes > cell.cell_lo[axis]) & (planes < cell.cell_hi[axis])
        inside &= np.maximum(left, 1) + np.maximum(right, 1) <= cell.budget
        cost = np.where(inside & ~np.isnan(cost), cost, np.inf)
        if cost.min() < best:
            best, found = cost.min(), (axis, planes[np.argmin(cost)])
    return found


def divide(cell: Cell, plane: tuple[int, np.float32], shapes: WarpStruct, slot: int) -> list[Cell]:
    """Return the cells on both sides of the plane, whose nodes are `slot` and slot + 1. Straddling primitives are clipped."""
    axis, position = plane
    goes = [cell.lo[:, axis] < position, cell.hi[:, axis] > position]
    straddles = goes[0] & goes[1]
    counts = [max(int(np.count_nonzero(side)), 1) for side in goes]
    spare = cell.budget - sum(counts)
    budgets = [0, counts[1] + int(spare * counts[1] / sum(counts))]
    budgets[0] = cell.budget - budgets[1]
    out = []
    for side in (0, 1):
        cell_lo, cell_hi = cell.cell_lo.copy(), cell.cell_hi.copy()
        (cell_hi if side == 0 else cell_lo)[axis] = position
        whole = goes[side] & ~straddles
        cut = cell.prim_id[straddles]
        cut_lo, cut_hi = clipped(shapes, cut, cell_lo, cell_hi)
        there = cut_lo[:, 0] < cut_hi[:, 0]
        prim_id, lo, hi = (np.concatenate([a[whole], b[there]]) for a, b in (
            (cell.prim_id, cut), (cell.lo, cut_lo), (cell.hi, cut_hi)))
        out.append(Cell(cell_lo, cell_hi, prim_id, lo, hi, cell.depth + 1, budgets[side], slot + side))
    return out


def clipped(shapes: WarpStruct, prim_id: np.ndarray, cell_lo: np.ndarray, cell_hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes lo, hi (n, 3) of the parts of primitives inside a cell."""
    cpu = start("cpu")
    lo, hi = (wp.zeros(len(prim_id), dtype=wp.vec3, device=cpu) for _ in range(2))
    launch(clip_references, len(prim_id), shapes, upload(prim_id, wp.int32, cpu), wp.vec3(*cell_lo), wp.vec3(*cell_hi), lo, hi)
    return lo.numpy(), hi.numpy()


def build_subtrees(tasks: list[Cell], shapes: WarpStruct, options: KdOptions, threads: int) -> list[Part]:
    """Build a subtree in each cell, on all threads."""
    chosen = kernels.KdOptions()
    chosen.max_leaf, chosen.by_cost, chosen.empty_bonus = options.max_leaf, options.by_cost, options.empty_bonus
    chosen.cost_traversal, chosen.cost_intersection = options.cost_traversal, options.cost_intersection
    chosen.max_depth = options.depth(shapes.exact.shape[0])
    load_kernel(kernels.build_subtree, start("cpu"))
    parts: list[Any] = [None] * len(tasks)
    finished = tally(sum(len(task.prim_id) for task in tasks))

    def job(i: int) -> None:
        parts[i] = build_subtree(tasks[i], shapes, chosen)
        finished(len(tasks[i].prim_id))

    # The largest cells come first, so that all threads end at about the same time.
    run_all([partial(job, i) for i in sorted(range(len(tasks)), key=lambda i: -len(tasks[i].prim_id))], threads)
    return parts


def build_subtree(cell: Cell, shapes: WarpStruct, options: WarpStruct) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Build a subtree in one launch. The allocated memory is an upper bound; most of it is never touched."""
    cpu = start("cpu")
    n = len(cell.prim_id)
    work = kernels.KdWork()
    work.prim_id = upload(cell.prim_id, wp.int32, cpu)
    work.lo, work.hi = upload(cell.lo, wp.vec3, cpu), upload(cell.hi, wp.vec3, cpu)
    work.side = wp.empty(n, dtype=wp.uint8, device=cpu)
    work.events = wp.empty(6 * cell.budget, dtype=kernels.KdEvent, device=cpu)
    for name in ("kept_left", "kept_right", "fresh_left", "fresh_right", "scratch"):
        setattr(work, name, wp.empty(6 * n, dtype=kernels.KdEvent, device=cpu))
    out = kernels.KdOutput()
    out.nodes = wp.empty(2 * cell.budget, dtype=KdNode, device=cpu)
    out.references = wp.empty(cell.budget, dtype=wp.int32, device=cpu)
    out.totals = wp.zeros(1, dtype=kernels.KdTotals, device=cpu)
    root = kernels.KdTask()
    root.lo, root.hi = wp.vec3(*cell.cell_lo), wp.vec3(*cell.cell_hi)
    root.budget, root.depth = cell.budget, cell.depth
    launch(kernels.build_subtree, 1, shapes, work, root, options, out)
    totals = on_host(out.totals)[0].copy()
    return on_host(out.nodes)[: totals["nodes"]].copy(), out.references.numpy()[: totals["references"]].copy(), totals


def joined(top: list[tuple[float, int]], tasks: list[Cell], parts: list[Part], root: Cell, area: float,
           reach: float) -> Built:
    """Join the top and the subtrees, whose roots go to their cells' slots. area: from `split_top`; reach: from `clippable`."""
    n_nodes = len(top) + sum(len(nodes) - 1 for nodes, _, _ in parts)
    n_references = sum(len(references) for _, references, _ in parts)
    if max(n_nodes, n_references) >= MAX_INDEX:
        raise InputError(f"a k-d tree of {n_references} references is too large", hint="lower max_growth or max_depth")
    nodes = records(KdNode, n_nodes)
    nodes["split"][: len(top)], nodes["word"][: len(top)] = zip(*top, strict=True)
    order = np.empty(n_references, np.int32)
    next_node, next_reference = len(top), 0
    for cell, (subtree, references, _) in zip(tasks, parts, strict=True):
        leaf = (subtree["word"] & 3) == LEAF
        if (subtree["split"][leaf] > MAX_IN_LEAF).any():
            raise InputError(f"more than {MAX_IN_LEAF} primitives in one leaf of a k-d tree")
        subtree["word"] += np.where(leaf, 4 * next_reference, 4 * (next_node - 1)).astype(np.int32)
        nodes[cell.slot] = subtree[0]
        nodes[next_node : next_node + len(subtree) - 1] = subtree[1:]
        order[next_reference : next_reference + len(references)] = references
        next_node += len(subtree) - 1
        next_reference += len(references)
    totals = [totals for _, _, totals in parts]
    cost = (area + sum(float(t["cost"]) for t in totals)) / float(half_area.func(root.cell_hi.astype(np.float64) - root.cell_lo))
    leaves, depth = sum(int(t["leaves"]) for t in totals), max(int(t["depth"]) for t in totals)
    arrays: dict[str, Any] = {"nodes": nodes, "lo": root.cell_lo, "hi": root.cell_hi, "reach": np.float32(reach)}
    return Built(arrays, order, n_nodes - leaves, leaves, depth, cost)
