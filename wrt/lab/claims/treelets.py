"""Cut a tree into treelets, and schedule rays by treelets: Aila and Karras 2010, "Architecture Considerations for Tracing Incoherent
Rays"."""

import heapq
from typing import NamedTuple

import numpy as np

from wrt.accel.bvh.wide_tree import WideTree, leaf_rows
from wrt.lab.claims.walks import NODE_BYTES, Walk
from wrt.lab.rtcore.caches import LINE


def cut(tree: WideTree, size: int) -> np.ndarray:
    """Return the treelet of each inner node and of each leaf, (nodes + rows,) int64; leaf row r has the index nodes + r.

    A treelet begins at its root and takes the waiting child of largest box area while it holds at most `size` bytes. The children that
    still wait are the roots of other treelets."""
    n, areas = len(tree.children), tree.areas.tolist()
    children = np.where(tree.children < 0, n + leaf_rows(tree.children), tree.children).tolist()
    treelet, roots, number = np.full(n + len(tree.order), -1, np.int64), [0], 0
    while roots:
        waiting, used = [(0.0, roots.pop())], 0
        while waiting and used + NODE_BYTES <= size:
            _, item = heapq.heappop(waiting)
            treelet[item] = number
            used += NODE_BYTES
            if item < n:
                for child, area in zip(children[item], areas[item], strict=True):
                    if child:
                        heapq.heappush(waiting, (-area, child))
        roots += [item for _, item in waiting]
        number += 1
    return treelet


class Scheduled(NamedTuple):
    """Memory traffic of `schedule`. lines: cache lines of nodes and leaves that are loaded; moves: times that a ray enters a queue."""

    lines: int
    moves: int


def schedule(log: Walk, treelet: np.ndarray) -> Scheduled:
    """Trace rays treelet by treelet: load the treelet with most waiting rays, and let each of its rays go on until it leaves the treelet.
    Every ray makes the fetches of the log in the log's order. While a treelet is loaded, each of its lines is loaded at most once."""
    item = log.address // NODE_BYTES
    line, of = log.address // LINE, treelet[item]
    first = log.first[:-1][np.diff(log.first) > 0]
    starts = np.union1d(first, np.flatnonzero(np.concatenate([[True], of[1:] != of[:-1]])))  # first fetch of each stay in a treelet
    ends = np.append(starts[1:], len(of))
    more = np.append(~np.isin(starts[1:], first), False)  # whether the same ray has another stay
    queues: dict[int, list[np.ndarray]] = {}
    sizes = np.zeros(int(treelet.max()) + 1, np.int64)
    lines = moves = 0

    def enter(stays: np.ndarray) -> None:
        order = np.argsort(of[starts[stays]], kind="stable")
        where = of[starts[stays]][order]
        for part in np.split(stays[order], np.flatnonzero(np.diff(where)) + 1):
            if len(part):
                queues.setdefault(int(of[starts[part[0]]]), []).append(part)
                sizes[of[starts[part[0]]]] += len(part)

    enter(np.searchsorted(starts, first))
    while sizes.any():
        number = int(sizes.argmax())
        stays = np.concatenate(queues.pop(number))
        sizes[number] = 0
        moves += len(stays)
        length = ends[stays] - starts[stays]
        at = np.repeat(starts[stays] - (np.cumsum(length) - length), length) + np.arange(int(length.sum()))
        lines += len(np.unique(line[at]))
        enter(stays[more[stays]] + 1)
    return Scheduled(lines, moves)
