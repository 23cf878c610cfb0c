"""`python -m wrt bench queries`: compare structures of wrt, and other libraries, on the same rays and points."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from itertools import product
from statistics import geometric_mean
from time import perf_counter, thread_time
from typing import Any, NamedTuple

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import start
from wrt.core.threads import thread_count
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench import QUERY_KINDS
from wrt.lab.bench import Queries as Plan
from wrt.lab.bench.contestants import RAYS, RIVALS, Contestant, Own, contestant, installed
from wrt.lab.bench.rays import RaySet, counters_of, in_stadium, inward, points_around, ray_sets, small_worlds, terrain, tiles
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, machine_line, mesh_name, tabled, versions
from wrt.lab.bench.timing import alternate_on, spread, with_seconds
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

CELLS = 96  # a side of the default terrain
SAME_T = 1e-4  # largest relative difference of t at which two triangles are a tie
TESTS = 200_000_000  # most ray-triangle tests of the comparison with brute force
COUNTED_RAYS = 20_000  # most rays whose traversal steps are counted
COUNTED = {"nodes": "nodes", "leaves": "leaves", "boxes": "boxes", "primitives": "tests", "node_bytes": "node_bytes",
           "primitive_bytes": "triangle_bytes"}  # counter of a ray -> field of a row with its mean
TITLE = "Contestants on the same rays"


def known(column: str | Callable[[Row], str]) -> Callable[[Row], str]:
    """Return a column that is empty in rows without its fields."""

    def cell(row: Row) -> str:
        try:
            return column.format_map(vars(row)) if isinstance(column, str) else column(row)
        except (KeyError, AttributeError):
            return ""

    return cell


BUILT: Columns = {
    "contestant": "{name}", "build s": lambda row: f"{np.median(row.build):.3g}", "B/triangle": known("{bytes_per_triangle:.0f}"),
    "SAH cost": known("{sah_cost:.2f}"), "depth": known("{depth}"), "references/triangle": known("{references_per_triangle:.2f}")}
TRACED: Columns = {
    "contestant": "{name}", "queries": "{kind}", "threads": "{threads}", "hit": "{hit:.0%}", "ns/query": "{ns:.3g}",
    "Mquery/s": lambda row: spread(row.mrays), "time / first": lambda row: spread(row.ratios), "nodes": known("{nodes:.2f}"),
    "leaves": known("{leaves:.2f}"), "boxes": known("{boxes:.2f}"), "triangles": known("{tests:.2f}"),
    "B fetched": known("{bytes:.0f}"), "differ": "{differ}", "wrong": known("{wrong} of {checked}")}
LEGEND = f"""\
build: median time of the builds, on all cores. B/triangle: bytes of the structure, triangles included. SAH cost: nodes and triangles that
a random line through the root's box is expected to visit. references: entries of all leaves. ns/query, Mquery/s: the thread's CPU seconds
(wall-clock seconds for several threads and for a GPU), medians of alternating runs, with quartiles in brackets. A run on a GPU is 10
calls and one wait. Rays and results are in each library's own arrays. time / first: time over the first contestant's, run by run. nodes,
leaves, boxes, triangles, B fetched: visited, tested or read for a closest hit. differ: answers that are not the first contestant's: a hit
against a miss, or other primitives at t that differ by more than {SAME_T:g} relative. wrong: answers that are not those of brute force,
for as many rays as {TESTS:.0e} tests allow; of wrt's structures bit for bit. inward: lines that meet the mesh's box. points: closest
points; distances may differ by {SAME_T:g} relative. tiles: 64x64 primary rays in each of many worlds of 3,202 triangles. best: the
fastest of a library's modes for each mesh."""


class Prepared(NamedTuple):
    """A scene and its contestants. rays: kind of query -> its rays; geometry: of the mesh, or None for many worlds."""

    contestants: list[Contestant]
    rays: dict[str, RaySet]
    geometry: Geometry | None = None


def names_of(plan: Plan) -> list[str]:
    """Return the names of the contestants; by default bvh8, all other structures but brute_force, and the installed RIVALS."""
    structures = [name for name, kind in ACCELERATORS.items() if name == kind.name and name != "brute_force"]
    return list(dict.fromkeys(plan.contestants or ["bvh8", *structures, *installed(RIVALS, plan.device)]))


