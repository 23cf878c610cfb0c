"""Builder of octrees: level by level from the root down, all cells of a level at once."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from wrt.accel.bvh.tree import half_areas
from wrt.accel.cells.common import cell_source, require_between, triangle_reach
from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Built
from wrt.core.building import report
from wrt.core.device import launch, records, start, upload
from wrt.core.types import WarpArray, WarpStruct
from wrt.kernels.build import octree as build_octree
from wrt.kernels.traverse.octree import MAX_LEVELS, OctreeLayout, OctreeNode
from wrt.kernels.units.box import PAD_EXTENT

REFERENCES_PER_LAUNCH = 16384
CELLS_PER_LAUNCH = 4096
MAX_REFERENCES = 1 << 27
OCTANTS = np.arange(8)[:, None] >> np.arange(3) & 1  # (8, 3): 0 for the lower and 1 for the upper half in x, y, z


@dataclass(frozen=True)
class OctreeOptions:
    """Options of the octree. Raises InputError for values out of range."""

    max_leaf: int = 8  # Cells of so many primitives or fewer are not split.
    max_depth: int = MAX_LEVELS  # Levels below the root, 0 to MAX_LEVELS.
    by_cost: bool = True  # Do not split a cell whose octants cost a ray as much as the cell.
    max_growth: float = 16.0  # Limit of references per primitive in every part of the tree.
    mailbox: bool = True  # Avoid testing a ray against the same primitive in several cells.

    def __post_init__(self) -> None:
        require_between(max_leaf=(self.max_leaf, 1, 1 << 20), max_depth=(self.max_depth, 0, MAX_LEVELS),
                        max_growth=(self.max_growth, 1.0, 1e4))


@dataclass
class Cells:
    """The M cells of one level."""

    corner: np.ndarray  # (M, 3) int32, lowest corners in units of finest cells.
    begin: np.ndarray
    references: np.ndarray  # (R,) prim_ids. Cell i has references[begin[i] : begin[i + 1]].
    growth: np.ndarray  # (M,) factor by which the number of references may grow from a cell to the leaves below it.

    @property
    def count(self) -> np.ndarray:
        return np.diff(self.begin)

    def part(self, chosen: np.ndarray) -> "Cells":
        """Return the cells in the mask `chosen`, (M,) bool."""
        count = self.count
        references = self.references[np.repeat(chosen, count)]
        begin = np.concatenate([[0], np.cumsum(count[chosen])]).astype(np.int32)
        return Cells(self.corner[chosen], begin, references, self.growth[chosen])


def root_cell(lo: np.ndarray, hi: np.ndarray, max_depth: int) -> WarpStruct:
    """Choose the OctreeLayout of boxes lo, hi (N, 3): a cube from their lowest corner on, clipped at their highest corner."""
    layout = OctreeLayout()
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


def planes(layout: WarpStruct, corner: np.ndarray) -> np.ndarray:
    """Convert plane indices `corner`, (..., 3), to coordinates in float64. Kernels round the coordinates to float32."""
    lo, hi = np.array(layout.lo, np.float64), np.array(layout.hi, np.float64)
    return np.minimum(lo + corner * float(layout.size), hi)


def areas(layout: WarpStruct, corner: np.ndarray, size: int) -> np.ndarray:
    """Return half the surface area of cells. corner: (..., 3), lowest corners; size: edge length; both in units of finest cells."""
    return half_areas(planes(layout, corner), planes(layout, corner + size))


def build_tree(geometry: Geometry, options: OctreeOptions, threads: int) -> Built:
    """Build the octree, level by level. Nodes are in breadth-first order. Built.depth counts the root as a level."""
    bounds = geometry.bounds()
    layout, n = root_cell(*bounds, options.max_depth), len(geometry)
    split = _Splitter(geometry, bounds, layout, threads)
    cells = Cells(np.zeros((1, 3), np.int32), np.array([0, n], np.int32), np.arange(n, dtype=np.int32),
                  np.array([min(options.max_growth, MAX_REFERENCES / max(n, 1))]))
    whole = float(areas(layout, cells.corner, 1 << layout.levels)[0]) if layout.levels else 0.0
    levels: list[np.ndarray] = []
    references, n_nodes, n_references, cost = [], 0, 0, 0.0
    while len(cells.corner):
        half = (1 << layout.levels - len(levels)) >> 1
        chosen, count, children = choose(cells, split, half, options)
        level = records(OctreeNode, len(cells.corner))
        occupied = (count > 0).sum(axis=1)
        level["count"] = cells.count
        level["count"][chosen] = -((count > 0) << np.arange(8)).sum(axis=1)
        leaves = cells.part(~chosen)
        level["first"][~chosen] = n_references + leaves.begin[:-1]
        n_nodes += len(level)
        level["first"][chosen] = n_nodes + np.cumsum(occupied) - occupied
        area = areas(layout, cells.corner, 2 * half or 1) if whole > 0.0 else np.ones(len(level))
        cost += float((area * (1 + np.where(chosen, 0, cells.count))).sum() / (whole if whole > 0.0 else 1.0))
        levels.append(level)
        references.append(leaves.references)
        n_references += len(leaves.references)
        cells = children
        report(len(levels) / (layout.levels + 1))
    nodes = np.concatenate(levels)
    pad, extent = triangle_reach(geometry, *bounds)
    return Built({"lo": np.array(layout.lo), "hi": np.array(layout.hi), "size": np.array(layout.size, np.float32),
                  "levels": np.array(layout.levels, np.int32), "pad": pad, "extent": extent,
                  "mailbox": np.array(options.mailbox, np.int32), "nodes": nodes, "references": np.concatenate(references)},
                 np.arange(n, dtype=np.int32), n_nodes, int((nodes["count"] >= 0).sum()), len(levels), cost)


def choose(cells: Cells, split: "_Splitter", half: int, options: OctreeOptions) -> tuple[np.ndarray, np.ndarray, Cells]:
    """Choose K of M cells to split; return their mask (M,), the number of references per octant (K, 8), and the next level's cells."""
    chosen = cells.count > options.max_leaf if half else np.zeros(len(cells.corner), bool)
    large = cells.part(chosen)
    count = split.count(large, half)
    # Each cell has a budget of references in proportion to its primitives, so that large objects do not use up all of it.
    growth = large.growth * large.count / np.maximum(count.sum(axis=1), 1)
    keep = growth >= 1.0
    corner = large.corner[:, None] + half * OCTANTS
    if options.by_cost:
        # Expected cost of a ray through the cell, in cells fetched and primitives tested: with octants, and as a leaf.
        area, whole = areas(split.layout, corner, half), areas(split.layout, large.corner, 2 * half)
        keep &= (area * (count + (count > 0))).sum(axis=1) < whole * large.count
    chosen[chosen] = keep
    return chosen, count[keep], split.fill(large, corner, np.where(keep[:, None], count, 0), growth)


