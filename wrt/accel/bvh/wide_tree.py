"""Wide trees: binary BVHs collapsed into nodes of several children (kernels: kernels/build/wide.py)."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from wrt.accel.box_tree import BoxTree
from wrt.accel.bvh.builders import BinaryTree, expected_cost, half_areas
from wrt.accel.bvh.refit import Fitting
from wrt.accel.geometry import Geometry
from wrt.accel.queries.raw_launches import launch_raw
from wrt.core.device import launch_on, start, upload
from wrt.core.errors import InputError
from wrt.core.types import Kernel, WarpArray, WarpStruct
from wrt.core.warp_private import struct_record
from wrt.kernels.wide.layout import STACK_SIZE, node_size
from wrt.kernels.wide.references import EMPTY, MAX_FIRST, leaf_count, leaf_first, leaf_reference

SLOTS_PER_JOB = 1 << 16


@dataclass(frozen=True, eq=False)
class WideTree:
    """A tree of nodes with W children."""

    lo: np.ndarray  # (N, W, 3) float32, low corners of the children's boxes; empty boxes come first.
    hi: np.ndarray  # (N, W, 3) float32, high corners.
    children: np.ndarray  # (N, W) int32, see kernels.wide.references.
    order: np.ndarray  # (rows, W) int32, prim_id in each lane of the leaves' rows; -1 in an unused lane.
    leaves: int
    depth: int  # Number of nodes on the longest path from the root.

    @property
    def exists(self) -> np.ndarray:
        """Whether each child exists, (N, W) bool."""
        return self.children != EMPTY

    @property
    def areas(self) -> np.ndarray:
        """Half the surface area of each child's box, (N, W) float64; 0 for empty boxes."""
        return half_areas(self.lo, self.hi)

    @property
    def root_area(self) -> float:
        """Half the surface area of the root's box."""
        return float(half_areas(self.lo[0].min(axis=0), self.hi[0].max(axis=0)))

    def sah_cost(self, root: float) -> float:
        """Return the SAH cost. root: half the surface area of the root's box."""
        return expected_cost(root, self.areas, np.where(self.children < 0, leaf_count.func(self.children), 0))


def one_leaf(lo: np.ndarray, hi: np.ndarray, width: int) -> WideTree:
    """Return the tree over no box or one box. lo, hi: (0 or 1, 3) float32."""
    n = len(lo)
    low, high = (np.full((1, width, 3), end, np.float32) for end in (np.inf, -np.inf))
    children, order = np.full((1, width), EMPTY, np.int32), np.full((n, width), -1, np.int32)
    if n:
        low[0, -1], high[0, -1] = lo[0], hi[0]
        children[0, -1], order[0, 0] = leaf_reference.func(0, 1), 0
    return WideTree(low, high, children, order, n, 1)


def collapse_kernels() -> tuple[Kernel, ...]:
    """Return the kernels of `collapse`. They are imported when they are needed: a start with few primitives saves 40 ms."""
    from wrt.kernels.build.wide import collapse, subtree_costs

    return subtree_costs, collapse


def collapse(tree: BinaryTree, width: int, max_leaf: int, cost_traversal: float, cost_intersection: float) -> WideTree:
    """Collapse a binary tree of two or more leaves into the wide tree of least expected cost."""
    from wrt.kernels.build import wide as build_wide

    n = len(tree.nodes)
    options = build_wide.CollapseOptions()
    options.width, options.max_leaf, options.stack = width, max_leaf, STACK_SIZE
    options.cost_traversal, options.cost_intersection = cost_traversal, cost_intersection
    cells = int(build_wide.MAX_WIDTH) * n
    arrays = *np.zeros((2, n), np.int32), np.zeros(cells, np.float32), np.zeros(cells, np.uint8)
    trees = struct_record(build_wide.Subtrees, arrays)
    launch_raw(build_wide.subtree_costs, 1, tree.nodes, options, trees)
    children, (lo, hi) = np.empty(n * width, np.int32), np.empty((2, n * width, 3), np.float32)
    source, order, count = np.empty(width, np.int32), np.empty(len(tree.order) * width, np.int32), np.zeros(4, np.int32)
    out = struct_record(build_wide.WideTree, (children, lo, hi, source, order, count))
    launch_raw(build_wide.collapse, 1, tree.nodes, tree.order, options, trees, out)
    n_nodes, rows, leaves, depth = count.tolist()
    if rows > MAX_FIRST:
        raise InputError(f"a wide BVH holds at most {MAX_FIRST} rows of primitives, and these need {rows}",
                         hint="use accel='bvh2'")
    used = n_nodes * width
    boxes = lo[:used].reshape(-1, width, 3).copy(), hi[:used].reshape(-1, width, 3).copy()
    return WideTree(*boxes, children[:used].reshape(-1, width).copy(), order[: rows * width].reshape(-1, width).copy(), leaves, depth)


