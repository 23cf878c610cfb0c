"""`python -m wrt bench peers`: compare wrt's structures with Embree and Warp's mesh_query_ray on the same rays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from time import perf_counter, thread_time
from typing import cast

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.structures import ACCELERATORS
from wrt.core.threads import run_all, thread_count
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.accel import timing, warm_up
from wrt.lab.bench.rays import RaySet, ray_sets
from wrt.lab.bench.report import Columns, Part, Row, grouped, machine_line, mesh_name, tabled, versions
from wrt.lab.bench.timing import alternate, spread
from wrt.lab.hard_cases.contestants import PEERS, Algorithm, Own
from wrt.lab.plans import Peers as Plan
from wrt.scene.shapes import icosphere

SAME_T = 1e-4  # largest relative difference of t at which two triangles are a tie
PARTS = 4  # parts of the rays for each thread, if a library uses one thread a call
TITLE = "wrt and other libraries"
COLUMNS: Columns = {"rays": "{kind}", "threads": "{threads}", "hit": "{hit:.0%}", "library": "{name}",
                    "Mray/s": lambda row: spread(row.mrays), "wrt / library": "{first_over_it:.2f}", "differ": "{differ}"}
LEGEND = """\
Mray/s: rays over the thread's CPU seconds (over wall-clock seconds for several threads), median of alternating runs, quartiles in
brackets. Rays and results are in each library's own arrays. If a library runs on one thread, each thread calls it with parts of the
rays. wrt / library: speed of the table's first structure over the library's, median of the ratios run by run. differ: rays that hit in
one library and miss in the other, or hit different primitives at t that differ by more than 1e-4 relative. Any-hit rays differ if one
library says occluded and the other does not."""


def rows(plan: Plan) -> Iterator[Row]:
    rivals = list(dict.fromkeys(plan.rivals)) or [name for name, peer in PEERS.items() if peer.is_installed()]
    for mesh in map(as_mesh, plan.meshes or [icosphere(5)]):
        geometry, algorithms, builds = Geometry.of(mesh), contestants(plan, rivals), []
        for algorithm in algorithms:
            begin = perf_counter()
            algorithm.prepare(geometry)
            builds.append(perf_counter() - begin)
        for rays in ray_sets(cast(Own, algorithms[0]).accel, plan.rays, plan.seed).values():
            for threads in thread_counts(plan) if rays.kind in plan.kinds else ():
                for i, measured in enumerate(compared(algorithms, rays, threads, plan.runs)):
                    yield Row(mesh=mesh_name(mesh), triangles=len(mesh.faces), kind=rays.kind, rays=len(rays),
                              name=algorithms[i].name, build=builds[i], threads=threads, **measured)


def contestants(plan: Plan, rivals: Sequence[str]) -> list[Algorithm]:
    out: list[Algorithm] = []
    for structure in dict.fromkeys(plan.structures):
        warm_up(structure)
        out.append(Own(structure=structure))
        out[-1].name = f"wrt {ACCELERATORS[structure].name}"
    return [*out, *(PEERS[rival]() for rival in rivals)]


def thread_counts(plan: Plan) -> list[int]:
    return sorted({"one": {1}, "all": {thread_count(None)}, "both": {1, thread_count(None)}}[plan.threads])


def compared(algorithms: Sequence[Algorithm], rays: RaySet, threads: int, runs: int) -> Iterator[dict[str, object]]:
    """Yield the figures of each library for the same rays.
    - hit: share of rays that hit, by the first library; differ: number of rays whose answer is not the first library's.
    - seconds: time of each run, CPU time for one thread and wall-clock time for several threads."""
    searches = [searching(algorithm, rays, threads) for algorithm in algorithms]
    answers = [answer(algorithm, rays, search()) for algorithm, search in zip(algorithms, searches, strict=True)]
    hit = float(np.mean(answers[0].prim_id >= 0 if isinstance(answers[0], Hits) else answers[0]))
    seconds = alternate(dict(enumerate(searches)), runs, thread_time if threads == 1 else perf_counter)
    for i, found in enumerate(answers):
        yield {"hit": hit, **timing(len(rays), seconds[i], seconds[0]),
               "first_over_it": float(np.median(seconds[i] / seconds[0])), "differ": differing(found, answers[0])}


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


def machine(plan: Plan) -> str:
    return machine_line(f"{' and '.join(map(str, thread_counts(plan)))} threads used", versions("warp-lang", "embreex", "open3d"),
                        f"{plan.runs} alternating runs of {plan.rays} rays")


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    out, by_mesh = [], grouped(rows, "mesh", "triangles")
    for (mesh, triangles), group in by_mesh.items():
        built = ", ".join(dict.fromkeys(f"{row.name} {row.build:.2f} s" for row in group))
        out.append(tabled(COLUMNS, group, f"{mesh}, {triangles} triangles", f"Build time, wall clock: {built}."))
    kinds = list(dict.fromkeys(row.kind for row in rows))
    lines = [(name, *(f"{by_kind[kind]:.2f}" for kind in kinds)) for name, by_kind in means(rows).items()]
    title = f"Geometric means over {len(by_mesh)} meshes of wrt / library"
    return [*out, *([Part(title, "", ("library", *kinds), lines)] if lines else [])]


def means(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return library -> kind of ray -> geometric mean over the meshes of the first structure's speed over the library's speed."""
    first = rows[0].name if rows else ""
    out: dict[str, dict[str, float]] = {}
    for (name, threads, kind), group in grouped([row for row in rows if row.name != first], "name", "threads", "kind").items():
        logs = np.log([row.first_over_it for row in group])
        out.setdefault(name if threads == 1 else f"{name}, {threads} threads", {})[kind] = float(np.exp(np.mean(logs)))
    return out


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    return {"means": means(rows)}
