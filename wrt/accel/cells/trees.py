"""Trees whose nodes divide space by planes: k-d tree, octree, BSP tree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.cells.common import MAX_REFERENCES, bounds_of, build_tree, check_references, shapes_of
from wrt.accel.snapshot import Built
from wrt.accel.store import check_ranges, check_tree
from wrt.accel.structures import require_between
from wrt.core.device import records
from wrt.core.errors import InputError
from wrt.core.types import WarpStruct
from wrt.kernels.build.cells import Cell, CellOptions
from wrt.kernels.traverse import plane_layouts as layouts
from wrt.kernels.traverse import planes as kernels
from wrt.kernels.units.box import PAD_EXTENT, half_area

MAX_IN_LEAF = 1 << 24  # primitives, because a node stores their number as a float32.
MAX_INDEX = 1 << 29  # Of a node or reference, because a node's word has 29 bits for it.
MAX_BSP_DEPTH = 60
SAMPLED = 256  # In cells of a BSP tree with more primitives, so many of them propose planes across an axis.
KD_SAMPLED = 1024  # Likewise in a k-d tree.


@dataclass(frozen=True)
class KdOptions:
    """Options of the k-d tree. Raises InputError for values out of range."""

    max_leaf: int = 1  # Cells of so many primitives or fewer are not split.
    max_depth: int | None = None  # Levels below the root; None: 8 + 1.3 log2 n.
    cost_traversal: float = 2.0  # SAH cost of a node.
    cost_intersection: float = 1.0  # SAH cost of a primitive.
    empty_bonus: float = 0.1  # Discount, 0 to 1, for splits that cut off empty space.
    clip: bool = True  # Clip triangles to cells exactly.
    max_growth: float = 16.0  # Limit of references and empty leaves per primitive.

    def __post_init__(self) -> None:
        require_between(max_leaf=(self.max_leaf, 1, MAX_IN_LEAF), max_depth=(self.max_depth or 0, 0, kernels.STACK_SIZE),
                        cost_traversal=(self.cost_traversal, 0.0, 1e6), cost_intersection=(self.cost_intersection, 0.0, 1e6),
                        empty_bonus=(self.empty_bonus, 0.0, 1.0), max_growth=(self.max_growth, 1.0, 1e4))

    def depth(self, n: int) -> int:
        """Return max_depth; None: 8 + 1.3 log2 n for n primitives (Havran 2000; Pharr et al., "Physically Based Rendering", 4.4)."""
        if self.max_depth is not None:
            return self.max_depth
        return min(round(8.0 + 1.3 * np.log2(max(n, 1))), kernels.STACK_SIZE)


class KdTree(OneMesh):
    """A k-d tree: planes across an axis split space. Options: KdOptions. The option `box` has no effect."""

    name = "kdtree"
    kernels = kernels.KDTREE
    options = KdOptions

    def _build(self, options: KdOptions) -> Built:
        bounds, n = bounds_of(self.geometry), len(self.geometry)
        chosen = CellOptions()
        chosen.max_leaf, chosen.max_depth = options.max_leaf, options.depth(n)
        chosen.cost_node, chosen.cost_intersection = options.cost_traversal, options.cost_intersection
        chosen.empty_bonus, chosen.sampled = options.empty_bonus, KD_SAMPLED
        tree = build_tree("kdtree", shapes_of(self.geometry, bounds, options.clip), root_of(bounds, options.max_growth, 64), chosen,
                          self.threads)
        if max(len(tree.nodes), len(tree.order)) >= MAX_INDEX or tree.nodes["count"].max() > MAX_IN_LEAF:
            raise InputError(f"a k-d tree of {len(tree.order)} references is too large", hint="lower max_growth or max_depth")
        leaf, nodes = tree.nodes["axis"] == layouts.LEAF, records(layouts.KdNode, len(tree.nodes))
        nodes["split"] = np.where(leaf, tree.nodes["count"], -tree.nodes["offset"])
        nodes["word"] = 4 * tree.nodes["first"] + np.where(leaf, layouts.KD_LEAF, tree.nodes["axis"])
        return tree.built(box_arrays(bounds) | {"nodes": nodes})

    def _check(self, built: Built) -> None:
        nodes = built.arrays["nodes"]
        leaf, first = (nodes["word"] & 3) == layouts.KD_LEAF, (nodes["word"] >> 2).astype(np.int64)
        check_children(first[~leaf], np.full(int((~leaf).sum()), 3), np.flatnonzero(~leaf), len(nodes), kernels.STACK_SIZE)
        check_ranges(first[leaf], nodes["split"][leaf], len(built.order))


@dataclass(frozen=True)
class BspOptions:
    """Options of the BSP tree. Raises InputError for values out of range."""

    cost_intersection: float = 1.0  # SAH cost of a primitive.
    samples: int = 2  # Triangles per cell, evenly spread over its list, that propose four planes each; 0: a k-d tree.
    max_depth: int = 0  # From 1 to 60; 0: 16 + 2 log2 of the number of primitives.
    max_growth: float = 16.0  # Limit of references per primitive, 1 to 1000.
    max_triangles: int = 500_000  # Largest number of primitives.

    def __post_init__(self) -> None:
        require_between(cost_intersection=(self.cost_intersection, 1e-6, 1e6), samples=(self.samples, 0, 1 << 30),
                        max_depth=(self.max_depth, 0, MAX_BSP_DEPTH), max_growth=(self.max_growth, 1.0, 1000.0))


class Bsp(OneMesh):
    """A BSP tree, whose planes have any orientation. Options: BspOptions. The option `box` has no effect.

    Ize, Wald and Parker 2008, "Ray Tracing with the BSP Tree". Only the planes of some triangles of a cell are tried. The SAH takes the
    surface areas of parts of boxes, so that AccelStats.sah_cost is an estimate.
    """

    name = "bsp"
    kernels = kernels.BSP
    options = BspOptions

    def _build(self, options: BspOptions) -> Built:
        n = len(self.geometry)
        if n > options.max_triangles:
            raise InputError(f"bsp is slow to build, so that max_triangles={options.max_triangles} is the limit; there are {n}",
                             argument="max_triangles", hint="use another structure (kdtree, bvh), or raise max_triangles")
        bounds, chosen = bounds_of(self.geometry), CellOptions()
        chosen.cost_intersection, chosen.cost_node = options.cost_intersection, 1.0
        chosen.sampled, chosen.triangles = SAMPLED, options.samples
        chosen.max_depth = options.max_depth or min(MAX_BSP_DEPTH, 16 + 2 * math.ceil(math.log2(max(n, 1))))
        tree = build_tree("bsp", shapes_of(self.geometry, bounds), root_of(bounds, options.max_growth), chosen, self.threads)
        return tree.built(box_arrays(bounds) | {"nodes": tree.nodes})

    def _check(self, built: Built) -> None:
        nodes = built.arrays["nodes"]
        leaf = nodes["axis"] == layouts.LEAF
        if ((nodes["axis"] < 0) | (nodes["axis"] > layouts.LEAF) | ~leaf & (nodes["count"] < 1) | ~leaf & (nodes["count"] > 3)).any():
            raise InputError("is damaged: a node's axis or count is out of range")
        check_children(nodes["first"][~leaf], nodes["count"][~leaf], np.flatnonzero(~leaf), len(nodes), kernels.STACK_SIZE)
        check_ranges(nodes["first"][leaf], nodes["count"][leaf], len(built.order))


@dataclass(frozen=True)
class OctreeOptions:
    """Options of the octree. Raises InputError for values out of range."""

    max_leaf: int = 8  # Cells of so many primitives or fewer are not split.
    max_depth: int = layouts.MAX_LEVELS  # Levels below the root, 0 to MAX_LEVELS.
    by_cost: bool = True  # Do not split a cell whose octants cost a ray as much as the cell.
    max_growth: float = 16.0  # Limit of references per primitive in every part of the tree.
    mailbox: bool = True  # Avoid testing a ray against the same primitive in several cells.

    def __post_init__(self) -> None:
        require_between(max_leaf=(self.max_leaf, 1, 1 << 20), max_depth=(self.max_depth, 0, layouts.MAX_LEVELS),
                        max_growth=(self.max_growth, 1.0, 1e4))


class Octree(OneMesh):
    """An octree: a cell with many primitives is split into eight octants. An empty octant takes no memory. Options: OctreeOptions.

    Every cell that overlaps a sphere's box lists the sphere. The option `box` has no effect.
    """

    name = "octree"
    kernels = kernels.OCTREE
    options = OctreeOptions

    def _build(self, options: OctreeOptions) -> Built:
        bounds, n = bounds_of(self.geometry), len(self.geometry)
        layout, chosen = octree_layout(*bounds, options.max_depth), CellOptions()
        chosen.max_leaf, chosen.max_depth, chosen.by_cost = options.max_leaf, layout.levels, options.by_cost
        chosen.layout, chosen.leaf_visit = layout, 1
        tree = build_tree("octree", shapes_of(self.geometry, bounds), root_of(bounds, options.max_growth), chosen, self.threads)
        nodes = records(layouts.OctreeNode, len(tree.nodes))
        nodes["first"] = tree.nodes["first"]
        nodes["count"] = np.where(tree.nodes["axis"] == layouts.LEAF, 1, -1) * tree.nodes["count"]
        arrays = {"size": np.array(layout.size, np.float32), "levels": np.array(layout.levels, np.int32), "nodes": nodes,
                  "mailbox": np.array(options.mailbox, np.int32), "references": tree.order}
        return tree.built(box_arrays(bounds) | arrays, np.arange(n, dtype=np.int32))

    def _check(self, built: Built) -> None:
        arrays = built.arrays
        levels, lo, hi, nodes = int(arrays["levels"]), arrays["lo"], arrays["hi"], arrays["nodes"]
        if not (arrays["extent"] >= 0.0 and arrays["mailbox"] in (0, 1)):
            raise InputError("is damaged: extent or mailbox is out of range")
        if not 0 <= levels <= layouts.MAX_LEVELS or (levels and not (lo + np.float32(1 << levels) * arrays["size"] >= hi).all()):
            raise InputError("is damaged: its cells are not in order")
        if (nodes["count"] < -0xFF).any():
            raise InputError("is damaged: the count of a node is out of range")
        inner = nodes["count"] < 0
        check_children(nodes["first"][inner], -nodes["count"][inner], np.flatnonzero(inner), len(nodes), levels)
        check_references(nodes[~inner], arrays["references"], len(built.order))


def box_arrays(bounds: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the root box of the primitives' boxes, and their longest side."""
    lo, hi = bounds
    with np.errstate(over="ignore"):
        extent = np.asarray(np.nextafter((hi - lo).max(initial=0.0), np.float32(np.inf)))
    return {"lo": lo.min(axis=0, initial=np.inf), "hi": hi.max(axis=0, initial=-np.inf), "extent": extent}


