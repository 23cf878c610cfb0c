"""Upper level of instances: a binary tree for each world, all in one array of nodes. For the traversal of many rays
(kernels.wide.instances) the same trees have nodes with eight children."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from wrt.accel.bvh.builders import BvhOptions, half_areas
from wrt.accel.geometry import Geometry, InstancedGeometry, inverse_of, spread_of
from wrt.core.device import empty_aligned, on_host, records, start, upload
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.kernels.traverse.instances import Placement
from wrt.kernels.units.box import PAD_COORDINATE
from wrt.kernels.wide.layout import PLANES, WIDTH, first_reference, node_size
from wrt.kernels.wide.references import EMPTY, leaf_reference

ROUNDOFF = 2.0**-24
SLACK = 32.0 * ROUNDOFF  # See kernels.traverse.instances.enter.
BOXES = 1 << 22  # primitives' boxes to transform in a build, summed over all instances.
MOVED_BOXES = 1 << 18  # As BOXES, but in a move: fewer boxes take less time, and make the boxes of instances slightly larger.
MATRICES = 1 << 17  # Boxes to transform at a time.

Boxes = tuple[np.ndarray, np.ndarray]  # centers and halves, (G, 3) float64 each


@dataclass(frozen=True, eq=False)
class TopLevel:
    """Trees over instances."""

    nodes: np.ndarray  # (N,) Bvh2Node records, one tree per world, each with its root first.
    roots: np.ndarray  # (W,) indices of the roots.
    parents: np.ndarray  # (N,) int32, -1 for a root.
    order: np.ndarray  # (I,) int32, instance of each leaf.
    depth: int  # Depth of the deepest tree.
    low: np.ndarray  # (I, 3) float32, low corners of the instances' boxes.
    high: np.ndarray  # (I, 3) float32, high corners.
    spread: np.ndarray  # (I,), see `spread_of`.
    placements: np.ndarray  # (I,) Placement records in the order of the leaves.

    @property
    def slack(self) -> float:
        """Widening of boxes, as a fraction of the ray's distance (kernels.traverse.instances.enter)."""
        return float(np.float32(SLACK * self.spread.max(initial=1.0)))

    @property
    def cost(self) -> float:
        """Sum of the surface areas of all boxes, each divided by the area of its tree's root."""
        areas = np.stack([half_areas(self.nodes["lo_" + side], self.nodes["hi_" + side]) for side in "01"])
        of_root = [end(self.nodes[name + "_0"], self.nodes[name + "_1"])[self.roots]
                   for name, end in (("lo", np.minimum), ("hi", np.maximum))]
        whole = np.repeat(half_areas(*of_root), np.diff([*self.roots, len(self.nodes)]))
        return float((areas.sum(axis=0)[whole > 0.0] / whole[whole > 0.0]).sum())


def build_top(geometry: InstancedGeometry, low: np.ndarray, high: np.ndarray) -> TopLevel:
    """Build the trees over the boxes of all instances."""
    from wrt.accel.bvh.top_down import build_forest  # builders are imported when they are needed: most scenes have no instances
    from wrt.kernels.build.fit import NO_PARENT

    forest, roots = build_forest("binned", low, high, geometry.first_instance, BvhOptions(max_leaf=1))
    nodes, order = forest.nodes, forest.order
    parents = np.full(len(nodes), NO_PARENT, np.int32)
    for side in "01":
        inner = np.flatnonzero((nodes["count_" + side] == 0) & (nodes["first_" + side] > 0))
        parents[nodes["first_" + side][inner]] = inner
    rows = np.arange(len(order))
    top = TopLevel(nodes, roots, parents, order, forest.depth, low, high, np.empty(len(order)), records(Placement, len(order)))
    return write_placements(top, geometry, rows)


def write_placements(top: TopLevel, geometry: InstancedGeometry, rows: np.ndarray) -> TopLevel:
    """Return `top` with the placements and spreads of the instances `rows` computed anew from `geometry`."""
    place = np.empty(len(top.order), np.int64)
    place[top.order] = np.arange(len(top.order))
    placements, spread = top.placements.copy(), top.spread.copy()
    to_local = inverse_of(geometry.to_world[rows])
    spread[rows] = spread_of(geometry.to_world[rows], to_local)
    out = placements[place[rows]]
    out["bottom"], out["first_prim"] = geometry.part[rows], geometry.first_prim_in_world[rows]
    out["local_x"], out["local_y"], out["local_z"] = to_local[:, 0], to_local[:, 1], to_local[:, 2]
    placements[place[rows]] = out
    return replace(top, placements=placements, spread=spread)


