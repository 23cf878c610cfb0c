"""`python -m wrt bench peers`: compare wrt with other libraries (Embree, Open3D, trimesh, Warp, tinybvh) on the same rays and points."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from statistics import geometric_mean
from time import perf_counter, thread_time
from typing import Any, NamedTuple, cast

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import start
from wrt.core.threads import run_all, thread_count
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench import peer_points, peer_tiles
from wrt.lab.bench.accel import timing, warm_up
from wrt.lab.bench.instruction_sets import instruction_sets
from wrt.lab.bench.plot import bars
from wrt.lab.bench.rays import RAY_KINDS, RaySet, ray_sets
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, machine_line, mesh_name, tabled, versions
from wrt.lab.bench.timing import alternate_on, spread, with_seconds
from wrt.lab.hard_cases import tinybvh
from wrt.lab.hard_cases.contestants import RIVALS, Algorithm, Own, Peer
from wrt.lab.plans import Peers as Plan
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

KINDS = {"primary": "primary rays", "shadow": "any hit: shadow rays", "diffuse": "bounce: diffuse rays", "random": "random rays",
         "points": "closest points", "tiles": "64x64 pixels in many worlds"}


def chart(rows: Sequence[Row], plan: Plan, machine: str, suffix: str) -> bytes:
    """Return a picture: a panel for each kind of ray, a bar for each library in its best mode; fewest threads, geometric means over the
    meshes."""
    fewest = min(row.threads for row in rows)
    best: dict[tuple[str, str], list[float]] = {}
    used = [row for row in rows if row.threads == fewest]
    for (_, _, kind, library), modes in grouped(used, "mesh", "triangles", "kind", "library").items():
        best.setdefault((kind, library), []).append(min(row.ns for row in modes))
    panels: dict[str, dict[str, float]] = {}
    for (kind, library), each in best.items():
        panels.setdefault(KINDS[kind], {})[library] = geometric_mean(each)
    where = f"{fewest} thread{'s' if fewest > 1 else ''}" if plan.device == "cpu" else plan.device
    return bars(panels, f"Nanoseconds a ray or point; {where}; less is better", suffix)


SAME_T = 1e-4  # largest relative difference of t at which two triangles are a tie
PARTS = 4  # parts of the rays for each thread, if a library uses one thread a call
TITLE = "wrt and other libraries"
COLUMNS: Columns = {"rays": "{kind}", "threads": "{threads}", "hit": "{hit:.0%}", "library": "{name}", "ns/ray": "{ns:.3g}",
                    "Mray/s": lambda row: spread(row.mrays), "wrt / library": "{first_over_it:.2f}", "differ": "{differ} of {rays}"}
LEGEND = """\
ns/ray, Mray/s: the thread's CPU seconds and the rays (wall-clock seconds for several threads and for a GPU), medians of alternating runs;
quartiles in brackets. A run on a GPU is 10 calls and one wait. Rays and results are in each library's own arrays. If a library runs on one
thread, each thread calls it with parts of the rays. wrt / library: speed of the table's first structure over the library's, median of the
ratios run by run. differ: rays that hit in one library and miss in the other, or hit different primitives at t that differ by more than
1e-4 relative. Any-hit rays (shadow) differ if one library says occluded and the other does not. points: closest points; distances differ
by more than 1e-4 relative. tiles: 64x64 primary rays in each of many worlds of 3,202 triangles. best mode: the fastest of a library's
modes for each mesh."""
WRITERS = {".svg": chart, ".png": chart}


def groups(plan: Plan) -> Groups:
    for mesh in map(as_mesh, plan.meshes or [icosphere(5)]):
        ready = cache(partial(prepared, plan, Geometry.of(mesh)))
        for kind in (kind for kind in RAY_KINDS if kind in plan.kinds):
            for threads in thread_counts(plan):
                yield partial(rows_on, [mesh], partial(ray_rows, plan, ready, kind, threads))
        for threads in thread_counts(plan) if "points" in plan.kinds else ():
            yield partial(rows_on, [mesh], partial(point_rows, plan, Geometry.of(mesh), threads))
    if "tiles" in plan.kinds:
        worlds = peer_tiles.small_worlds(plan.worlds, plan.seed)
        for threads in thread_counts(plan):
            yield partial(rows_on, worlds, partial(tile_rows, plan, worlds, threads))


def rows_on(meshes: Sequence[Mesh], measure: Callable[[], Iterator[dict[str, object]]]) -> list[Row]:
    name = mesh_name(meshes[0]) if len(meshes) == 1 else f"{len(meshes)} worlds"
    return [Row(mesh=name, triangles=sum(len(mesh.faces) for mesh in meshes), **row) for row in measure()]


class Prepared(NamedTuple):
    """Libraries that have a mesh. seconds: time of each library to build its structure; rays: kind of ray -> rays."""

    algorithms: list[Algorithm]
    seconds: list[float]
    rays: dict[str, RaySet]


def prepared(plan: Plan, geometry: Geometry) -> Prepared:
    algorithms = contestants(plan)
    seconds = [with_seconds(partial(algorithm.prepare, geometry))[1] for algorithm in algorithms]
    return Prepared(algorithms, seconds, ray_sets(cast(Own, algorithms[0]).accel, plan.rays, plan.seed))


def ray_rows(plan: Plan, ready: Callable[[], Prepared], kind: str, threads: int) -> Iterator[dict[str, object]]:
    algorithms, seconds, sets = ready()
    for i, measured in enumerate(compared(algorithms, sets[kind], threads, plan.runs, plan.device)):
        name = algorithms[i].name
        yield {"kind": kind, "rays": len(sets[kind]), "name": name, "library": getattr(algorithms[i], "family", "") or name,
               "build": seconds[i], "threads": threads, **measured}


def contestants(plan: Plan) -> list[Algorithm]:
    out: list[Algorithm] = []
    for structure in dict.fromkeys(plan.structures):
        warm_up(structure)
        out.append(Own(structure=structure, device=plan.device))
        out[-1].name = f"wrt {ACCELERATORS[structure].name}"
    rivals = list(dict.fromkeys(plan.rivals)) or [name for name, peer in RIVALS.items() if is_usable(peer, plan)]
    return [*out, *(mode for rival in rivals for mode in RIVALS[rival].modes(plan.device)),
            *(tinybvh.trees(Path(plan.tinybvh)) if plan.tinybvh is not None else [])]


def is_usable(peer: type[Peer], plan: Plan) -> bool:
    return peer.is_installed() and (peer.on_gpu or plan.device == "cpu")


def thread_counts(plan: Plan) -> list[int]:
    return sorted({"one": {1}, "all": {thread_count(None)}, "both": {1, thread_count(None)}}[plan.threads]) if plan.device == "cpu" else [1]


def compared(algorithms: Sequence[Algorithm], rays: RaySet, threads: int, runs: int, device: str = "cpu") -> Iterator[dict[str, object]]:
    """Yield the figures of each library for the same rays.
    - hit: share of rays that hit, by the first library; differ: number of rays whose answer is not the first library's."""
    searches = [searching(algorithm, rays, threads) for algorithm in algorithms]
    answers = [answer(algorithm, rays, search()) for algorithm, search in zip(algorithms, searches, strict=True)]
    hit = float(np.mean(answers[0].prim_id >= 0 if isinstance(answers[0], Hits) else answers[0]))
    for i, measured in enumerate(timed(searches, len(rays), threads, runs, device)):
        yield {"hit": hit, **measured, "differ": differing(answers[i], answers[0])}