def root_of(bounds: tuple[np.ndarray, np.ndarray], max_growth: float, spare: int = 0) -> np.ndarray:
    """Return the cell of the root, (1,), with a budget of max_growth references per primitive, and `spare` more."""
    root, n = records(Cell, 1), len(bounds[0])
    root["lo"], root["hi"] = bounds[0].min(axis=0, initial=np.inf), bounds[1].max(axis=0, initial=-np.inf)
    root["area"] = half_area.func(np.moveaxis(root["hi"].astype(np.float64) - root["lo"], 1, 0))
    root["count"], root["budget"] = n, int(min(max_growth * n + spare, MAX_REFERENCES))
    return root


def octree_layout(lo: np.ndarray, hi: np.ndarray, max_depth: int) -> WarpStruct:
    """Choose the OctreeLayout of boxes lo, hi (N, 3): a cube from their lowest corner on, clipped at their highest corner."""
    layout = layouts.OctreeLayout()
    low, high = lo.min(axis=0, initial=np.inf), hi.max(axis=0, initial=-np.inf)
    layout.lo, layout.hi, layout.size, layout.levels = wp.vec3(*low), wp.vec3(*high), 0.0, 0
    edge = float((high.astype(np.float64) - low).max())
    if not 0.0 < edge < 1e37:
        return layout
    # `finest` keeps cells so large that the rounding of their planes does not matter, and that float32 can represent them.
    finest = max(float(np.abs([low, high]).max()) * PAD_EXTENT, 1e-37)
    layout.levels = min(max_depth, max(int(np.log2(edge / finest)), 0))
    size = np.float32(edge / (1 << layout.levels))
    while not (low + np.float32(1 << layout.levels) * size >= high).all():
        size = np.nextafter(size, np.float32(np.inf))
    layout.size = float(size)
    return layout


def check_children(first: np.ndarray, mask: np.ndarray, parent: np.ndarray, n: int, levels: int) -> None:
    """Raise InputError unless n nodes form a tree. Node parent[i] has one child per bit of mask[i], consecutive from node first[i] on."""
    count = np.bitwise_count(mask.astype(np.int64)).astype(np.int64)
    child = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())
    check_tree(n, np.repeat(parent, count), child, levels)
