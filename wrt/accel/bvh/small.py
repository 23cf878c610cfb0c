"""Wide trees over few primitives, built in NumPy, because loading or compiling the builders' kernels would take longer.

Each step handles the subtrees of all trees at once: NumPy takes longer for a call than for a few boxes.
"""

from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from wrt.accel.bvh.tree import BvhOptions, half_areas
from wrt.accel.bvh.wide_tree import WideTree
from wrt.kernels.wide.references import EMPTY, leaf_reference

SMALL = 128  # primitives
BATCH = 1 << 14  # primitives that are handled at once, which bounds the memory
FEW = 1024  # boxes: splitting subtrees of different sizes together takes less time than a call for each size
MOST_AREA = 3e78  # of half_areas
Boxes = tuple[np.ndarray, np.ndarray]


class _Subtrees(NamedTuple):
    """Subtrees of binary trees: first the whole trees, then their halves, then the halves of these, down to single boxes.

    items: (N,) indices of boxes. A subtree has the boxes items[begin : begin + size]. area: half the area of the box around them. left:
    index of a subtree's first half, which the second half follows; -1 if it has fewer than two boxes. levels: end of each level.
    """

    items: np.ndarray
    begin: np.ndarray
    size: np.ndarray
    area: np.ndarray
    left: np.ndarray
    levels: list[int]


class _Choices(NamedTuple):
    """Best ways to represent each subtree by children of a wide node.

    is_leaf: whether its only child would be a leaf. children: (T, W) number of children, if there may be at most 1 .. W. first: (T, W + 1)
    number of these that come from the first half, by the number of children. opened: best number of children, two or more, of a node
    for the subtree; 1 if a leaf costs less than they.
    """

    is_leaf: np.ndarray
    children: np.ndarray
    first: np.ndarray
    opened: np.ndarray


def _areas(boxes: np.ndarray) -> np.ndarray:
    """Return half the area of boxes (2, 3, ...), low corners and negated high corners; a number for NaN, too."""
    low, high = np.moveaxis(boxes, 1, -1)
    return np.fmin(half_areas(low, -high), MOST_AREA)