class _Splitter:
    """Launcher of the kernels in kernels.build.octree over one geometry."""

    def __init__(self, geometry: Geometry, bounds: tuple[np.ndarray, np.ndarray], layout: WarpStruct, threads: int) -> None:
        self.cpu, self.layout, self.threads = start("cpu"), layout, threads
        self.source = cell_source(geometry, bounds)

    def _int32(self, array: np.ndarray) -> WarpArray:
        return upload(np.ascontiguousarray(array, np.int32), wp.int32, self.cpu)

    def count(self, cells: Cells, half: int) -> np.ndarray:
        """Count the references of each octant of each cell, (M, 8). half: edge of an octant in finest cells."""
        m, n = len(cells.corner), len(cells.references)
        self.begin, self.references = self._int32(cells.begin), self._int32(cells.references)
        self.masks = wp.zeros(n, dtype=wp.int32, device=self.cpu)
        count = wp.zeros((m, 8), dtype=wp.int32, device=self.cpu)
        split = build_octree.SplitCells()
        split.half = half
        split.corners = upload(np.ascontiguousarray(cells.corner, np.int32), wp.vec3i, self.cpu)
        split.cell_of = self._int32(np.repeat(np.arange(m), cells.count))
        launch(build_octree.find_octants, n, self.source, self.layout, None, split, self.references, self.masks,
               threads=self.threads, step=REFERENCES_PER_LAUNCH)
        launch(build_octree.count_octants, m, None, self.begin, self.masks, count, threads=self.threads, step=CELLS_PER_LAUNCH)
        return count.numpy()

    def fill(self, cells: Cells, corner: np.ndarray, count: np.ndarray, growth: np.ndarray) -> Cells:
        """Return the next level: all octants that have references, cell after cell.

        Call it right after `self.count` of the same cells, because it reads the octant masks that `self.count` stored. corner: (M, 8, 3),
        lowest corners of the octants. count: (M, 8), number of references of each octant; a cell that stays a leaf has a row of 0.
        growth: (M,), the growth that a cell's octants inherit.
        """
        begin = np.concatenate([[0], np.cumsum(count.ravel())])
        first = np.where(count.any(axis=1, keepdims=True), begin[:-1].reshape(-1, 8), -1)
        out = wp.zeros(int(begin[-1]), dtype=wp.int32, device=self.cpu)
        launch(build_octree.fill_octants, len(cells.corner), None, self.begin, self.masks, self.references,
               upload(np.ascontiguousarray(first, np.int32).reshape(-1, 8), wp.int32, self.cpu), out,
               threads=self.threads, step=CELLS_PER_LAUNCH)
        has = count > 0
        return Cells(corner[has].astype(np.int32), np.concatenate([begin[:-1][has.ravel()], begin[-1:]]).astype(np.int32),
                     out.numpy(), np.repeat(growth, has.sum(axis=1)))
