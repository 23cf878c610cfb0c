"""`python -m wrt bench bvh`: compare builders of binary BVHs, and boxes, spheres and 14-DOPs as bounding volumes of one tree."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from time import process_time

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.bvh.builders import BVH_BUILDERS, BvhOptions, build_binary
from wrt.accel.bvh.kdop_area import kdop_areas
from wrt.accel.bvh.tree import half_areas
from wrt.accel.geometry import Geometry
from wrt.accel.queries.rays import rays_of, rays_on
from wrt.accel.scenes.build import build
from wrt.core.device import launch_on, load_kernel, upload
from wrt.core.threads import thread_count
from wrt.io.mesh_file import as_mesh
from wrt.kernels.study.query_volumes import count_popped, make_enter_kernel
from wrt.kernels.traverse.bvh2 import box_volumes
from wrt.kernels.traverse.bvh2_kdop import kdop_volumes
from wrt.kernels.traverse.bvh2_sphere import sphere_volumes
from wrt.lab.bench.accel import differing
from wrt.lab.bench.rays import RaySet, ball_around, endless, mean_counters, unit
from wrt.lab.bench.report import Columns, Groups, Part, Row, cells, grouped, mesh_name, tabled
from wrt.lab.bench.timing import alternate, peak_bytes, spread, with_seconds
from wrt.lab.plans import Bvh as Plan

Measure = Callable[[Geometry, RaySet], Iterator[dict[str, object]]]
VOLUMES = ("bvh2", "bvh2_sphere", "bvh2_kdop")
TESTED_RAYS, TESTED_NODES = 1024, 1024  # most rays and nodes that time one bounding volume alone
TITLE = "Builders of binary BVHs, and bounding volumes"
BUILDERS: Columns = {
    "builder": "{builder}", "SAH cost": "{sah_cost:.2f}", "cost/ray": "{cost:.2f}", "nodes/ray": "{nodes:.2f}",
    "leaves/ray": "{leaves:.2f}", "triangles/ray": "{triangles:.2f}", "depth": "{depth}",
    "references/triangle": lambda row: f"{row.references / row.n_triangles:.2f}", "build s": lambda row: spread(row.seconds),
    "CPU s": "{cpu_seconds:.3g}", "peak B/triangle": lambda row: f"{row.peak_bytes / row.n_triangles:.0f}"}
VOLUME: Columns = {
    "volume": "{volume}", "B/node": "{node_bytes}", "inner area": "{inner_area:.3f}", "leaf area": "{leaf_area:.3f}",
    "SAH cost": "{sah_cost:.2f}", "nodes/ray": "{nodes:.2f}", "triangles/ray": "{triangles:.2f}",
    "ns/test": lambda row: spread(row.test_seconds, 1e9), "time / box": lambda row: spread(row.ratios),
    "Mray/s": lambda row: spread(row.rays / np.array(row.seconds) / 1e6), "differ": "{differ}"}
LEGEND = """\
Rays start on the sphere around the root's box, go inwards with a cosine distribution, and meet the box. SAH cost: nodes and triangles
that a random line through the root's box is expected to visit. cost/ray: nodes and leaves popped plus triangles tested, where every
pushed entry is popped again (as tinybvh counts). nodes, leaves, triangles: counts of wrt's own traversal. references: entries of all
leaves. build s: seconds to build the tree alone, median with quartiles. CPU s: sum over all threads, less sensitive to other load. peak
B: growth of the process's memory at the first build. inner area, leaf area: total surface of the volumes of inner nodes, or of leaves,
over the surface of their boxes. ns/test: time to test one volume on one thread, without traversal. time / box: ratio to the box, run by
run. Mray/s: on one thread. differ: rays whose prim_id or t, bit for bit, is not that of bvh2."""


def groups(plan: Plan) -> Groups:
    for mesh in map(as_mesh, plan.meshes):
        geometry = Geometry.of(mesh)
        rays = cache(partial(inward, geometry, plan.rays, plan.seed))
        measures: list[Measure] = [partial(builder_rows, plan, builder) for builder in plan.builders or BVH_BUILDERS]
        measures.append(partial(volume_rows, plan))
        for measure in measures:
            yield partial(mesh_rows, mesh_name(mesh), geometry, rays, measure)


def mesh_rows(mesh: str, geometry: Geometry, rays: Callable[[], RaySet], measure: Measure) -> list[Row]:
    return [Row(mesh=mesh, n_triangles=len(geometry), **measured) for measured in measure(geometry, rays())]


def inward(geometry: Geometry, n: int, seed: int = 0) -> RaySet:
    """Return n rays along uniformly distributed lines that meet the geometry's box. They start on its bounding sphere and go inwards."""
    lo, hi, center, radius = ball_around(geometry)
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