def timed(works: Sequence[Callable[[], object]], n: int, threads: int, runs: int, device: str) -> Iterator[dict[str, object]]:
    """Run these functions, each of which answers n queries, by turns; yield the figures of each.
    seconds: time of each run, CPU time for one thread, and wall-clock time for several threads or a GPU (of one of QUEUE calls)."""
    jobs = dict(enumerate(works))
    seconds = alternate_on(start(device), jobs, runs, thread_time if threads == 1 and device == "cpu" else perf_counter)
    for i in jobs:
        yield {**timing(n, seconds[i], seconds[0]), "ns": 1e9 * float(np.median(seconds[i])) / n,
               "first_over_it": float(np.median(seconds[i] / seconds[0]))}


def point_rows(plan: Plan, geometry: Geometry, threads: int) -> Iterator[dict[str, object]]:
    """Yield the figures of each library that finds closest points."""
    points = peer_points.points_around(geometry, plan.rays, plan.seed)
    chosen = [each for name, each in peer_points.LIBRARIES.items() if each.is_installed() and (each.on_gpu or plan.device == "cpu")
              and (name == "wrt" or not plan.rivals or name in plan.rivals)]
    libraries = [each for each in chosen if each.has_threads or threads == 1]
    made = [with_seconds(partial(each.prepare, geometry, plan.device)) for each in libraries]
    queries = [(peer_tiles.PeerQuery(each.name, partial(query, points, threads), np.asarray), seconds)
               for each, (query, seconds) in zip(libraries, made, strict=True)]
    return length_rows(plan, "points", len(points), threads, queries)


def tile_rows(plan: Plan, worlds: Sequence[Mesh], threads: int) -> Iterator[dict[str, object]]:
    """Yield the figures of each library for a picture of each world."""
    rays = peer_tiles.tiles(len(worlds))
    queries = [with_seconds(make) for make in peer_tiles.libraries(worlds, rays, plan.device, threads)]
    return length_rows(plan, "tiles", len(rays.world), threads, queries)


def length_rows(plan: Plan, kind: str, n: int, threads: int,
                queries: Sequence[tuple[peer_tiles.PeerQuery, float]]) -> Iterator[dict[str, object]]:
    """Yield the figures of libraries for n lengths. queries: a query of each library, and the seconds to build its structure."""
    found = [query.found(query.work()) for query, _ in queries]
    hit = float(np.isfinite(found[0]).mean())
    for i, measured in enumerate(timed([query.work for query, _ in queries], n, threads, plan.runs, plan.device)):
        (name, _, _), build = queries[i]
        yield {"kind": kind, "rays": n, "name": name, "library": name.split(",")[0], "build": build, "threads": threads, "hit": hit,
               **measured, "differ": different_lengths(found[i], found[0])}


