"""`python -m wrt bench accel`: build time, memory and traversal time of every structure, on the same rays."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.core.errors import InputError
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.rays import RAY_KINDS, RaySet, mean_counters, ray_sets
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, machine_line, mesh_name, tabled
from wrt.lab.bench.report import run as run
from wrt.lab.bench.timing import alternate, peak_bytes, spread
from wrt.lab.bench.visibility import TERRAINS, terrain
from wrt.lab.plans import Accel as Plan
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere, merged

YARDSTICK = "bvh2"  # the structure whose answers all others are compared with
BRUTE_FORCE_TESTS = 200_000_000  # most ray-triangle tests of the comparison with brute force
COUNTED_RAYS = 20_000  # most rays whose traversal steps are counted
TITLE = "Structures"
COLUMNS: Columns = {
    "structure": "{structure}", "rays": "{kind}", "build ms": lambda row: f"{1e3 * row.build_median:.3g}",
    "B/triangle": "{bytes_per_triangle:.0f}",
    "peak B/triangle": lambda row: f"{row.peak_bytes / row.triangles:.0f}", "SAH cost": "{sah_cost:.3g}", "depth": "{depth}",
    "references/triangle": lambda row: f"{row.references / row.triangles:.2f}", "nodes/ray": "{nodes:.3g}", "boxes/ray": "{boxes:.3g}",
    "triangles/ray": "{primitives:.3g}", "Mray/s": lambda row: spread(row.mrays), "speed / first": "{over_first:.2f}",
    "differ": "{differ}", "wrong": "{wrong} of {checked}"}
REFUSED: Columns = {"structure": "{structure}", "mesh": "{mesh}", "reason": "{reason}"}
LEGEND = f"""\
build: median time of the builds, on all cores. B/triangle: bytes of the whole structure, triangles included. peak B/triangle: growth
of the process's memory at the first build. SAH cost: nodes and triangles that a random line through the root's box is expected to
visit. references: entries of all leaves. nodes/ray, boxes/ray, triangles/ray: nodes fetched, boxes and triangles tested, for a closest
hit. Mray/s: median of the alternating runs, quartiles in brackets. speed / first: median of the ratios to the first structure of the
table, run by run. differ: rays whose prim_id or t, bit for bit, is not that of {YARDSTICK}. wrong: rays whose answer is not that of
brute force, for as many rays as 2e8 tests allow. Both must be 0."""


def names(plan: Plan) -> list[str]:
    """Return the names of the structures to measure: plan.structures, or by default all of the registry but aliases and brute_force."""
    if plan.structures:
        return list(dict.fromkeys(plan.structures))
    return [name for name, cls in ACCELERATORS.items() if name == cls.name and name != "brute_force"]


def meshes(plan: Plan) -> Iterator[Mesh]:
    cells = (TERRAINS[0] * 2**k for k in range(14))
    yield from map(as_mesh, plan.meshes) if plan.meshes else map(terrain, takewhile(lambda n: 2 * n * n <= plan.max_triangles, cells))


def groups(plan: Plan) -> Groups:
    """For each mesh, yield the group of the structures that refuse it, then a group for each kind of ray."""
    for mesh in meshes(plan):
        ready = cache(partial(prepared, plan, mesh))
        yield partial(refused_rows, ready)
        for kind in (kind for kind in RAY_KINDS if kind in plan.kinds):
            yield partial(kind_rows, plan, ready, kind)


class Prepared(NamedTuple):
    """Structures over a mesh. facts: name -> fields of each of its rows; refused: rows with the reasons of the other structures;
    yardstick, brute_force: give the right answers."""

    accels: dict[str, Accelerator]
    facts: dict[str, dict[str, object]]
    refused: list[Row]
    rays: dict[str, RaySet]
    yardstick: Accelerator
    brute_force: Accelerator


def refused_rows(ready: Callable[[], Prepared]) -> list[Row]:
    return ready().refused


def prepared(plan: Plan, mesh: Mesh) -> Prepared:
    yardstick = build(Geometry.of(mesh), YARDSTICK)
    sets = ray_sets(yardstick, plan.rays, plan.seed)
    mesh = in_stadium(mesh) if plan.stadium else mesh
    where, geometry = mesh_name(mesh), Geometry.of(mesh)
    yardstick = build(geometry, YARDSTICK) if plan.stadium else yardstick
    n = len(geometry)
    built: dict[str, Accelerator] = {}
    facts: dict[str, dict[str, object]] = {}
    refused = []
    for name in names(plan):
        warm_up(name)
        try:
            first, peak = peak_bytes(partial(build, geometry, name))
            accels = [first, *(build(geometry, name) for _ in range(plan.builds - 1))]
        except InputError as error:
            refused.append(Row(mesh=where, structure=name, reason=str(error)))
            continue
        built[name], seconds, s = accels[-1], [accel.stats.build_seconds for accel in accels], accels[-1].stats
        facts[name] = {"mesh": where, "triangles": n, "structure": name, "build": seconds,
                       "build_median": float(np.median(seconds)), "peak_bytes": peak, "bytes_per_triangle": s.bytes / n,
                       "sah_cost": s.sah_cost, "depth": s.depth, "references": s.references}
    return Prepared(built, facts, refused, sets, yardstick, build(geometry, "brute_force"))


def kind_rows(plan: Plan, ready: Callable[[], Prepared], kind: str) -> list[Row]:
    """Return a row for each accepted structure."""
    mesh = ready()
    rays = mesh.rays[kind]
    checked = max(min(BRUTE_FORCE_TESTS // max(len(mesh.brute_force.geometry), 1), plan.rays), 1)
    truth = answer(mesh.yardstick, rays, None)
    few = rays.part(slice(None, None, max(len(rays) // checked, 1)))
    exact = answer(mesh.brute_force, few, None)
    counted = rays.part(slice(None, None, max(len(rays) // COUNTED_RAYS, 1)))
    timed = alternate({name: partial(answer, accel, rays, plan.threads) for name, accel in mesh.accels.items()}, plan.runs)
    return [Row(**mesh.facts[name], kind=rays.kind, rays=len(rays), checked=len(few),
                **mean_counters(accel, counted, nodes="nodes", boxes="boxes", primitives="primitives"),
                **timing(len(rays), timed[name], next(iter(timed.values()))),
                differ=differing(answer(accel, rays, None), truth), wrong=differing(answer(accel, few, None), exact))
            for name, accel in mesh.accels.items()]


def timing(rays: int, seconds: np.ndarray, first: np.ndarray) -> dict[str, object]:
    """Return seconds and Mray/s of each run, and the median speed over the first structure's. first: seconds of that structure's runs."""
    mrays = rays / seconds / 1e6
    return {"seconds": seconds.tolist(), "mrays": mrays.tolist(), "mrays_median": float(np.median(mrays)),
            "over_first": float(np.median(first / seconds))}


@cache
def warm_up(structure: str) -> None:
    """Compile the kernels of a structure's builder before a build is timed: build over a small sphere."""
    with suppress(InputError):  # a refusal is reported for the measured mesh
        build(Geometry.of(icosphere(3)), structure)


