"""Wide trees over few primitives, built in Python, because loading or compiling the builders' kernels would take longer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wrt.accel.bvh.tree import BvhOptions, half_areas
from wrt.accel.bvh.wide_tree import WideTree, lanes_of, stack_need
from wrt.kernels.wide.references import EMPTY, leaf_reference

SMALL = 128  # primitives


class _Choice(NamedTuple):
    """Cheapest set of children, up to some number, by which a wide node represents a subtree.

    cost: SAH cost of the children. children: number of children. first: number of children that come from the subtree's parts[0];
    0: the subtree itself is the only child.
    """

    cost: float
    children: int
    first: int


class _Subtree:
    """Subtree of a binary tree: primitives `items` (n,), their boxes lo, hi (n, 3), and half the area of the box around them.

    Function `split` fills parts: two halves, or none for a single primitive. Method `choose` sets choices[k], the best choice of at most
    k + 1 children, and opened, the best choice of two or more children.
    """

    choices: list[_Choice]
    opened: _Choice

    def __init__(self, items: np.ndarray, lo: np.ndarray, hi: np.ndarray, area: float, options: BvhOptions) -> None:
        self.items, self.lo, self.hi, self.area, self.options = items, lo, hi, area, options
        self.parts: list[_Subtree] = []
        # Mean of two costs: a single ray tests a row of primitives at once; a packet of rays tests primitives one by one.
        rows = 0.5 * -(-len(items) // options.row) + 0.5 * len(items) / options.row
        self.leaf_cost = options.cost_intersection * rows * area if len(items) <= options.max_leaf else np.inf

    def choose(self) -> None:
        """Set `choices` and `opened` by dynamic programming, as kernels.build.wide does. Call it for the parts first."""
        self.choices = [_Choice(self.leaf_cost, 1, 0)]
        self.opened = _Choice(np.inf, 0, 0)
        if self.parts:
            first, second = ([choice.cost for choice in part.choices] for part in self.parts)
            several = []
            for k in range(2, min(self.options.row, len(self.items)) + 1):
                costs = [first[a - 1] + second[k - a - 1] for a in range(1, k)]
                cost = min(costs)
                several.append(_Choice(cost, k, 1 + costs.index(cost)))
            self.opened = min(several)
            self.choices = [min(self.choices[0], _Choice(self.options.cost_traversal * self.area + self.opened.cost, 1, 0))]
            for choice in several:
                self.choices.append(min(self.choices[-1], choice))
        self.choices += self.choices[-1:] * (self.options.row - len(self.choices))

    def _is_leaf_beside(self, cost: float) -> bool:
        """Return whether a leaf is best: always for one primitive, else if max_leaf allows it and it costs at most `cost`, maybe inf."""
        return len(self.items) == 1 or (len(self.items) <= self.options.max_leaf and self.leaf_cost <= cost)

    @property
    def is_leaf(self) -> bool:
        return self._is_leaf_beside(self.choices[0].cost)

    def roots(self, choice: _Choice) -> list[_Subtree]:
        if choice.first == 0:
            return [self]
        first, second = self.parts
        return first.roots(first.choices[choice.first - 1]) + second.roots(second.choices[choice.children - choice.first - 1])

    def children(self) -> list[_Subtree]:
        """Return the children of this subtree's node: inner nodes, then leaves, by ascending area. Any-hit rays visit the last first."""
        if self._is_leaf_beside(self.opened.cost):
            return [self]
        return sorted(self.roots(self.opened), key=lambda child: (child.is_leaf, child.area))


