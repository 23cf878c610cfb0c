"""`python -m wrt bench peers`: wrt's structures beside Embree and Warp's mesh_query_ray, the same rays in turn, on one or all threads."""

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

SAME_T = 1e-4  # relative: two triangles at the same t are a tie
PARTS = 4  # of the rays for each thread, if a library does not distribute them itself
TITLE = "wrt beside others"
COLUMNS: Columns = {"rays": "{kind}", "threads": "{threads}", "hit": "{hit:.0%}", "who": "{name}",
                    "Mray/s": lambda row: spread(row.mrays), "wrt / it": "{first_over_it:.2f}", "differ": "{differ}"}
LEGEND = """\
Mray/s: rays over the thread's CPU seconds (wall-clock seconds for several threads), median of the runs in turn, quartiles in brackets.
Rays and results are in each library's own arrays; each thread gets parts of the rays if a library runs on one thread. wrt / it: how
many times as fast the first structure of the table is, run by run. differ: rays that hit in one library and miss in the other, or hit
another primitive at a t that differs by more than 1e-4 of it; any-hit rays: another answer."""


def rows(plan: Plan) -> Iterator[Row]:
    rivals = list(dict.fromkeys(plan.rivals)) or [name for name, peer in PEERS.items() if peer.is_installed()]
    for mesh in map(as_mesh, plan.meshes or [icosphere(5)]):
        geometry, everybody, builds = Geometry.of(mesh), contestants(plan, rivals), []
        for who in everybody:
            begin = perf_counter()
            who.prepare(geometry)
            builds.append(perf_counter() - begin)
        for rays in ray_sets(cast(Own, everybody[0]).accel, plan.rays, plan.seed).values():
            for threads in thread_counts(plan) if rays.kind in plan.kinds else ():
                for i, measured in enumerate(compared(everybody, rays, threads, plan.runs)):
                    yield Row(mesh=mesh_name(mesh), triangles=len(mesh.faces), kind=rays.kind, rays=len(rays),
                              name=everybody[i].name, build=builds[i], threads=threads, **measured)


def contestants(plan: Plan, rivals: Sequence[str]) -> list[Algorithm]:
    out: list[Algorithm] = []
    for structure in dict.fromkeys(plan.structures):
        warm_up(structure)
        out.append(Own(structure=structure))
        out[-1].name = f"wrt {ACCELERATORS[structure].name}"
    return [*out, *(PEERS[rival]() for rival in rivals)]


def thread_counts(plan: Plan) -> list[int]:
    return sorted({"one": {1}, "all": {thread_count(None)}, "both": {1, thread_count(None)}}[plan.threads])


def compared(everybody: Sequence[Algorithm], rays: RaySet, threads: int, runs: int) -> Iterator[dict[str, object]]:
    """Yield what each library takes for the same rays.
    - hit: share of rays that hit, by the first library; differ: rays with another answer than the first library's.
    - seconds: CPU time of the thread in each run, or wall-clock time if there are several threads."""
    searches = [searching(who, rays, threads) for who in everybody]
    answers = [answer(who, rays, search()) for who, search in zip(everybody, searches, strict=True)]
    hit = float(np.mean(answers[0].prim_id >= 0 if isinstance(answers[0], Hits) else answers[0]))
    seconds = alternate(dict(enumerate(searches)), runs, thread_time if threads == 1 else perf_counter)
    for i, found in enumerate(answers):
        yield {"hit": hit, **timing(len(rays), seconds[i], seconds[0]),
               "first_over_it": float(np.median(seconds[i] / seconds[0])), "differ": differing(found, answers[0])}


def searching(who: Algorithm, rays: RaySet, threads: int) -> Callable[[], list[object]]:
    """Return a function that searches all parts of the rays and returns the results of the parts."""
    count = len(rays) if who.has_threads or threads == 1 else max(-(-len(rays) // (PARTS * threads)), 1)
    searches = [who.search(rays.part(slice(first, first + count)), threads if who.has_threads else 1)
                for first in range(0, len(rays), count)]
    out: list[object] = [None] * len(searches)

    def search(i: int) -> None:
        out[i] = searches[i]()

    def all_parts() -> list[object]:
        run_all([partial(search, i) for i in range(len(searches))], threads)
        return out

    return all_parts


def answer(who: Algorithm, rays: RaySet, out: list[object]) -> Hits | np.ndarray:
    """Return hits, or whether each any-hit ray is occluded. out: results of a search."""
    if rays.any_hit:
        return np.concatenate([who.occluded(part) for part in out])
    return who.closest(rays.origins, rays.directions, 0.0, rays.t_max)


def differing(found: Hits | np.ndarray, truth: Hits | np.ndarray) -> int:
    """Count the rays with another answer; another primitive at the same t is the same answer."""
    if isinstance(found, Hits) and isinstance(truth, Hits):
        hit, expected = found.prim_id >= 0, truth.prim_id >= 0
        both = hit & expected & (found.prim_id != truth.prim_id)
        apart = np.abs(np.where(both, found.t, 0.0) - np.where(both, truth.t, 0.0)) > SAME_T * np.where(both, truth.t, 1.0)
        return int(((hit != expected) | (both & apart)).sum())
    return int((np.asarray(found) != np.asarray(truth)).sum())


def machine(plan: Plan) -> str:
    return machine_line(f"{' and '.join(map(str, thread_counts(plan)))} used", versions("warp-lang", "embreex", "open3d"),
                        f"{plan.runs} runs of {plan.rays} rays by turns")


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    out, by_mesh = [], grouped(rows, "mesh", "triangles")
    for (mesh, triangles), group in by_mesh.items():
        built = ", ".join(dict.fromkeys(f"{row.name} {row.build:.2f} s" for row in group))
        out.append(tabled(COLUMNS, group, f"{mesh}, {triangles} triangles", f"Built by the clock: {built}."))
    kinds = list(dict.fromkeys(row.kind for row in rows))
    lines = [(name, *(f"{by_kind[kind]:.2f}" for kind in kinds)) for name, by_kind in means(rows).items()]
    return [*out, *([Part(f"Geometric means over {len(by_mesh)} meshes of wrt / it", "", ("who", *kinds), lines)] if lines else [])]


def means(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return the geometric mean over the meshes of how many times as fast the first structure is, by library and kind of ray."""
    first = rows[0].name if rows else ""
    out: dict[str, dict[str, float]] = {}
    for (name, threads, kind), group in grouped([row for row in rows if row.name != first], "name", "threads", "kind").items():
        logs = np.log([row.first_over_it for row in group])
        out.setdefault(name if threads == 1 else f"{name}, {threads} threads", {})[kind] = float(np.exp(np.mean(logs)))
    return out


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    return {"means": means(rows)}