def answer(accel: Accelerator, rays: RaySet, threads: int | None) -> Hits | np.ndarray:
    if rays.any_hit:
        return accel.any_hit(rays.origins, rays.directions, 0.0, rays.t_max, threads)
    return accel.closest_hit(rays.origins, rays.directions, 0.0, rays.t_max, threads)


def differing(found: Hits | np.ndarray, truth: Hits | np.ndarray) -> int:
    """Count the rays whose closest hits differ from the truth in prim_id or in a bit of t, or whose any-hit answers differ."""
    if isinstance(found, Hits) and isinstance(truth, Hits):
        return int(((found.prim_id != truth.prim_id) | (found.t.view(np.int32) != truth.t.view(np.int32))).sum())
    return int((np.asarray(found) != np.asarray(truth)).sum())


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    """Return a table for each mesh, and a table of the structures that refused a mesh."""
    refused = [row for row in rows if "reason" in vars(row)]
    by_mesh = grouped((row for row in rows if row not in refused), "mesh", "triangles").items()
    return [*(tabled(COLUMNS, group, f"{mesh}, {triangles} triangles") for (mesh, triangles), group in by_mesh),
            *([tabled(REFUSED, refused, "Not built")] if refused else [])]


def machine(plan: Plan) -> str:
    return machine_line(f"{plan.threads} threads trace", f"{plan.runs} runs of {plan.rays} rays")


def line(row: Row) -> str:
    if "reason" in vars(row):
        return f"{row.mesh}: {row.structure}: {row.reason}"
    return f"{row.mesh}: {row.structure}, {row.kind} rays: {row.mrays_median:.3g} Mray/s, {row.differ} differ"


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    return {name: [row.as_dict() for row in rows if ("reason" in vars(row)) == refused]
            for name, refused in (("rows", False), ("refused", True))}


TIMES = 1000.0  # size of the stadium over that of the mesh


def stands(tiers: int = 50, seats: int = 400) -> Mesh:
    """Return a stadium of `2 + 4 * tiers * seats` triangles: a pitch at y = 0, and steps from radius 0.6 to 1 that rise to y = 0.25."""
    radius, height = np.linspace(0.6, 1.0, tiers + 1), np.linspace(0.0, 0.25, tiers + 1)
    r, y = np.repeat(radius, 2)[:-1], np.repeat(height, 2)[1:]
    angle = 2.0 * np.pi * np.arange(seats) / seats
    ring = np.stack([np.outer(r, np.cos(angle)), np.repeat(y[:, None], seats, axis=1), np.outer(r, np.sin(angle))], axis=-1)
    i, j = np.meshgrid(np.arange(len(r) - 1), np.arange(seats), indexing="ij")
    a, b = (i * seats + j).ravel(), (i * seats + (j + 1) % seats).ravel()
    faces = np.stack([a, b, b + seats, a, b + seats, a + seats], axis=1).reshape(-1, 3)
    pitch = np.array([[-0.6, 0.0, -0.6], [-0.6, 0.0, 0.6], [0.6, 0.0, 0.6], [0.6, 0.0, -0.6]])
    last = len(r) * seats
    return Mesh(np.concatenate([ring.reshape(-1, 3), pitch]),
                np.concatenate([faces, last + np.array([[0, 1, 2], [0, 2, 3]])]).astype(np.int32), name="stadium")


def in_stadium(mesh: Mesh, times: float = TIMES) -> Mesh:
    """Return the mesh on the pitch of a stadium that is `times` as large; the mesh's faces come first. No single cell size of a uniform
    grid suits both (Haines 1988, "Spline Surface Rendering, and What's Wrong with Octrees", Ray Tracing News 1(2))."""
    lo, hi = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    around = stands()
    scale = times * 0.5 * float(np.linalg.norm(hi - lo))
    place = np.array([0.5 * (lo[0] + hi[0]), lo[1], 0.5 * (lo[2] + hi[2])])
    return merged([mesh, Mesh(around.vertices * scale + place, around.faces)], f"{mesh.name} in a stadium")
