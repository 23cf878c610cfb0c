"""`python -m wrt bench bvh`: builders of binary BVHs against each other, and bounding volumes around one and the same tree."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import warp as wp

from wrt.accel.base import Accelerator
from wrt.accel.build import build
from wrt.accel.bvh.builders import BVH_BUILDERS, BvhOptions, build_binary
from wrt.accel.bvh.kdop_area import kdop_areas
from wrt.accel.bvh.tree import half_areas
from wrt.accel.geometry import Geometry
from wrt.core.device import load_kernel, thread_count, upload
from wrt.core.errors import InputError
from wrt.io.mesh_file import as_mesh
from wrt.kernels.query import RayArrays
from wrt.kernels.study.query_volumes import count_popped, make_enter_kernel
from wrt.kernels.traverse.bvh2 import box_volumes
from wrt.kernels.traverse.bvh2_kdop import kdop_volumes
from wrt.kernels.traverse.bvh2_sphere import sphere_volumes
from wrt.lab.bench.peak_memory import peak_bytes
from wrt.lab.bench.rays import RaySet, endless, unit
from wrt.lab.bench.report import Part, check_plan, gathered, load_average, markdown
from wrt.lab.bench.report import machine as machine_line
from wrt.lab.bench.timing import alternate, spread

VOLUMES = ("bvh2", "bvh2_sphere", "bvh2_kdop")
TESTED_RAYS, TESTED_NODES = 1024, 1024
BUILDER_COLUMNS = ("builder", "SAH", "cost", "nodes", "leaves", "triangles", "depth", "refs", "build s", "CPU s", "peak B")
VOLUME_COLUMNS = ("volume", "B/node", "inner area", "leaf area", "SAH", "nodes", "triangles", "ns/test", "/ box", "Mray/s",
                  "differ")
LEGEND = """\
Rays: they start on the sphere around the root's box, inwards with a cosine distribution; those that pass by the box are left out.
SAH: expected nodes and triangles of a random line through the root's box, costing 1 each. cost: nodes and leaves popped and
triangles tested, a ray, where nothing that was pushed is dropped (as tinybvh counts); nodes, leaves, triangles: what wrt's own
traversal fetches. refs: primitives in all leaves over triangles. build s: the tree alone, middle of the builds with the
quartiles. CPU s: of all threads together, which tells less of what else the machine does. peak B: what the process grew by at the
first build, a triangle. inner area, leaf area: surfaces of all children that are nodes or leaves, over those of the boxes.
ns/test: of one volume, tested on one thread with nothing around it; / box: over the box's, run by run. Mray/s: one thread.
differ: rays with another prim_id or another bit of t than bvh2."""


@dataclass(frozen=True)
class Plan:
    """Mesh files, builders (none: all), rays, builds of each builder and runs of each volume. Raises InputError."""

    meshes: Sequence[str | Path]
    builders: Sequence[str] = ()
    rays: int = 2**18
    builds: int = 3
    runs: int = 7
    threads: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.meshes:
            raise InputError("name the meshes")
        check_plan(self, {BVH_BUILDERS.kind: (self.builders, BVH_BUILDERS)}, rays=(1, 2**26), builds=(1, 100), runs=(1, 1000))
        thread_count(self.threads)


@dataclass(frozen=True)
class BuilderRow:
    """What LEGEND says of a builder; seconds: of each build; cpu_seconds: of one, on average; load: of the machine before the
    first."""

    mesh: str
    n_triangles: int
    builder: str
    sah_cost: float
    cost: float
    nodes: float
    leaves: float
    triangles: float
    depth: int
    references: int
    seconds: tuple[float, ...]
    cpu_seconds: float
    peak_bytes: float
    load: float

    def cells(self) -> tuple[str, ...]:
        return (self.builder, f"{self.sah_cost:.2f}", f"{self.cost:.2f}", f"{self.nodes:.2f}", f"{self.leaves:.2f}",
                f"{self.triangles:.2f}", f"{self.depth}", f"{self.references / self.n_triangles:.2f}", spread(self.seconds),
                f"{self.cpu_seconds:.3g}", f"{self.peak_bytes / self.n_triangles:.0f}")


@dataclass(frozen=True)
class VolumeRow:
    """What LEGEND says of a volume; test_seconds, ratios: of one test, and over the box's in the same run; seconds: of all rays."""

    mesh: str
    n_triangles: int
    volume: str
    node_bytes: int
    inner_area: float
    leaf_area: float
    sah_cost: float
    nodes: float
    triangles: float
    test_seconds: tuple[float, ...]
    ratios: tuple[float, ...]
    rays: int
    seconds: tuple[float, ...]
    differ: int

    def cells(self) -> tuple[str, ...]:
        mrays = self.rays / np.array(self.seconds) / 1e6
        return (self.volume, f"{self.node_bytes}", f"{self.inner_area:.3f}", f"{self.leaf_area:.3f}", f"{self.sah_cost:.2f}",
                f"{self.nodes:.2f}", f"{self.triangles:.2f}", spread(self.test_seconds, 1e9), spread(self.ratios),
                spread(mrays), f"{self.differ}")