def split(subtrees: list[_Subtree]) -> None:
    """Append two halves to `parts` of subtrees with equally many primitives, unless each has only one.

    Split at the least SAH cost of a sweep along all axes. At equal cost, prefer parts of equal size.
    """
    n = len(subtrees[0].items)
    if n == 1:
        return
    items, los, his = (np.stack([getattr(subtree, name) for subtree in subtrees]) for name in ("items", "lo", "hi"))
    with np.errstate(invalid="ignore"):  # a box may be all of space
        orders = (0.5 * los + 0.5 * his).argsort(axis=1, kind="stable")  # (subtree, n, axis)
    lo, hi = (np.take_along_axis(box[:, :, None], orders[..., None], axis=1) for box in (los, his))  # (subtree, n, axis, 3)
    # Areas around the first 1, 2, .. and around the last 1, 2, .. items along each axis.
    below, above = half_areas(np.minimum.accumulate(np.stack([lo, lo[:, ::-1]]), axis=2),
                              np.maximum.accumulate(np.stack([hi, hi[:, ::-1]]), axis=2))
    below, above = below[:, :-1], above[:, -2::-1]
    count = np.arange(1, n)[:, None]
    cost = below * count + above * (n - count)
    places = np.where(cost == cost.min(axis=(1, 2), keepdims=True), abs(2 * count - n), n).reshape(len(cost), -1).argmin(axis=1)
    every, (ks, axes) = np.arange(len(subtrees)), np.divmod(places, 3)
    items, lo, hi = np.take_along_axis(items, orders[every, :, axes], axis=1), lo[every, :, axes], hi[every, :, axes]
    areas = zip(below[every, ks, axes].tolist(), above[every, ks, axes].tolist(), strict=True)
    for i, (subtree, k, (first, second)) in enumerate(zip(subtrees, (ks + 1).tolist(), areas, strict=True)):
        subtree.parts.append(_Subtree(items[i, :k], lo[i, :k], hi[i, :k], first, subtree.options))
        subtree.parts.append(_Subtree(items[i, k:], lo[i, k:], hi[i, k:], second, subtree.options))


def small_trees(boxes: list[tuple[np.ndarray, np.ndarray]], options: BvhOptions) -> list[WideTree]:
    """Build a wide tree over each pair of boxes lo, hi (n, 3) float32, with up to options.row children per node.

    Build a binary tree of single boxes by the surface area heuristic (MacDonald and Booth 1990), and collapse it at the least cost.
    Subtrees of all trees are split together, because NumPy takes longer for a call than for a few boxes.
    """
    roots = [_Subtree(np.arange(len(lo), dtype=np.int32), lo, hi, float(half_areas(lo.min(axis=0), hi.max(axis=0))), options)
             if len(lo) else None for lo, hi in boxes]
    subtrees = level = [root for root in roots if root]
    while level:
        groups: dict[int, list[_Subtree]] = {}
        for subtree in level:
            groups.setdefault(len(subtree.items), []).append(subtree)
        for group in groups.values():
            split(group)
        level = [part for subtree in level for part in subtree.parts]
        subtrees = subtrees + level
    for subtree in reversed(subtrees):
        subtree.choose()
    return [wide_tree(root, options.row) for root in roots]


def small_tree(lo: np.ndarray, hi: np.ndarray, options: BvhOptions) -> WideTree:
    """Call `small_trees` for a single tree."""
    return small_trees([(lo, hi)], options)[0]


def wide_tree(root: _Subtree | None, width: int) -> WideTree:
    """Return the wide tree of a root that `choose` was called for; None: over no primitives."""
    nodes, children_of = [root] if root else [], []
    for node in nodes:  # the loop appends to the list
        children_of.append(node.children())
        nodes += [child for child in children_of[-1] if not child.is_leaf]
    shape = (max(len(nodes), 1), width)
    low, high = np.full((*shape, 3), np.inf, np.float32), np.full((*shape, 3), -np.inf, np.float32)
    references, depth, rows = np.full(shape, EMPTY, np.int32), [1], 0
    order: list[int] = []
    for i, children in enumerate(children_of):
        for place, child in enumerate(children, width - len(children)):
            low[i, place], high[i, place] = child.lo.min(axis=0), child.hi.max(axis=0)
            if child.is_leaf:
                references[i, place] = leaf_reference.func(rows, len(child.items))
                order += sorted(child.items.tolist())
                rows += -(-len(child.items) // width)
            else:
                references[i, place] = len(depth)
                depth.append(depth[i] + 1)
    lanes, leaves = lanes_of(references, np.array(order, np.int32), width), int((references < 0).sum())
    return WideTree(low, high, references, lanes, leaves, depth[-1], stack_need(references))