def builder_rows(plan: Plan, name: str, geometry: Geometry, rays: RaySet) -> Iterator[dict[str, object]]:
    small = Geometry(geometry.vertices, geometry.faces[:64], geometry.spheres)
    build_binary(small, BvhOptions(name), 1)  # compiles the kernels
    grow = partial(build_binary, geometry, BvhOptions(name), thread_count(plan.threads))
    _, peak = peak_bytes(grow)
    cpu_begin = process_time()
    seconds = [with_seconds(grow)[1] for _ in range(plan.builds)]
    cpu_seconds = (process_time() - cpu_begin) / plan.builds
    accel = build(geometry, "bvh2", builder=name)
    yield {"builder": name, "sah_cost": accel.stats.sah_cost, "cost": published_cost(accel, rays), "peak_bytes": peak,
           **mean_counters(accel, rays, nodes="nodes", leaves="leaves", triangles="primitives"), "depth": accel.stats.depth,
           "references": accel.stats.references, "seconds": seconds, "cpu_seconds": cpu_seconds}


def published_cost(accel: OneMesh, rays: RaySet) -> float:
    """Return the mean over the rays of tinybvh's cost: nodes and leaves popped from the stack, plus triangles tested."""
    hits = accel.closest_hit(rays.origins, rays.directions)
    counts = [wp.zeros(len(rays), dtype=wp.int32, device=accel.device) for _ in range(2)]
    device_rays = rays_on(accel.device, rays_of(rays.origins, rays.directions, 0.0, rays.t_max))
    launch_on(accel.device, count_popped, len(rays), accel.data.nodes, upload(accel.built.order.copy(), wp.int32, accel.device),
              device_rays, upload(hits.t, wp.float32, accel.device), upload(hits.prim_id, wp.int32, accel.device), *counts)
    return float(sum(count.numpy().mean() for count in counts))


def surfaces(accel: OneMesh) -> np.ndarray:
    """Return the surface areas of the bounding volumes of both children of every node, (2, N)."""
    nodes = accel.built.arrays["nodes"]
    if accel.name == "bvh2_sphere":
        radius = np.stack([nodes["sphere_0"][:, 3], nodes["sphere_1"][:, 3]]).astype(np.float64)
        return np.asarray(4.0 * np.pi * np.maximum(radius, 0.0) ** 2)
    if accel.name == "bvh2_kdop":
        return kdop_areas(nodes, accel.built.arrays["middle"])
    return np.stack([2.0 * half_areas(nodes[f"lo_{side}"], nodes[f"hi_{side}"]) for side in "01"])


def volume_rows(plan: Plan, geometry: Geometry, rays: RaySet) -> Iterator[dict[str, object]]:
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
        yield {"volume": name, "node_bytes": accel.built.arrays["nodes"].itemsize,
               "inner_area": float(area[~leaf].sum() / max(boxes[~leaf].sum(), 1e-300)),
               "leaf_area": float(area[leaf].sum() / boxes[leaf].sum()), "sah_cost": accel.stats.sah_cost,
               **mean_counters(accel, rays, nodes="nodes", triangles="primitives"), "test_seconds": tested[name].tolist(),
               "ratios": (tested[name] / tested["bvh2"]).tolist(), "rays": len(rays), "seconds": traced[name].tolist(),
               "differ": differing(accel.closest_hit(rays.origins, rays.directions), truth)}


def tester_of(accel: OneMesh, rays: RaySet) -> Callable[[], int]:
    """Return a function that tests up to 1024 rays against both children of up to 1024 nodes, and returns the number of tests."""
    units = accel.structure.units
    record = units.triangle_test.record
    volumes = {"bvh2": lambda: box_volumes(record, units.box_test), "bvh2_sphere": lambda: sphere_volumes(record),
               "bvh2_kdop": lambda: kdop_volumes(record)}[accel.name]()
    kernel = make_enter_kernel(volumes)
    load_kernel(kernel, accel.device)
    data = accel.structure.struct()
    nodes = accel.built.arrays["nodes"]
    data.nodes = upload(nodes[:: max(len(nodes) // TESTED_NODES, 1)][:TESTED_NODES].copy(), volumes.node, accel.device)
    if accel.name == "bvh2_kdop":
        data.middle = accel.data.middle
    n = min(TESTED_RAYS, len(rays))
    some = rays_on(accel.device, rays_of(rays.origins[:n], rays.directions[:n], 0.0, rays.t_max[:n]))
    inputs = [data, some, wp.zeros(n, dtype=wp.int32, device=accel.device)]

    def test() -> int:
        launch_on(accel.device, kernel, n, *inputs)
        return n * 2 * len(data.nodes)

    return test


def columns(row: Row) -> Columns:
    return BUILDERS if "builder" in vars(row) else VOLUME


def line(row: Row) -> str:
    return f"{row.mesh}: {'  '.join(cells(columns(row), row))}"


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    return [tabled(kind, [row for row in group if columns(row) is kind], f"{mesh}, {n} triangles")
            for (mesh, n), group in grouped(rows, "mesh", "n_triangles").items() for kind in (BUILDERS, VOLUME)]


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    return {name: [row.as_dict() for row in rows if columns(row) is kind] for name, kind in (("builders", BUILDERS), ("volumes", VOLUME))}