def groups(plan: Plan) -> Groups:
    """Yield a group for each mesh, kind of query and number of threads."""
    on_mesh = [kind for kind in QUERY_KINDS if kind in plan.rays and kind != "tiles"]
    for mesh in map(as_mesh, plan.meshes or [terrain(CELLS)]) if on_mesh else ():
        scene = in_stadium(mesh) if plan.stadium else mesh
        ready = cache(partial(with_mesh, plan, scene, mesh, on_mesh))
        for kind, threads in product(on_mesh, thread_counts(plan)):
            yield partial(kind_rows, plan, {"mesh": mesh_name(scene), "triangles": len(scene.faces)}, ready, kind, threads)
    if "tiles" in plan.rays:
        worlds = small_worlds(plan.worlds, plan.seed)
        ready = cache(partial(with_worlds, plan, worlds))
        subject = {"mesh": f"{plan.worlds} worlds", "triangles": sum(len(mesh.faces) for mesh in worlds)}
        for threads in thread_counts(plan):
            yield partial(kind_rows, plan, subject, ready, "tiles", threads)


def thread_counts(plan: Plan) -> list[int]:
    return sorted({"one": {1}, "all": {thread_count(None)}, "both": {1, thread_count(None)}}[plan.threads]) if plan.device == "cpu" else [1]


def with_mesh(plan: Plan, mesh: Mesh, alone: Mesh, kinds: Sequence[str]) -> Prepared:
    """Build every contestant over a mesh. alone: the mesh that the rays are made for."""
    geometry, of_rays = Geometry.of(mesh), Geometry.of(alone)
    rays: dict[str, RaySet] = ray_sets(build(of_rays, "bvh2"), plan.number, plan.seed)
    if "inward" in kinds:
        rays["inward"] = inward(of_rays, plan.number, plan.seed)
    if "points" in kinds:
        rays["points"] = points_around(of_rays, plan.number, plan.seed)
    out = Prepared([contestant(name, plan.device) for name in names_of(plan)], rays, geometry)
    for one in out.contestants:
        one.load(Geometry.of(icosphere(3)))  # compiles the builder's kernels
        one.facts = {"build": [built(one, geometry) for _ in range(plan.builds)]}
        if isinstance(one, Own):
            stats = one.accel.stats
            one.facts |= {"bytes_per_triangle": stats.bytes / len(geometry), "sah_cost": stats.sah_cost, "depth": stats.depth,
                          "references_per_triangle": stats.references / len(geometry)}
    return out


def built(one: Contestant, geometry: Geometry) -> float:
    """Build a contestant's structure; return the seconds, without those of compiling kernels."""
    _, seconds = with_seconds(partial(one.load, geometry))
    return float(one.accel.stats.build_seconds) if isinstance(one, Own) else seconds


def with_worlds(plan: Plan, worlds: Sequence[Mesh]) -> Prepared:
    """Build the structures of the contestants that can answer tiles."""
    chosen = [one for one in (contestant(name, plan.device) for name in names_of(plan)) if "tiles" in one.queries]
    for one in chosen:
        one.facts = {"build": [with_seconds(partial(one.load_worlds, worlds))[1]]}
    return Prepared(chosen, {"tiles": tiles(len(worlds))})


def kind_rows(plan: Plan, subject: dict[str, Any], ready: Callable[[], Prepared], kind: str, threads: int) -> list[Row]:
    """Return a row for each contestant that answers this kind of query."""
    scene = ready()
    rays, query = scene.rays[kind], {"shadow": "any", "points": "points", "tiles": "tiles"}.get(kind, "closest")
    chosen = [one for one in scene.contestants if query in one.queries and (one.has_threads or threads == 1)]
    searches = [one.search(rays, threads) for one in chosen]
    answers = [answer(one, rays, search()) for one, search in zip(chosen, searches, strict=True)]
    clock = thread_time if threads == 1 and plan.device == "cpu" else perf_counter
    seconds = alternate_on(start(plan.device), dict(enumerate(searches)), plan.runs, clock)
    out = []
    for i, one in enumerate(chosen):
        mrays, ratios = len(rays) / seconds[i] / 1e6, seconds[i] / seconds[0]
        row = Row(**subject, name=one.name, library=one.FAMILY or one.name, kind=kind, rays=len(rays), threads=threads,
                  hit=hit_share(answers[0]), seconds=seconds[i].tolist(), mrays=mrays.tolist(), ratios=ratios.tolist(),
                  ns=1e9 * float(np.median(seconds[i])) / len(rays), mrays_median=float(np.median(mrays)),
                  first_over_it=float(np.median(ratios)), differ=differing(answers[i], answers[0]), **one.facts)
        if scene.geometry is not None and query in RAYS:
            vars(row).update(wrong_answers(one, rays, scene.geometry))
            vars(row).update(steps(one, rays) if isinstance(one, Own) else {})
        out.append(row)
    return out