Rows = list[BuilderRow | VolumeRow]


def run(plan: Plan, report: Callable[[BuilderRow | VolumeRow], None] | None = None) -> Rows:
    """Measure everything; `report` gets each row as it is done. Raises InputError (a file)."""
    return gathered((row for path in plan.meshes for row in _mesh_rows(plan, path)), report)


def _mesh_rows(plan: Plan, path: str | Path) -> Iterator[BuilderRow | VolumeRow]:
    geometry, name = Geometry.of(as_mesh(path)), Path(path).name
    rays = inward(geometry, plan.rays, plan.seed)
    yield from builder_rows(plan, name, geometry, rays)
    yield from volume_rows(plan, name, geometry, rays)


def machine(plan: Plan) -> str:
    return machine_line()


def inward(geometry: Geometry, n: int, seed: int = 0) -> RaySet:
    """n rays from the sphere around the geometry's box, inwards with a cosine distribution, that meet the box: uniform lines."""
    lo, hi = (bound.astype(np.float64) for bound in geometry.bounds())
    lo, hi = lo.min(axis=0), hi.max(axis=0)
    center, radius = 0.5 * (lo + hi), 0.5 * float(np.linalg.norm(hi - lo))
    rng = np.random.default_rng(seed)
    origins, directions = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
    while len(origins) < n:
        normal = unit(rng.normal(size=(n, 3)))
        o, d = (center + radius * normal).astype(np.float32), unit(unit(rng.normal(size=(n, 3))) - normal).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sort([(lo - o) / d, (hi - o) / d], axis=0)
        meets = t[0].max(axis=1) <= t[1].min(axis=1)
        origins, directions = np.concatenate([origins, o[meets]]), np.concatenate([directions, d[meets]])
    return RaySet("inward", origins[:n], directions[:n], endless(n))


def builder_rows(plan: Plan, mesh: str, geometry: Geometry, rays: RaySet) -> Iterator[BuilderRow]:
    small = Geometry(geometry.vertices, geometry.faces[:64], geometry.spheres)
    for name in plan.builders or BVH_BUILDERS:
        build_binary(small, BvhOptions(name), 1)  # the kernels are compiled
        busy = load_average()
        grow = partial(build_binary, geometry, BvhOptions(name), thread_count(plan.threads))
        _, peak = peak_bytes(grow)
        seconds, cpu_begin = [], process_time()
        for _ in range(plan.builds):
            begin = perf_counter()
            grow()
            seconds.append(perf_counter() - begin)
        cpu_seconds = (process_time() - cpu_begin) / plan.builds
        accel = build(geometry, "bvh2", builder=name)
        c = accel.closest_hit(rays.origins, rays.directions, counters=True).counters
        assert c is not None
        yield BuilderRow(mesh, len(geometry), name, accel.stats.sah_cost, published_cost(accel, rays), float(c.nodes.mean()),
                         float(c.leaves.mean()), float(c.primitives.mean()), accel.stats.depth, accel.stats.references,
                         tuple(seconds), cpu_seconds, peak, busy)


def device_rays(rays: RaySet, n: int | None = None) -> RayArrays:
    out, part = RayArrays(), rays.part(slice(n))
    out.origin, out.direction = upload(part.origins, wp.vec3, "cpu"), upload(part.directions, wp.vec3, "cpu")
    out.t_min, out.t_max = upload(np.zeros(len(part), np.float32), wp.float32, "cpu"), upload(part.t_max, wp.float32, "cpu")
    return out


def published_cost(accel: Accelerator, rays: RaySet) -> float:
    """Nodes and leaves popped and triangles tested, a ray, as tinybvh counts."""
    hits = accel.closest_hit(rays.origins, rays.directions)
    counts = [wp.zeros(len(rays), dtype=wp.int32, device="cpu") for _ in range(2)]
    load_kernel(count_popped, accel.device)
    wp.launch(count_popped, dim=len(rays), device="cpu", inputs=[
        accel.data.nodes, upload(accel.built.order.copy(), wp.int32, "cpu"), device_rays(rays), upload(hits.t, wp.float32, "cpu"),
        upload(hits.prim_id, wp.int32, "cpu"), *counts])
    return float(sum(count.numpy().mean() for count in counts))