def searching(algorithm: Algorithm, rays: RaySet, threads: int) -> Callable[[], list[object]]:
    """Return a function that traces parts of the rays on `threads` threads, and returns the result of each part."""
    count = len(rays) if algorithm.has_threads or threads == 1 else max(-(-len(rays) // (PARTS * threads)), 1)
    searches = [algorithm.search(rays.part(slice(first, first + count)), threads if algorithm.has_threads else 1)
                for first in range(0, len(rays), count)]
    out: list[object] = [None] * len(searches)

    def search(i: int) -> None:
        out[i] = searches[i]()

    def all_parts() -> list[object]:
        run_all([partial(search, i) for i in range(len(searches))], threads)
        return out

    return all_parts


def answer(algorithm: Algorithm, rays: RaySet, out: list[object]) -> Hits | np.ndarray:
    """Return closest hits by a new query, or for any-hit rays flags of the occluded rays. out: result of the function from `searching`."""
    if rays.any_hit:
        return np.concatenate([algorithm.occluded(part) for part in out])
    return algorithm.closest(rays.origins, rays.directions, 0.0, rays.t_max)


def differing(found: Hits | np.ndarray, truth: Hits | np.ndarray) -> int:
    """Count the rays whose answers differ. Different primitives at t that agree within SAME_T are not a difference."""
    if isinstance(found, Hits) and isinstance(truth, Hits):
        hit, expected = found.prim_id >= 0, truth.prim_id >= 0
        both = hit & expected & (found.prim_id != truth.prim_id)
        apart = np.abs(np.where(both, found.t, 0.0) - np.where(both, truth.t, 0.0)) > SAME_T * np.where(both, truth.t, 1.0)
        return int(((hit != expected) | (both & apart)).sum())
    return int((np.asarray(found) != np.asarray(truth)).sum())


def different_lengths(found: np.ndarray, truth: np.ndarray) -> int:
    """Count the distances that differ by more than SAME_T relative; two infinite distances are equal."""
    return int((~np.isclose(found, truth, rtol=SAME_T, atol=0.0)).sum())


def machine(plan: Plan) -> str:
    if plan.tinybvh is not None:
        tinybvh.library(Path(plan.tinybvh))  # an error about it comes before the measurements
    missing = [peer.name for peer in RIVALS.values() if not peer.is_installed()]
    missing += [each.name for each in peer_points.LIBRARIES.values() if not each.is_installed()]
    used = f"{' and '.join(map(str, thread_counts(plan)))} threads used" if plan.device == "cpu" else ""
    found = versions("warp-lang", "embreex", "open3d", "open3d-cpu", "trimesh")
    found += f", tinybvh {tinybvh.version(Path(plan.tinybvh))}" if plan.tinybvh is not None else ""
    return machine_line(", ".join(filter(None, [instruction_sets() if plan.device == "cpu" else "", used])), found,
                        f"{plan.runs} alternating runs of {plan.rays} rays",
                        *([f"not installed: {', '.join(missing)}"] if missing and not plan.rivals and plan.device == "cpu" else []),
                        device=plan.device)


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    out, by_mesh = [], grouped(rows, "mesh", "triangles")
    for (mesh, triangles), group in by_mesh.items():
        built = ", ".join(dict.fromkeys(f"{row.name} {row.build:.2f} s" for row in group))
        out.append(tabled(COLUMNS, group, f"{mesh}, {triangles} triangles", f"Build time, wall clock: {built}."))
    kinds = list(dict.fromkeys(row.kind for row in rows))
    lines = [(name, *(f"{by_kind[kind]:.2f}" if kind in by_kind else "" for kind in kinds)) for name, by_kind in means(rows).items()]
    title = f"Geometric means over {len({row.mesh for row in rows if row.kind != 'tiles'})} meshes of wrt / library"
    return [*out, *([Part(title, "", ("library", *kinds), lines)] if lines else [])]


def means(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return library -> kind of ray -> geometric mean over the meshes of the first structure's speed over the library's speed."""
    out: dict[str, dict[str, float]] = {}
    for (name, threads, kind), group in grouped(rivals_of(rows), "name", "threads", "kind").items():
        logs = np.log([row.first_over_it for row in group])
        out.setdefault(name if threads == 1 else f"{name}, {threads} threads", {})[kind] = float(np.exp(np.mean(logs)))
    return out


def rivals_of(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of all but the first library of each comparison, and a further row for the best of a library's modes."""
    out: list[Row] = []
    for group in grouped(rows, "mesh", "triangles", "kind", "threads").values():
        out += group[1:]
        for (library,), modes in grouped(group[1:], "library").items():
            if len(modes) > 1:
                out.append(Row(**{**vars(min(modes, key=lambda row: row.first_over_it)), "name": f"{library}, best mode"}))
    return out


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, Any]:
    return {"means": means(rows)}
