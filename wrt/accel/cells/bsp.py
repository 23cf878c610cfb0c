"""BSP tree: cells are split by planes of any orientation (kernels: kernels/build/bsp*.py)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.cells.common import require_between
from wrt.accel.geometry import Geometry
from wrt.accel.snapshot import Built
from wrt.accel.store import check_tree
from wrt.core.building import tally
from wrt.core.device import launch, on_host, records, start, upload
from wrt.core.errors import InputError
from wrt.core.threads import run_all
from wrt.core.types import WarpArray, WarpStruct
from wrt.kernels.build import bsp as build_bsp
from wrt.kernels.build import bsp_split
from wrt.kernels.build.bsp_cell import MAX_FACES, MAX_POINTS, Cells
from wrt.kernels.build.bsp_split import BspTools, Pieces
from wrt.kernels.traverse import bsp as kernels

MAX_DEPTH = 60  # less than the size of the traversal stack
ROOM = 8  # memory for pieces, nodes and references, per primitive; doubled until it suffices
SPARE = 1024
MAX_ROOM = (2**31 - 1) // 6 - SPARE  # pieces: their points, six for each, are indexed in int32
MAX_SUBTREES = 1024  # largest number of subtrees with launches of their own
PIECE = {"prim_id": (wp.int32, ()), "first": (wp.int32, ()), "count": (wp.int32, ()), "lo": (wp.vec3d, (3,)),
         "hi": (wp.vec3d, (3,)), "ball": (wp.vec4d, (4,)), "extent": (wp.float64, ())}  # fields of Pieces: Warp type, shape


@dataclass(frozen=True)
class BspOptions:
    """Options of the BSP tree. Raises InputError for values out of range."""

    cost_intersection: float = 75.0  # SAH cost of a primitive; the three defaults are those of the Manta renderer.
    cost_axis: float = 10.0  # SAH cost of a node with an axis-aligned plane.
    cost_plane: float = 20.0  # SAH cost of any other node.
    samples: int = 128  # Triangles per cell, evenly spread over its list, that propose four planes each; 0: a k-d tree.
    max_depth: int = 0  # From 1 to 60; 0: 16 + 2 log2 of the number of primitives.
    max_growth: float = 16.0  # Limit of references per primitive, 1 to 1000.
    max_triangles: int = 500_000  # Largest number of primitives.

    def __post_init__(self) -> None:
        for name in ("cost_intersection", "cost_axis", "cost_plane"):
            if not 0.0 < (value := getattr(self, name)) < math.inf:
                raise InputError(f"must be above 0 and finite, got {value}", argument=name)
        require_between(samples=(self.samples, 0, 1 << 30), max_depth=(self.max_depth, 0, MAX_DEPTH),
                        max_growth=(self.max_growth, 1.0, 1000.0))

    def on_device(self, lo: np.ndarray, hi: np.ndarray, n: int) -> WarpStruct:
        """Convert the options for kernels. n: number of primitives; lo, hi: their boxes, (n, 3)."""
        out = bsp_split.BspOptions()
        out.cost_intersection, out.cost_axis, out.cost_plane = self.cost_intersection, self.cost_axis, self.cost_plane
        out.samples, out.max_depth = self.samples, self.max_depth or min(MAX_DEPTH, 16 + 2 * math.ceil(math.log2(n)))
        out.lo, out.hi = wp.vec3d(lo.min(axis=0)), wp.vec3d(hi.max(axis=0))
        return out


class Bsp(OneMesh):
    """A BSP tree, which is slow to build. Options: BspOptions.

    Ize, Wald and Parker 2008, "Ray Tracing with the BSP Tree". Only the planes of some triangles of a cell are tried.
    """

    name = "bsp"
    kernels = kernels
    options = BspOptions

    def _build(self, options: BspOptions) -> Built:
        n = len(self.geometry)
        if n > options.max_triangles:
            raise InputError(f"bsp is slow to build, so that max_triangles={options.max_triangles} is the limit; there are {n}",
                             argument="max_triangles", hint="use another structure (kdtree, bvh), or raise max_triangles")
        if n == 0:
            return Built({"nodes": records(kernels.BspNode, 0), "lo": np.full(3, np.inf), "hi": np.full(3, -np.inf),
                          "extent": np.zeros(1, np.float32), "first": np.zeros(1, np.int32), "count": np.zeros(1, np.int32)},
                         np.zeros(0, np.int32), sah_cost=0.0)
        lo, hi = (bound.astype(np.float64) for bound in self.geometry.bounds())
        return Builder(self.geometry, options.on_device(lo, hi, n), self.threads, int(options.max_growth * n)).build()

    def _check(self, built: Built) -> None:
        if any(built.arrays[name].size != size for name, size in (("lo", 3), ("hi", 3), ("extent", 1), ("first", 1), ("count", 1))):
            raise InputError("is damaged: it does not have exactly one root")
        nodes, root_first, root_count = (built.arrays[name] for name in ("nodes", "first", "count"))
        n = len(nodes)
        parent = np.repeat(np.arange(-1, n), [1, *[2] * n])
        first, count = (np.concatenate([root.reshape(1), np.stack([nodes[f"{what}_0"], nodes[f"{what}_1"]], axis=1).reshape(-1)])
                        for what, root in (("first", root_first), ("count", root_count)))
        first, inner = first.astype(np.int64), count == kernels.INNER
        if ((count < 0) & ~inner).any() or (inner & ((first <= parent) | (first >= n))).any() or (
                (count > 0) & ((first < 0) | (first + count > len(built.order)))).any():
            raise InputError("is damaged: a node leads out of the tree")
        if ((nodes["axis"] < 0) | (nodes["axis"] > kernels.PLANE)).any():
            raise InputError("is damaged: a node's axis is out of range")
        # For check_tree, the link to the root becomes node 0, before all other nodes.
        check_tree(n + 1, parent[inner] + 1, first[inner] + 1, kernels.STACK_SIZE)


class Launch:
    """One launch of kernels.build.bsp.build_cells with memory for `room` pieces of primitives, and the launch's results."""

    def __init__(self, corners: WarpArray, options: WarpStruct, room: int, n_deferred: int) -> None:
        self.cpu = start("cpu")
        self.room = room
        self.tools = BspTools()
        self.tools.pieces = pieces_of(room, 6 * room + 1024)
        self.tools.cells = cells_of(build_bsp.CELL_SLOTS)
        self.tools.corners, self.tools.options = corners, options
        self.stack = wp.empty(build_bsp.CELL_SLOTS, dtype=build_bsp.BspTask, device=self.cpu)
        self.output = build_bsp.BspOutput()
        self.output.nodes = wp.empty(room, dtype=kernels.BspNode, device=self.cpu)
        self.output.order = wp.empty(room, dtype=wp.int32, device=self.cpu)
        self.output.deferred = wp.empty(n_deferred, dtype=build_bsp.BspTask, device=self.cpu)
        self.output.deferred_cells = cells_of(n_deferred)
        self.output.results = wp.zeros(build_bsp.N_RESULTS, dtype=wp.int32, device=self.cpu)
        self.output.cost = wp.zeros(1, dtype=wp.float64, device=self.cpu)

    def run(self, source: WarpStruct, tasks: WarpArray, cells: WarpStruct, which: int) -> bool:
        """Launch build_cells for the task tasks[which], and return whether the memory sufficed."""
        launch(build_bsp.build_cells, 1, source, tasks, cells, which, self.tools, self.stack, self.output)
        self.results = self.output.results.numpy().copy()
        self.nodes = on_host(self.output.nodes)[: self.results[build_bsp.N_NODES]].copy()
        self.order = self.output.order.numpy()[: self.results[build_bsp.N_ORDER]].copy()
        self.cost = float(self.output.cost.numpy()[0])
        return not self.results[build_bsp.FULL]