def wide_tree_of(tree: BoxTree, width: int) -> WideTree:
    """Convert a BoxTree in depth-first order to nodes of `width` children. Missing children come first."""
    missing = width - tree.width
    if missing < 0:
        raise InputError(f"must have at most {width} children per node, got {tree.width}", place="tree: child", hint="use bvh8")
    if len(tree.primitives) > MAX_FIRST:
        raise InputError(f"a wide BVH holds at most {MAX_FIRST} primitives, got {len(tree.primitives)}", hint="use accel='bvh2'")
    leaf, n = tree.count > 0, len(tree.child)
    children = np.where(leaf, leaf_reference.func(tree.child, np.maximum(tree.count, 1)), np.where(tree.count < 0, EMPTY, tree.child))
    lo, hi = (np.concatenate([np.full((n, missing, 3), end, np.float32), box], axis=1)
              for box, end in ((tree.lo, np.inf), (tree.hi, -np.inf)))
    children = packed(np.concatenate([np.full((n, missing), EMPTY), children], axis=1).astype(np.int32), width)
    lanes = lanes_of(children, tree.primitives.astype(np.int32), width)
    return WideTree(lo, hi, children, lanes, int(leaf.sum()), len(tree.levels()))


def fit_inputs(children: np.ndarray, order: WarpArray, starts: np.ndarray, fitting: Fitting) -> WarpStruct:
    """Return a kernels.build.wide_fit.Tree without nodes and boxes. children: references (N, width); starts: see `row_starts`."""
    from wrt.kernels.build.wide_fit import Tree

    tree, inner, up = Tree(), np.flatnonzero(children > 0), np.full(len(children), -1, np.int32)
    up[children.reshape(-1)[inner]] = inner
    tree.up, tree.children, tree.starts = (upload(each, wp.int32, order.device) for each in (up, (children != EMPTY).sum(axis=1), starts))
    tree.arrived, tree.order = wp.zeros(len(children), dtype=wp.int32, device=order.device), order
    tree.low, tree.high = fitting.low, fitting.high
    return tree


def fit(tree: WarpStruct, width: int, compressed: bool, threads: int) -> None:
    """Fit a kernels.build.wide_fit.Tree to the boxes of primitives. A graph can capture this."""
    from wrt.kernels.build.wide_fit import make_fit

    launch_on(tree.nodes.device, make_fit(width, compressed), width * len(tree.up), tree, None, threads=threads, step=SLOTS_PER_JOB,
              captured=True)


