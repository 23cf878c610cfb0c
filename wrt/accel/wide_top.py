"""Upper level of instances in nodes with eight children, for the traversal of many rays (kernels.wide.instances)."""

from dataclasses import dataclass

import numpy as np

from wrt.accel.bvh.tree import half_areas
from wrt.core.device import empty_aligned
from wrt.kernels.wide.layout import PLANES, WIDTH, first_reference, node_size
from wrt.kernels.wide.references import EMPTY, leaf_reference

NONE = -1


@dataclass(frozen=True, eq=False)
class WideTop:
    """Topology of the wide trees over a list of binary trees, without boxes."""

    children: np.ndarray  # (N, 8) int32 references; a leaf is one placement.
    source: np.ndarray  # (N, 8), box of each child as 2 * binary node + side, or -1.
    roots: np.ndarray  # (W,) int32, root of each tree.

    def nodes(self, binary: np.ndarray) -> np.ndarray:
        """Return the nodes in the layout of kernels.wide.nodes, with the boxes of the binary nodes (Bvh2Node records).

        The row behind the references begins with the low and the high corner of the box around all children (instances.h: widening).
        """
        first = first_reference(WIDTH, False)
        out = empty_aligned((len(self.children), node_size(WIDTH, False)), np.float32)
        out[:, first + WIDTH + 6 :] = 0.0
        out[:, first : first + WIDTH] = self.children.view(np.float32)
        planes, exists = out[:, :first].reshape(-1, len(PLANES), WIDTH), (self.children != EMPTY)[:, None]
        for end, (name, empty, around) in enumerate((("lo", np.inf, np.min), ("hi", -np.inf, np.max))):
            planes[:, end::2] = np.where(exists, sides(binary, name)[self.source].transpose(0, 2, 1), empty)
            out[:, first + WIDTH + 3 * end :][:, :3] = np.where(exists.any(axis=2), around(planes[:, end::2], axis=2), 0.0)
        return out.reshape(-1)


def sides(binary: np.ndarray, name: str) -> np.ndarray:
    """Return a field of both children of all binary nodes, in the order 2 * node + side."""
    return np.stack([binary[name + "_0"], binary[name + "_1"]], axis=1).reshape(2 * len(binary), *binary[name + "_0"].shape[1:])


def widen(binary: np.ndarray, roots: np.ndarray) -> WideTop:
    """Make wide trees: a node takes the place of its largest child, by area, until it has eight children or only leaves."""
    low, high, first, count = (sides(binary, name) for name in ("lo", "hi", "first", "count"))
    exists, area = np.asarray((low <= high).all(axis=1)), half_areas(low, high)
    level, references, sources, made = roots.astype(np.int64), [], [], 0
    while len(level):
        code = np.full((len(level), WIDTH), NONE)
        code[:, 0], code[:, 1] = 2 * level, 2 * level + 1
        for slot in range(2, WIDTH):
            inner = (code != NONE) & (count[code] == 0) & exists[code]
            largest = np.where(inner, area[code], -1.0).argmax(axis=1)
            row = np.flatnonzero(inner[np.arange(len(code)), largest])
            child = first[code[row, largest[row]]]
            code[row, largest[row]], code[row, slot] = 2 * child, 2 * child + 1
        code[~exists[code]] = NONE
        leaf, inner = (code != NONE) & (count[code] > 0), (code != NONE) & (count[code] == 0)
        made += len(level)
        children = np.full(code.shape, EMPTY, np.int64)
        children[leaf] = leaf_reference.func(first[code[leaf]].astype(np.int64), 1)
        children[inner] = made + np.arange(inner.sum())
        references.append(children)
        sources.append(code)
        level = first[code[inner]].astype(np.int64)
    return WideTop(np.concatenate(references).astype(np.int32), np.concatenate(sources), np.arange(len(roots), dtype=np.int32))