class Subtree:
    """Results of a Launch, without the launch's memory."""

    def __init__(self, launch: Launch) -> None:
        self.results, self.nodes, self.order, self.cost = launch.results, launch.nodes, launch.order, launch.cost


class Builder:
    """Builds the top of the tree in one launch, and then the subtrees below on all threads, the largest first."""

    def __init__(self, geometry: Geometry, options: WarpStruct, threads: int, budget: int) -> None:
        self.options, self.threads, self.budget = options, threads, budget
        self.source, corners = start_pieces(geometry)
        lo, hi = geometry.bounds()
        with np.errstate(over="ignore"):
            self.extent = np.nextafter((hi - lo).max(), np.float32(np.inf)).reshape(1)
        self.n = len(geometry)
        self.corners = upload(corners, wp.vec3d, start("cpu"))

    def launch(self, source: WarpStruct, tasks: WarpArray, cells: WarpStruct, which: int, n: int, keep: int) -> Launch:
        """Launch, and double the memory until it suffices. keep: cells of at most `keep` pieces become tasks of later launches; 0: none."""
        room = ROOM * n + SPARE
        self.options.keep = keep
        while True:
            if room > MAX_ROOM:
                raise InputError(f"a BSP tree of {n} primitives is too large", hint="lower max_growth, or use another structure")
            launch = Launch(self.corners, self.options, room, MAX_SUBTREES if keep else 0)
            if launch.run(source, tasks, cells, which):
                return launch
            room *= 2

    def build(self) -> Built:
        keep = max(self.n // 64, 512)
        root = records(build_bsp.BspTask, 1)
        root["end"], root["budget"] = self.n, self.budget
        top = self.launch(self.source, upload(root, build_bsp.BspTask, start("cpu")), cells_of(0), 0, self.n,
                          keep if self.n > keep else 0)
        tasks = on_host(top.output.deferred)[: top.results[build_bsp.N_DEFERRED]]
        size = tasks["end"] - tasks["begin"]
        subtrees: list[Subtree | None] = [None] * len(tasks)
        finished = tally(int(size.sum()))

        def job(i: int) -> None:
            subtrees[i] = Subtree(self.launch(top.tools.pieces, top.output.deferred, top.output.deferred_cells, i, int(size[i]), 0))
            finished(int(size[i]))

        run_all([partial(job, int(i)) for i in np.argsort(-size, kind="stable")], self.threads)
        return self.join(top, [subtree for subtree in subtrees if subtree is not None])

    def join(self, top: Launch, subtrees: list[Subtree]) -> Built:
        """Join the nodes and primitives of the top and the subtrees. The nodes of the top come first."""
        parts = [Subtree(top), *subtrees]
        first_node = np.cumsum([0] + [len(part.nodes) for part in parts])
        first_primitive = np.cumsum([0] + [len(part.order) for part in parts])
        for k, part in enumerate(parts):
            for side in ("0", "1"):
                first, count = part.nodes["first_" + side], part.nodes["count_" + side]
                moved = np.where(count == kernels.INNER, first_node[k], np.where(count > 0, first_primitive[k], 0))
                first += moved.astype(np.int32)
        roots = np.array([part.results[[build_bsp.ROOT_FIRST, build_bsp.ROOT_COUNT]] for part in parts])
        roots[:, 0] += np.where(roots[:, 1] == kernels.INNER, first_node[:-1], first_primitive[:-1])
        for side in ("0", "1"):
            nodes = parts[0].nodes
            left = np.nonzero(nodes["count_" + side] == build_bsp.DEFERRED)[0]
            root = roots[1 + nodes["first_" + side][left]]
            nodes["first_" + side][left], nodes["count_" + side][left] = root[:, 0], root[:, 1]
        arrays = {"nodes": np.concatenate([part.nodes for part in parts]), "first": roots[0, :1], "count": roots[0, 1:],
                  "lo": np.array(self.options.lo), "hi": np.array(self.options.hi), "extent": self.extent}
        results = np.array([part.results for part in parts])
        return Built(arrays, np.concatenate([part.order for part in parts]), int(first_node[-1]),
                     int(results[:, build_bsp.LEAVES].sum()), int(results[:, build_bsp.DEPTH].max()) + 1,
                     sum(part.cost for part in parts))


def pieces_of(n: int, points: int) -> WarpStruct:
    """Allocate kernels.build.bsp_split.Pieces with room for n pieces, and for `points` corners in all pieces together."""
    pieces = Pieces()
    for name, (dtype, _) in PIECE.items():
        setattr(pieces, name, wp.empty(n, dtype=dtype, device=start("cpu")))
    pieces.points = wp.empty(points, dtype=wp.vec3d, device=start("cpu"))
    return pieces


def cells_of(slots: int) -> WarpStruct:
    cells, cpu = Cells(), start("cpu")
    cells.n_faces = wp.zeros(slots, dtype=wp.int32, device=cpu)
    cells.first = wp.zeros(slots * (MAX_FACES + 1), dtype=wp.int32, device=cpu)
    cells.points = wp.zeros(slots * MAX_POINTS, dtype=wp.vec3d, device=cpu)
    cells.area = wp.zeros(slots * MAX_FACES, dtype=wp.float64, device=cpu)
    return cells


def start_pieces(geometry: Geometry) -> tuple[WarpStruct, np.ndarray]:
    """Make a piece of every primitive; return the pieces, and the corners of the triangles, (3 F, 3) float64."""
    n, triangles = len(geometry), len(geometry.faces)
    corners = geometry.vertices[geometry.faces].astype(np.float64)
    spheres = geometry.spheres.astype(np.float64)
    lo = np.concatenate([corners.min(axis=1, initial=np.inf), spheres[:, :3] - spheres[:, 3:]])
    hi = np.concatenate([corners.max(axis=1, initial=-np.inf), spheres[:, :3] + spheres[:, 3:]])
    middle = 0.5 * (lo + hi)
    radius = np.concatenate([np.linalg.norm(corners - middle[:triangles, None], axis=2).max(axis=1, initial=0.0), spheres[:, 3]])
    values = {"prim_id": np.arange(n), "first": 3 * np.arange(n), "count": np.where(np.arange(n) < triangles, 3, 0), "lo": lo,
              "hi": hi, "ball": np.concatenate([middle, radius[:, None] * (1.0 + 2.0**-40)], axis=1),
              "extent": (hi - lo).max(axis=1, initial=0.0)}
    pieces, cpu = Pieces(), start("cpu")
    for name, (dtype, shape) in PIECE.items():
        setattr(pieces, name, upload(values[name].reshape(n, *shape), dtype, cpu))
    pieces.points = upload(corners.reshape(-1, 3), wp.vec3d, cpu)
    return pieces, corners.reshape(-1, 3)