def surfaces(accel: Accelerator) -> np.ndarray:
    """Of both children of every node, (2, N)."""
    nodes = accel.built.arrays["nodes"]
    if accel.name == "bvh2_sphere":
        radius = np.stack([nodes["sphere_0"][:, 3], nodes["sphere_1"][:, 3]]).astype(np.float64)
        return np.asarray(4.0 * np.pi * np.maximum(radius, 0.0) ** 2)
    if accel.name == "bvh2_kdop":
        return kdop_areas(nodes, accel.built.arrays["middle"])
    return np.stack([2.0 * half_areas(nodes[f"lo_{side}"], nodes[f"hi_{side}"]) for side in "01"])


def volume_rows(plan: Plan, mesh: str, geometry: Geometry, rays: RaySet) -> Iterator[VolumeRow]:
    accels = {name: build(geometry, name) for name in VOLUMES}
    boxes, truth = surfaces(accels["bvh2"]), accels["bvh2"].closest_hit(rays.origins, rays.directions)
    nodes = accels["bvh2"].built.arrays["nodes"]
    leaf = np.stack([nodes["count_0"], nodes["count_1"]]) > 0
    tests = {name: tester_of(accel, rays) for name, accel in accels.items()}
    counts = {name: test() for name, test in tests.items()}
    trace = {name: partial(accel.closest_hit, rays.origins, rays.directions, threads=1) for name, accel in accels.items()}
    tested = {name: seconds / counts[name] for name, seconds in alternate(tests, plan.runs).items()}
    traced = alternate(trace, plan.runs)
    for name, accel in accels.items():
        area = surfaces(accel)
        hits = accel.closest_hit(rays.origins, rays.directions, counters=True)
        c = hits.counters
        assert c is not None
        differ = (hits.prim_id != truth.prim_id) | (hits.t.view(np.int32) != truth.t.view(np.int32))
        yield VolumeRow(mesh, len(geometry), name, accel.built.arrays["nodes"].itemsize,
                        float(area[~leaf].sum() / max(boxes[~leaf].sum(), 1e-300)), float(area[leaf].sum() / boxes[leaf].sum()),
                        accel.stats.sah_cost, float(c.nodes.mean()), float(c.primitives.mean()), tuple(tested[name].tolist()),
                        tuple((tested[name] / tested["bvh2"]).tolist()), len(rays), tuple(traced[name].tolist()), int(differ.sum()))


def tester_of(accel: Accelerator, rays: RaySet) -> Callable[[], int]:
    """Tests every one of some rays against some nodes, evenly from the whole tree; gives how many tests that were."""
    units = accel.structure.units
    record = units.triangle_test.record
    volumes = {"bvh2": lambda: box_volumes(record, units.box_test), "bvh2_sphere": lambda: sphere_volumes(record),
               "bvh2_kdop": lambda: kdop_volumes(record)}[accel.name]()
    kernel = make_enter_kernel(volumes)
    load_kernel(kernel, accel.device)
    data = accel.structure.struct()
    nodes = accel.built.arrays["nodes"]
    data.nodes = upload(nodes[:: max(len(nodes) // TESTED_NODES, 1)][:TESTED_NODES].copy(), volumes.node, "cpu")
    if accel.name == "bvh2_kdop":
        data.middle = accel.data.middle
    n = min(TESTED_RAYS, len(rays))
    inputs = [data, device_rays(rays, n), wp.zeros(n, dtype=wp.int32, device="cpu")]

    def test() -> int:
        wp.launch(kernel, dim=n, inputs=inputs, device="cpu")
        return n * 2 * len(data.nodes)

    return test


def line(row: BuilderRow | VolumeRow) -> str:
    """For the progress."""
    return f"{row.mesh}: {'  '.join(row.cells())}"


def text(rows: Rows, machine: str) -> str:
    """All tables as Markdown."""
    parts = [Part("", machine)]
    for mesh in dict.fromkeys(row.mesh for row in rows):
        group = [row for row in rows if row.mesh == mesh]
        for kind, columns in ((BuilderRow, BUILDER_COLUMNS), (VolumeRow, VOLUME_COLUMNS)):
            parts.append(Part("", f"{mesh}, {group[0].n_triangles} triangles", columns,
                              [row.cells() for row in group if isinstance(row, kind)]))
    loads = [row.load for row in rows if isinstance(row, BuilderRow)]
    return markdown([*parts, Part("", f"Load average at the builds: {min(loads):.1f} to {max(loads):.1f}."), Part("", LEGEND)])


def data(rows: Rows) -> dict[str, object]:
    """For JSON."""
    return {"builders": [vars(row) for row in rows if isinstance(row, BuilderRow)],
            "volumes": [vars(row) for row in rows if isinstance(row, VolumeRow)]}