def refit_top(top: TopLevel, geometry: InstancedGeometry, rows: np.ndarray, low: np.ndarray, high: np.ndarray) -> TopLevel:
    """Return the trees refitted to instances that moved; the topology stays.

    geometry: already has the new matrices. rows: (R,) indices of the moved instances, without repeats. low, high: (R, 3) float32, the
    new boxes of these instances in world space.
    """
    from wrt.accel.bvh.refit import Fitting, tree_of

    cpu, fitting = start("cpu"), Fitting(start("cpu"), len(top.order), len(top.nodes))
    all_low, all_high = top.low.copy(), top.high.copy()
    all_low[rows], all_high[rows] = low, high
    fitting.low, fitting.high = upload(all_low, wp.vec3, cpu), upload(all_high, wp.vec3, cpu)
    tree = tree_of(fitting, upload(top.nodes.copy(), Bvh2Node, cpu), upload(top.parents, wp.int32, cpu),
                   upload(top.order, wp.int32, cpu))
    fitting.fit(tree)
    return write_placements(replace(top, nodes=on_host(tree.nodes), low=all_low, high=all_high), geometry, rows)


def world_boxes(geometry: InstancedGeometry, rows: np.ndarray, boxes: list[Boxes]) -> tuple[np.ndarray, np.ndarray]:
    """Return a box of each instance in `rows` around the transformed boxes of its primitives: low and high (R, 3) float32.

    A box around the transformed mesh is not enough: a hit may lie anywhere in its primitive's padded box, which extends beyond the mesh.
    boxes: from `part_boxes`.
    """
    lo, hi = np.full((len(rows), 3), np.inf, np.float32), np.full((len(rows), 3), -np.inf, np.float32)
    for index, (center, half) in enumerate(boxes):
        chosen = np.flatnonzero(geometry.part[rows] == index) if len(center) else np.zeros(0, np.int64)
        step = max(MATRICES // max(len(center), 1), 1)
        for some in (chosen[first : first + step] for first in range(0, len(chosen), step)):
            linear, offset = geometry.to_world[rows[some], :, :3].transpose(0, 2, 1), geometry.to_world[rows[some], None, :, 3]
            middle, reach = center @ linear + offset, half @ np.abs(linear)
            lo[some], hi[some] = rounded_out((middle - reach).min(axis=1), (middle + reach).max(axis=1))
    return lo, hi


def part_boxes(geometry: InstancedGeometry, orders: list[np.ndarray], most: int) -> list[Boxes]:
    """Return boxes around groups of each part's primitives: about `most` boxes over all instances, at least 8 per part.

    orders: prim_ids of each part, in an order that puts near primitives next to each other.
    """
    groups = max(most // max(len(geometry.part), 1), 8)
    corners = [grouped_boxes(part, order, groups) for part, order in zip(geometry.parts, orders, strict=True)]
    return [(0.5 * (low + high), 0.5 * (high - low)) for low, high in corners]


def grouped_boxes(geometry: Geometry, order: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Return about `groups` boxes that contain the boxes of all primitives: low and high (G, 3) float64. order: see `part_boxes`."""
    low, high = (corner.astype(np.float64) for corner in geometry.bounds())
    if len(low) <= groups:
        return low, high
    first = np.arange(0, len(order), -(-len(order) // groups))
    return np.minimum.reduceat(low[order], first), np.maximum.reduceat(high[order], first)


def rounded_out(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Round corners of boxes outwards to float32, with a margin for the rounding of a ray origin's coordinates."""
    pad = 2.0 * PAD_COORDINATE * np.maximum(np.abs(low), np.abs(high))
    return np.nextafter((low - pad).astype(np.float32), np.float32(-np.inf)), \
        np.nextafter((high + pad).astype(np.float32), np.float32(np.inf))


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
