"""Shared code of the grid, octree, k-d tree and BSP tree: the builder of the trees, and checks of options and files."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Built
from wrt.accel.store import check_ranges
from wrt.core.building import tally
from wrt.core.device import launch, on_host, records, start, upload
from wrt.core.errors import InputError
from wrt.core.threads import run_all
from wrt.core.types import WarpStruct
from wrt.kernels.build import cells as kernels
from wrt.kernels.build.cell_splits import RULES
from wrt.kernels.build.clip import Shapes
from wrt.kernels.build.records import BuildRecord
from wrt.kernels.traverse.plane_layouts import LEAF, BspNode

# Triangles outside of these sizes are not clipped, because the error margin of clipping would underflow or be infinite.
CLIP_SIZES = (1e-30, 1e30)
MAX_REFERENCES = 1 << 27
KEEP = 4096  # A cell with so many references or fewer may be built by a launch of its own; in large trees: n / 64.


def bounds_of(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """Return the padded boxes of all primitives, each with a volume."""
    lo, hi = geometry.bounds()
    return lo, np.where(lo < hi, hi, np.nextafter(hi, np.float32(np.inf)))


def shapes_of(geometry: Geometry, bounds: tuple[np.ndarray, np.ndarray], clip: bool = True) -> WarpStruct:
    """Upload the primitives as kernels.build.clip.Shapes. bounds: their padded boxes. clip: False to clip boxes, not triangles."""
    cpu, shapes = start("cpu"), Shapes()
    with np.errstate(over="ignore", invalid="ignore"):
        extent = (bounds[1] - bounds[0]).max(axis=1, initial=0.0)
    exact = (extent > CLIP_SIZES[0]) & (extent < CLIP_SIZES[1]) & (np.arange(len(extent)) < len(geometry.faces)) & clip
    shapes.vertices = upload(geometry.vertices, wp.vec3, cpu)
    shapes.faces = upload(geometry.faces, wp.vec3i, cpu)
    shapes.lo, shapes.hi = (upload(array, wp.vec3, cpu) for array in bounds)
    shapes.exact = upload(exact.astype(np.uint8), wp.uint8, cpu)
    return shapes


@dataclass
class Subtree:
    """Output of a launch: nodes, prim_ids of the leaves, totals, and cells for later launches with their references."""

    nodes: np.ndarray
    order: np.ndarray
    totals: np.ndarray
    deferred: np.ndarray = field(default_factory=lambda: records(kernels.Cell, 0))
    references: np.ndarray = field(default_factory=lambda: records(BuildRecord, 0))


@dataclass
class Tree:
    """A finished tree: BspNode records, the root first, and the prim_ids of the leaves. cost: SAH cost of a line through the root box."""

    nodes: np.ndarray
    order: np.ndarray
    leaves: int
    depth: int
    cost: float

    def built(self, arrays: dict[str, Any], order: np.ndarray | None = None) -> Built:
        """Return the result of a builder. order: None for the primitives of the leaves."""
        return Built(arrays, self.order if order is None else order, len(self.nodes) - self.leaves, self.leaves, self.depth, self.cost)


def build_tree(name: str, shapes: WarpStruct, root: np.ndarray, options: WarpStruct, threads: int) -> Tree:
    """Build the tree `name` of RULES. It does not depend on `threads`. root: a kernels.build.cells.Cell, (1,)."""
    references = records(BuildRecord, root["count"][0])
    references["lo"], references["hi"], references["prim_id"] = shapes.lo.numpy(), shapes.hi.numpy(), np.arange(len(references))
    keep = max(len(references) // 64, KEEP)
    options.keep = keep if len(references) > keep else 0
    top = launched(name, shapes, references, root, options)
    options.keep = 0
    subtrees: list[Any] = [None] * len(top.deferred)
    finished = tally(len(references) + int(top.deferred["count"].sum()))
    finished(len(references))

    def job(i: int) -> None:
        cell = top.deferred[i : i + 1].copy()
        part = top.references[cell["first"][0] :][: cell["count"][0]]
        cell["first"] = cell["slot"] = 0
        subtrees[i] = launched(name, shapes, part, cell, options)
        finished(len(part))

    # The largest cells come first, so that all threads end at about the same time.
    run_all([partial(job, int(i)) for i in np.argsort(-top.deferred["count"], kind="stable")], threads)
    return joined([top, *subtrees], float(root["area"][0]))


def launched(name: str, shapes: WarpStruct, references: np.ndarray, cell: np.ndarray, options: WarpStruct) -> Subtree:
    """Build the subtree of a cell in one launch. The allocated memory is an upper bound; most of it is never touched."""
    cpu, work, out = start("cpu"), kernels.CellWork(), kernels.CellOutput()
    n, budget = len(references), int(cell["budget"][0])
    work.references, work.parts = (wp.empty(budget, dtype=BuildRecord, device=cpu) for _ in range(2))
    work.sides = wp.empty(budget, dtype=wp.uint8, device=cpu)
    work.lows, work.highs = (wp.empty(n, dtype=wp.float32, device=cpu) for _ in range(2))
    out.nodes = wp.empty(2 * budget + 64, dtype=BspNode, device=cpu)
    out.order = wp.empty(budget, dtype=wp.int32, device=cpu)
    out.deferred = wp.empty(8 * budget // options.keep + 64 if options.keep else 0, dtype=kernels.Cell, device=cpu)
    out.records = wp.empty(budget if options.keep else 0, dtype=BuildRecord, device=cpu)
    out.totals = wp.zeros(1, dtype=kernels.CellTotals, device=cpu)
    launch(kernels.make_build_cells(RULES[name]), 1, shapes, upload(references, BuildRecord, cpu), upload(cell, kernels.Cell, cpu), options,
           work, out)
    totals = on_host(out.totals)[0].copy()
    return Subtree(on_host(out.nodes)[: totals["nodes"]].copy(), out.order.numpy()[: totals["references"]].copy(), totals,
                   on_host(out.deferred)[: totals["deferred"]].copy(), on_host(out.records)[: totals["records"]].copy())


def joined(parts: list[Subtree], area: float) -> Tree:
    """Join the top and the subtrees of its deferred cells, whose roots replace their nodes. area: half surface area of the root box."""
    top, nodes = parts[0], [parts[0].nodes]
    first_node, first_reference = len(top.nodes), len(top.order)
    for part, slot in zip(parts[1:], top.deferred["slot"], strict=True):
        part.nodes["first"] += np.where(part.nodes["axis"] == LEAF, first_reference, first_node - 1).astype(np.int32)
        top.nodes[slot] = part.nodes[0]
        nodes.append(part.nodes[1:])
        first_node += len(part.nodes) - 1
        first_reference += len(part.order)
    totals = np.array([part.totals for part in parts])
    cost = 0.0 if not first_reference else float(totals["cost"].sum()) / area if area > 0.0 else float("nan")
    return Tree(np.concatenate(nodes), np.concatenate([part.order for part in parts]), int(totals["leaves"].sum()),
                int(totals["depth"].max()), cost)


def check_references(cells: np.ndarray, references: np.ndarray, n_primitives: int) -> None:
    """Raise InputError unless the records (first, count) of cells address references, and all references address primitives."""
    check_ranges(cells["first"], cells["count"], len(references))
    if ((references < 0) | (references >= n_primitives)).any():
        raise InputError("is damaged: a reference leads out of the primitives")