def answer(one: Contestant, rays: RaySet, out: object) -> Hits | np.ndarray:
    """Return closest hits by a new query, flags of the occluded rays, or distances. out: result of the function from one.search()."""
    if rays.any_hit or rays.kind in ("points", "tiles"):
        return one.result(out)
    return one.closest(rays.origins, rays.directions, 0.0, rays.t_max)


def hit_share(found: Hits | np.ndarray) -> float:
    return float(np.mean(found.prim_id >= 0 if isinstance(found, Hits) else found if found.dtype == bool else np.isfinite(found)))


def differing(found: Hits | np.ndarray, truth: Hits | np.ndarray, *, bits: bool = False) -> int:
    """Count the answers that differ. Different primitives at t that agree within SAME_T are not a difference.
    bits: every bit of prim_id and t counts."""
    if isinstance(found, Hits) and isinstance(truth, Hits):
        if bits:
            return int(((found.prim_id != truth.prim_id) | (found.t.view(np.int32) != truth.t.view(np.int32))).sum())
        hit, expected = found.prim_id >= 0, truth.prim_id >= 0
        both = hit & expected & (found.prim_id != truth.prim_id)
        apart = np.abs(np.where(both, found.t, 0.0) - np.where(both, truth.t, 0.0)) > SAME_T * np.where(both, truth.t, 1.0)
        return int(((hit != expected) | (both & apart)).sum())
    found, truth = np.asarray(found), np.asarray(truth)
    return int((found != truth).sum() if truth.dtype == bool else (~np.isclose(found, truth, rtol=SAME_T, atol=0.0)).sum())


def wrong_answers(one: Contestant, rays: RaySet, geometry: Geometry) -> dict[str, int]:
    """Compare some answers with those of brute force, which has the same intersection tests if the contestant is wrt's."""
    few = rays.part(slice(None, None, max(len(rays) * len(geometry) // TESTS, 1)))
    brute_force = Own("brute_force", one.device, **(one.units if isinstance(one, Own) else {}))
    brute_force.prepare(geometry)
    found, truth = (answer(each, few, each.search(few, 1)()) for each in (one, brute_force))
    return {"checked": len(few), "wrong": differing(found, truth, bits=isinstance(one, Own))}


def steps(one: Own, rays: RaySet) -> dict[str, float]:
    """Return means over some rays of what a closest hit visits, tests and reads."""
    counters = counters_of(one.accel, rays.part(slice(None, None, max(len(rays) // COUNTED_RAYS, 1))))
    means = {field: float(getattr(counters, name).mean()) for name, field in COUNTED.items()}
    return means | {"bytes": means["node_bytes"] + means["triangle_bytes"]}


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    """Return two tables for each mesh, and means over the meshes."""
    out = []
    for (mesh, triangles), group in grouped(rows, "mesh", "triangles").items():
        first = [each[0] for each in grouped(group, "name").values()]
        out += [tabled(BUILT, first, f"{mesh}, {triangles} triangles"), tabled(TRACED, group)]
    kinds = list(dict.fromkeys(row.kind for row in rows))
    lines = [(name, *(f"{by_kind[kind]:.2f}" if kind in by_kind else "" for kind in kinds)) for name, by_kind in means(rows).items()]
    title = f"Geometric means over {len({row.mesh for row in rows if row.kind != 'tiles'})} meshes of time / first"
    return [*out, *([Part(title, "", ("contestant", *kinds), lines)] if lines else [])]


def means(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return contestant -> kind of query -> geometric mean over the meshes of its time over the first contestant's.
    A library of which several modes were measured also has a line for the best mode of each mesh."""
    others: list[Row] = []
    for group in grouped(rows, "mesh", "triangles", "kind", "threads").values():
        others += group[1:]
        for (library,), modes in grouped(group[1:], "library").items():
            if len(modes) > 1:
                others.append(Row(**{**vars(min(modes, key=lambda row: row.first_over_it)), "name": f"{library}, best"}))
    out: dict[str, dict[str, float]] = {}
    for (name, threads, kind), group in grouped(others, "name", "threads", "kind").items():
        ratio = geometric_mean([row.first_over_it for row in group])
        out.setdefault(name if threads == 1 else f"{name}, {threads} threads", {})[kind] = ratio
    return out


def line(row: Row) -> str:
    return f"{row.mesh}: {row.name}, {row.kind}, {row.threads} threads: {row.ns:.3g} ns, {row.differ} differ"


def machine(plan: Plan) -> str:
    used = f"{' and '.join(map(str, thread_counts(plan)))} threads used" if plan.device == "cpu" else ""
    return machine_line(used, versions("warp-lang", "embreex", "open3d", "open3d-cpu", "trimesh"),
                        f"{plan.runs} alternating runs of {plan.number} rays", device=plan.device)


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, Any]:
    return {"means": means(rows)}