def _ranges(begin: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices begin .. begin + count - 1 of all ranges, one after another, and the place of each in its range."""
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.repeat(begin, count) + place, place


def _split(boxes: np.ndarray, items: np.ndarray, begin: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sort the items of each subtree (S,) so that its first half comes first. Return the halves' counts and areas, (2, S).

    Split at the least SAH cost of a sweep along all axes. At equal cost, prefer parts of equal size. boxes: (2, 3, N), low corners, and
    negated high corners: the minimum of both is the box around all.
    """
    every, places = np.arange(len(count)), np.arange(count.max())[:, None]
    exists = places < count
    mine = items[begin + np.where(exists, places, 0)]  # (place, subtree)
    some = np.where(exists, boxes[:, :, mine], np.float32(np.inf))
    # The center is NaN, and comes last, if no box exists, and if a box is all of space.
    orders = (0.5 * some[0] - 0.5 * some[1]).argsort(axis=1, kind="stable")  # (axis, place, subtree)
    some = some[:, :, orders, every].transpose(3, 0, 1, 2, 4)  # (place, 2, 3, axis, subtree)
    # After the loop: the first 1, 2, .. and the last 1, 2, .. boxes along each axis.
    around = np.empty((len(some), 2, *some.shape[1:]), np.float32)
    around[:, 0], around[:, 1] = some, some[::-1]
    for i in range(1, len(around)):
        np.minimum(around[i], around[i - 1], out=around[i])
    areas, firsts = _areas(around.transpose(2, 3, 0, 1, 4, 5)), places[1:, None]
    below, above = areas[:-1, 0], areas[-2::-1, 1]  # (place, axis, subtree)
    cost = np.where(firsts < count, below * firsts + above * (count - firsts), np.inf)
    uneven = np.where((cost == cost.min(axis=(0, 1))) & (firsts < count), abs(2 * firsts - count), len(places))
    k, axis = np.divmod(uneven.reshape(-1, len(count)).argmin(axis=0), 3)
    items[(begin + places)[exists]] = mine[orders[axis, :, every].T, every][exists]
    return np.stack([k + 1, count - k - 1]), np.stack([below[k, axis, every], above[k, axis, every]])


def _subtrees(boxes: np.ndarray, begin: np.ndarray, count: np.ndarray) -> _Subtrees:
    """Build binary trees of single boxes by the surface area heuristic (MacDonald and Booth 1990).

    boxes: of all trees, as for _split. begin, count: the boxes of each tree.
    """
    items, area, some = np.arange(boxes.shape[2]), np.zeros(len(begin)), count > 0
    if some.any():
        area[some] = _areas(np.minimum.reduceat(boxes, begin[some], axis=2))
    parts, levels, lefts = [(begin, count, area)], [len(begin)], []
    while len(begin):
        inner = np.flatnonzero(count > 1)
        left = np.full(len(begin), -1)
        left[inner] = levels[-1] + 2 * np.arange(len(inner))
        lefts.append(left)
        begin, count = begin[inner], count[inner]
        counts, areas = np.empty((2, len(inner)), np.int64), np.empty((2, len(inner)))
        size = np.frexp(count - 1)[1] * (len(count) * count.max(initial=0) > FEW)  # subtrees of about equal size are split together
        for each in set(size.tolist()):
            some = size == each
            counts[:, some], areas[:, some] = _split(boxes, items, begin[some], count[some])
        begin, count = np.stack([begin, begin + counts[0]], axis=1).reshape(-1), counts.T.reshape(-1)
        parts.append((begin, count, areas.T.reshape(-1)))
        levels.append(levels[-1] + len(begin))
    begin, count, area = (np.concatenate(each) for each in zip(*parts, strict=True))
    return _Subtrees(items, begin, count, area, np.concatenate(lefts), levels[:-1])


def _choose(trees: _Subtrees, options: BvhOptions) -> _Choices:
    """Choose children of least SAH cost by dynamic programming, as kernels.build.wide does."""
    width, n = options.row, trees.size
    # Mean of two costs: a single ray tests a row of primitives at once; a packet of rays tests primitives one by one.
    leaf = options.cost_intersection * (0.5 * -(-n // width) + 0.5 * n / width) * trees.area
    leaf[n > options.max_leaf] = np.inf
    cost = np.repeat(np.append(leaf[:, None], np.full((len(n), 1), np.inf), axis=1), (width, 1), axis=1)
    children, first, opened = np.ones((len(n), width), int), np.zeros((len(n), width + 1), int), np.ones(len(n), int)
    ks, a = np.arange(2, width + 1)[:, None], np.arange(1, width)
    of_second = np.where(a < ks, ks - a - 1, width)  # the last cost is infinite
    for begin, end in reversed(list(zip([0, *trees.levels], trees.levels, strict=False))):
        at = begin + np.flatnonzero(trees.left[begin:end] >= 0)
        several = cost[trees.left[at]][:, None, :-2] + cost[trees.left[at] + 1][:, of_second]  # (subtree, k, a)
        first[at, 2:], several = 1 + several.argmin(axis=2), several.min(axis=2)
        least = several.min(axis=1)
        opened[at] = np.where((n[at] <= options.max_leaf) & (leaf[at] <= least), 1, 2 + several.argmin(axis=1))
        several = np.append(np.minimum(leaf[at], options.cost_traversal * trees.area[at] + least)[:, None], several, axis=1)
        cost[at, :-1] = best = np.minimum.accumulate(several, axis=1)
        better = several[:, 1:] < best[:, :-1]
        children[at, 1:] = np.maximum.accumulate(np.where(better, ks[:, 0], 1), axis=1)
    return _Choices((n == 1) | ((n <= options.max_leaf) & (leaf <= cost[:, 0])), children, first, opened)


def _roots(trees: _Subtrees, choices: _Choices, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the subtrees that become children of the nodes for the subtrees `nodes`, and the index of the node of each.

    Inner nodes come first, then leaves, by ascending area. Any-hit rays visit the last first.
    """
    parent = np.flatnonzero(trees.size[nodes] > 0)
    roots = nodes[parent]
    k = choices.opened[roots]
    while (k > 1).any():
        twice = np.repeat(np.arange(len(k)), np.where(k > 1, 2, 1))
        second = np.append(False, twice[1:] == twice[:-1])
        parent, roots, k = parent[twice], roots[twice], k[twice]
        split, firsts = k > 1, choices.first[roots, k]
        roots = np.where(split, trees.left[roots] + second, roots)
        k = np.where(split, choices.children[roots, np.where(second, k - firsts, firsts) - 1], 1)
    order = np.lexsort((trees.area[roots], choices.is_leaf[roots], parent))
    return roots[order], parent[order]


class _Nodes(NamedTuple):
    """Nodes of wide trees, tree after tree, each parent before its children; and all children, node after node.

    tree: (G,) the tree of each node. need: (G,) entries on a traversal's stack below the node. depth: of each tree. node: (C,) index of
    the node of each child. subtree: (C,) index in _Subtrees. below: (C,) index of the child's own node; of no meaning for leaves.
    """

    tree: np.ndarray
    need: np.ndarray
    depth: np.ndarray
    node: np.ndarray
    subtree: np.ndarray
    below: np.ndarray


def _nodes(trees: _Subtrees, choices: _Choices, n_trees: int) -> _Nodes:
    """Make the nodes of all trees, level by level."""
    roots, tree, need = np.arange(n_trees), np.arange(n_trees), np.zeros(n_trees, int)
    depth, nodes, children, total = np.zeros(n_trees, int), [], [], 0
    while len(roots):
        subtree, parent = _roots(trees, choices, roots)
        need = need + np.maximum(np.bincount(parent, minlength=len(roots)) - 1, 0)
        depth[tree] += 1
        nodes.append((tree, need))
        children.append((parent + total, subtree))
        total += len(roots)
        inner = ~choices.is_leaf[subtree]
        roots, tree, need = subtree[inner], tree[parent[inner]], need[parent[inner]]
    (tree, need), (node, subtree) = ([np.concatenate(each) for each in zip(*parts, strict=True)] for parts in (nodes, children))
    inner, order, place = ~choices.is_leaf[subtree], np.argsort(tree, kind="stable"), np.empty(total, int)
    place[order] = np.arange(total)
    below = np.full(len(node), -1)
    below[inner] = place[n_trees:]  # after the roots, nodes are made in the order of the inner children
    by_node = np.argsort(place[node], kind="stable")
    return _Nodes(tree[order], need[order], depth, place[node][by_node], subtree[by_node], below[by_node])


def small_trees(boxes: list[Boxes], options: BvhOptions) -> list[WideTree]:
    """Build a wide tree over each pair of boxes lo, hi (n, 3) float32, with up to options.row children per node."""
    ends = np.cumsum([len(low) for low, _ in boxes])
    batches = groupby(zip(ends // BATCH, boxes, strict=True), key=itemgetter(0))
    return [tree for _, batch in batches for tree in _small_trees([each for _, each in batch], options)]


def _small_trees(boxes: list[Boxes], options: BvhOptions) -> list[WideTree]:
    width, n_trees = options.row, len(boxes)
    bounds = np.stack([np.concatenate([low for low, _ in boxes]).T, -np.concatenate([high for _, high in boxes]).T])
    n_boxes = np.array([len(low) for low, _ in boxes])
    first_box = np.cumsum(n_boxes) - n_boxes
    with np.errstate(over="ignore", invalid="ignore"):
        trees = _subtrees(bounds, first_box, n_boxes)
        choices = _choose(trees, options)
    nodes = _nodes(trees, choices, n_trees)
    tree, is_leaf, begin, count = nodes.tree[nodes.node], *(each[nodes.subtree] for each in (choices.is_leaf, trees.begin, trees.size))
    n_nodes, n_leaves = np.bincount(nodes.tree, minlength=n_trees), np.bincount(tree[is_leaf], minlength=n_trees)
    rows = np.where(is_leaf, -(-count // width), 0)
    end_row, end_node = np.cumsum(np.bincount(tree, rows, n_trees).astype(int)), np.cumsum(n_nodes)
    row = np.cumsum(rows) - rows
    siblings = np.bincount(nodes.node, minlength=end_node[-1])
    place = width - siblings[nodes.node] + _ranges(siblings, siblings)[1]
    references = np.full((end_node[-1], width), EMPTY, np.int32)
    references[nodes.node, place] = np.where(is_leaf, leaf_reference.func(row - np.append(0, end_row)[tree], count),
                                             nodes.below - np.append(0, end_node)[tree])
    around = np.full((2, 3, *references.shape), np.inf, np.float32)
    lanes = np.full((end_row[-1], width), -1, np.int32)
    if len(count):
        items = trees.items[_ranges(begin, count)[0]]
        around[..., nodes.node, place] = np.minimum.reduceat(bounds[..., items], np.cumsum(count) - count, axis=2)
        leaf, (_, within) = np.repeat(np.arange(len(count)), count), _ranges(begin, count)
        items = (items - first_box[tree[leaf]])[np.lexsort((items, leaf))]
        there = is_leaf[leaf]
        lanes[(row[leaf] + within // width)[there], (within % width)[there]] = items[there]
    low, high = np.moveaxis(around, 1, -1)
    stack = np.maximum.reduceat(nodes.need, end_node - n_nodes)
    return [WideTree(low[a:b], -high[a:b], references[a:b], lanes[c:d], *numbers) for a, b, c, d, *numbers in zip(
        (end_node - n_nodes).tolist(), end_node.tolist(), [0, *end_row.tolist()], end_row.tolist(), n_leaves.tolist(),
        nodes.depth.tolist(), stack.tolist(), strict=False)]


def small_tree(lo: np.ndarray, hi: np.ndarray, options: BvhOptions) -> WideTree:
    """Call `small_trees` for a single tree."""
    return small_trees([(lo, hi)], options)[0]