def refit(tree: WideTree, geometry: Geometry, threads: int) -> WideTree:
    """Fit the boxes to the geometry. Boxes that spatial splits clipped become the boxes of whole triangles."""
    (n, width), cpu = tree.children.shape, start("cpu")
    nodes = np.zeros((n, node_size(width, False) // width, width), np.float32)
    nodes[:, :6:2], nodes[:, 1:6:2], nodes[:, 6] = np.inf, -np.inf, tree.children.view(np.float32)
    fitting, order = Fitting(cpu, len(geometry), 0), upload(tree.order[tree.order >= 0], wp.int32, cpu)
    inputs = fit_inputs(tree.children, order, row_starts(tree.children, width), fitting)
    inputs.nodes = inputs.boxes = upload(nodes.reshape(-1), wp.float32, cpu)
    fitting.find_bounds(geometry.on(cpu), threads)
    fit(inputs, width, False, threads)
    lo, hi = (np.ascontiguousarray(nodes[:, end:6:2].transpose(0, 2, 1)) for end in range(2))
    return replace(tree, lo=lo, hi=hi)


def packed(children: np.ndarray, unit: int) -> np.ndarray:
    """Return the references with the leaves' first primitives renumbered without gaps, in units of `unit` primitives (1 or a row)."""
    leaf = children < 0
    references = children[leaf].astype(np.int64)
    count = leaf_count.func(references)
    units = -(-count // unit)
    place = np.empty(len(count), np.int64)
    in_order = np.argsort(leaf_first.func(references), kind="stable")
    place[in_order] = np.cumsum(units[in_order]) - units[in_order]
    out = children.copy()
    out[leaf] = leaf_reference.func(place, count)
    return out


def row_starts(children: np.ndarray, width: int) -> np.ndarray:
    """Return the index, in the order of the primitives, of each row's first primitive and, last, their number, (rows + 1,) int32.

    children: references in units of rows."""
    leaves = children[children < 0]
    row, count = leaf_first.func(leaves), leaf_count.func(leaves)
    starts = np.zeros(int((row - (-count // width)).max(initial=0)) + 1, np.int32)
    while len(row):  # once for each row of the largest leaf
        starts[row + 1] = np.minimum(count, width)
        longer = count > width
        row, count = row[longer] + 1, count[longer] - width
    return np.cumsum(starts, out=starts)


def lanes_of(children: np.ndarray, order: np.ndarray, width: int) -> np.ndarray:
    """Return the prim_id in each lane of the leaves' rows, (rows, width); -1 in an unused lane.

    children: references in units of rows. order: (R,) prim_ids of the leaves, one leaf after another.
    """
    starts = row_starts(children, width)[:, None]
    lanes = starts[:-1] + np.arange(width, dtype=np.int32)
    return np.where(lanes < starts[1:], order.take(lanes, mode="clip"), np.int32(-1))


def check_wide(children: np.ndarray, n_primitives: int, unit: int) -> None:
    """Raise InputError unless the references `children`, (N, width), form a tree with root 0 for which the traversal stack suffices.

    The leaves must hold n_primitives primitives without gaps. unit: number of primitives by which references to leaves count.
    """
    n = len(children)
    parent, child = links(children)
    if n == 0 or (child >= n).any() or (child <= parent).any():
        raise InputError("is damaged: a node leads out of the tree")
    if (np.bincount(child, minlength=n) != (np.arange(n) > 0)).any():
        raise InputError("is damaged: its nodes do not form a tree")
    leaves = ~np.sort(~children[children < 0])  # a later leaf has a smaller reference
    count = leaf_count.func(leaves)
    units = -(-count // unit)
    if (leaf_first.func(leaves) != np.cumsum(units) - units).any() or count.sum() != n_primitives:
        raise InputError("is damaged: a leaf leads to other primitives")
    if stack_need(children) > STACK_SIZE:
        raise InputError(f"is damaged: a traversal needs more than {STACK_SIZE} entries on its stack")


def links(children: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the node and the child of each link between inner nodes, for references (N, width)."""
    inner = np.flatnonzero(children > 0)
    return inner // children.shape[1], children.reshape(-1)[inner]


def stack_need(children: np.ndarray) -> int:
    """Return the largest number of entries on the traversal stack, for a tree of references (N, width)."""
    n, (parent, child) = len(children), links(children)
    count = (children != EMPTY) @ np.ones(children.shape[1], np.float32)  # in a sixth of the time of `sum`
    need = np.append(np.maximum(count - 1, 0).astype(np.int64), 0)  # of each node and its ancestors, after the loop
    above = np.full(n + 1, n)
    above[child] = parent
    while (above < n).any():
        need += need[above]
        above = above[above]
    return int(need.max())
