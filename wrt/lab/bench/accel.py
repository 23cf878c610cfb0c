"""`python -m wrt bench accel`: every structure on the same rays. What does it cost to build, to keep and to search?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from wrt.accel.answers import Hits
from wrt.accel.base import Accelerator
from wrt.accel.build import build
from wrt.accel.geometry import Geometry
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import thread_count
from wrt.core.errors import InputError
from wrt.core.html import Rows
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.peak_memory import peak_bytes
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.lab.bench.rays import RAY_KINDS, RaySet, ray_sets
from wrt.lab.bench.report import Part, check_plan, gathered, markdown, page, write
from wrt.lab.bench.report import machine as machine_line
from wrt.lab.bench.stadium import in_stadium
from wrt.lab.bench.timing import alternate, spread
from wrt.lab.bench.visibility import TERRAINS, fit, terrain
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

YARDSTICK = "bvh2"  # every ray is compared with it, and as many as BRUTE_FORCE_TESTS allow with brute force
BRUTE_FORCE_TESTS = 200_000_000
COUNTED_RAYS = 20_000
COLUMNS = ("structure", "rays", "build ms", "B/triangle", "peak B", "SAH", "depth", "refs", "nodes", "boxes", "triangles", "Mray/s",
           "/ first", "differ", "wrong")
REPORT = "accel.md"
AXES = {"accel-build.png": "microseconds of build a triangle", "accel-memory.png": "bytes a triangle",
        "accel-growth.png": "triangles"}
PLOTS = tuple(AXES)
LEGEND = f"""\
build: median of the builds, all cores. B/triangle: of the whole structure, triangles included; peak B: what the process grew by
at the first build, a triangle. SAH: expected nodes and triangles of a random line through the root, costing 1 each. refs:
primitives in all leaves over triangles. nodes, boxes, triangles: fetched and tested, a ray (closest hit). Mray/s: median of the
alternating runs, the middle half of them in brackets; / first: over that of the first structure of the table, run by run. differ:
rays with another prim_id or another bit of t than {YARDSTICK}, of all; wrong: the same against brute force, of as many rays as
2e8 tests allow. Both must be 0."""


@dataclass(frozen=True)
class Plan:
    """What to measure: meshes or their files (none: a terrain that grows up to max_triangles), structures (none: all but brute
    force), kinds of ray, rays of each kind, runs of each, builds of each; stadium: each mesh stands in a stadium a thousand times
    its size, and the rays are those that it has alone. Raises InputError."""

    meshes: Sequence[Mesh | str | Path] = ()
    structures: Sequence[str] = ()
    kinds: Sequence[str] = tuple(RAY_KINDS)
    rays: int = 100_000
    runs: int = 5
    builds: int = 1
    max_triangles: int = 1_000_000
    threads: int = 1
    seed: int = 0
    stadium: bool = False

    def __post_init__(self) -> None:
        check_plan(self, {"structure": (self.structures, ACCELERATORS), "kind of ray": (self.kinds, RAY_KINDS)},
                   rays=(1, 2**28), runs=(1, 1000), builds=(1, 100), max_triangles=(1000, 2**28))
        thread_count(self.threads)

    @property
    def names(self) -> list[str]:
        """Structures in the order of the registry, each once."""
        if self.structures:
            return list(dict.fromkeys(self.structures))
        return [name for name, cls in ACCELERATORS.items() if name == cls.name and name != "brute_force"]


@dataclass(frozen=True)
class Row:
    """One structure, mesh and kind of ray. build: seconds of each build; seconds: of each run over `rays` rays; nodes, boxes,
    primitives: fetched and tested, a ray (mean; of any-hit rays: as if the closest hit were asked); differ: rays whose prim_id or
    bits of t are not the yardstick's; checked, wrong: rays given to brute force, and those that it contradicts; peak_bytes: what
    the process grew by at the first build (NaN where the system does not tell)."""

    mesh: str
    triangles: int
    structure: str
    kind: str
    rays: int
    build: tuple[float, ...]
    bytes_per_triangle: float
    sah_cost: float
    depth: int
    references: int
    nodes: float
    boxes: float
    primitives: float
    seconds: tuple[float, ...]
    differ: int
    checked: int
    wrong: int
    peak_bytes: float = float("nan")

    @property
    def mrays(self) -> np.ndarray:
        """Million rays a second, run by run."""
        return self.rays / np.array(self.seconds) / 1e6

    def as_dict(self) -> dict[str, Any]:
        return asdict(self) | {"build_median": float(np.median(self.build)), "mrays_median": float(np.median(self.mrays))}


@dataclass(frozen=True)
class Refused:
    """A structure that cannot be built over a mesh, in its own words."""

    mesh: str
    structure: str
    reason: str


def meshes(plan: Plan) -> Iterator[Mesh]:
    yield from map(as_mesh, plan.meshes)
    if not plan.meshes:
        cells = [n for k in range(14) for n in [TERRAINS[0] * 2**k] if 2 * n * n <= plan.max_triangles]
        yield from map(terrain, cells)


def run(plan: Plan, report: Callable[[Row | Refused], None] | None = None) -> Rows[Row | Refused]:
    """Measure everything; `report` gets each row as it is done. Raises InputError (a file, a structure)."""
    rows = (row for mesh in meshes(plan) for row in _Bench(plan, mesh).rows())
    return Rows(gathered(rows, report), lambda rows: page(parts(rows)))


class _Bench:
    """One mesh, all structures, all kinds of ray."""

    def __init__(self, plan: Plan, mesh: Mesh) -> None:
        self.plan, alone = plan, build(Geometry.of(mesh), YARDSTICK)
        self.rays = {kind: rays for kind, rays in ray_sets(alone, plan.rays, plan.seed).items() if kind in plan.kinds}
        mesh = in_stadium(mesh) if plan.stadium else mesh
        self.name, self.geometry = Path(mesh.name or "mesh").name, Geometry.of(mesh)
        self.yardstick = build(self.geometry, YARDSTICK) if plan.stadium else alone
        self.checked = max(min(BRUTE_FORCE_TESTS // max(len(self.geometry), 1), plan.rays), 1)

    def rows(self) -> Iterator[Row | Refused]:
        built: dict[str, tuple[Accelerator, tuple[float, ...]]] = {}
        peaks: dict[str, float] = {}
        for name in self.plan.names:
            warm_up(name)
            try:
                first, peaks[name] = peak_bytes(partial(build, self.geometry, name))
                accels = [first, *(build(self.geometry, name) for _ in range(self.plan.builds - 1))]
            except InputError as error:
                yield Refused(self.name, name, str(error))
                continue
            built[name] = accels[-1], tuple(accel.stats.build_seconds for accel in accels)
        brute_force = build(self.geometry, "brute_force")
        for rays in self.rays.values():
            truth = answer(self.yardstick, rays, None)
            few = rays.part(slice(None, None, max(len(rays) // self.checked, 1)))
            exact = answer(brute_force, few, None)
            seconds = alternate({name: partial(answer, accel, rays, self.plan.threads) for name, (accel, _) in built.items()},
                                self.plan.runs)
            for name, (accel, build_seconds) in built.items():
                answers = (differing(answer(accel, rays, None), truth), len(few), differing(answer(accel, few, None), exact))
                yield replace(self._row(name, accel, build_seconds, rays, seconds[name], answers), peak_bytes=peaks[name])

    def _row(self, name: str, accel: Accelerator, build_seconds: tuple[float, ...], rays: RaySet, seconds: np.ndarray,
             answers: tuple[int, int, int]) -> Row:
        """answers: Row's differ, checked and wrong."""
        counted = rays.part(slice(None, None, max(len(rays) // COUNTED_RAYS, 1)))
        c = accel.closest_hit(counted.origins, counted.directions, 0.0, counted.t_max, counters=True).counters
        assert c is not None
        s, n = accel.stats, len(self.geometry)
        return Row(self.name, n, name, rays.kind, len(rays), build_seconds, s.bytes / n, s.sah_cost, s.depth, s.references,
                   float(c.nodes.mean()), float(c.boxes.mean()), float(c.primitives.mean()), tuple(seconds.tolist()), *answers)


@cache
def warm_up(structure: str) -> None:
    """Build it over a small ball, so that the kernels of its builder are compiled before a build is timed."""
    with suppress(InputError):  # where it refuses, the mesh that is asked about says why
        build(Geometry.of(icosphere(3)), structure)


def answer(accel: Accelerator, rays: RaySet, threads: int | None) -> Hits | np.ndarray:
    if rays.any_hit:
        return accel.any_hit(rays.origins, rays.directions, 0.0, rays.t_max, threads)
    return accel.closest_hit(rays.origins, rays.directions, 0.0, rays.t_max, threads)


def differing(found: Hits | np.ndarray, truth: Hits | np.ndarray) -> int:
    """Rays with another answer: prim_id or a bit of t, or where any hit was asked another yes or no."""
    if isinstance(found, Hits) and isinstance(truth, Hits):
        return int(((found.prim_id != truth.prim_id) | (found.t.view(np.int32) != truth.t.view(np.int32))).sum())
    return int((np.asarray(found) != np.asarray(truth)).sum())


def cells(row: Row, first: Row) -> tuple[str, ...]:
    """One line of the table, as COLUMNS names it."""
    return (row.structure, row.kind, f"{1e3 * float(np.median(row.build)):.3g}", f"{row.bytes_per_triangle:.0f}",
            f"{row.peak_bytes / row.triangles:.0f}", f"{row.sah_cost:.3g}", f"{row.depth}",
            f"{row.references / row.triangles:.2f}", f"{row.nodes:.3g}", f"{row.boxes:.3g}",
            f"{row.primitives:.3g}", spread(row.mrays), f"{np.median(row.mrays / first.mrays):.2f}", f"{row.differ}",
            f"{row.wrong} of {row.checked}")


def parts(rows: Sequence[Row | Refused]) -> list[Part]:
    """A table for each mesh, what was refused, and how costs grow."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        if isinstance(row, Row):
            groups.setdefault((row.mesh, row.triangles), []).append(row)
    out = []
    for (mesh, triangles), group in groups.items():
        first = {row.kind: row for row in reversed(group)}
        out.append(Part(f"{mesh}, {triangles} triangles", "", COLUMNS, [cells(row, first[row.kind]) for row in group]))
    refused = [(row.structure, row.mesh, row.reason) for row in rows if isinstance(row, Refused)]
    if refused:
        out.append(Part("Not built", "", ("structure", "mesh", "reason"), refused))
    grown = growth(rows)
    if grown:
        out.append(Part("As triangles grow", "seconds ~ n^exponent (± one standard deviation); times: last over first.",
                        ("structure", "mesh", "rays", "cost", "triangles", "exponent", "times"), [
                            (g["structure"], g["mesh"], g["kind"], g["cost"], f"{g['from']} to {g['to']}",
                             f"{g['exponent']:.3f} ± {g['error']:.3f}", f"{g['times']:.2f}") for g in grown]))
    return out


def growth(rows: Sequence[Row | Refused]) -> list[dict[str, Any]]:
    """How seconds a ray and seconds of the build grow with the triangles: exponents over meshes of one name, where there are three
    sizes or more."""
    out = []
    series: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        if isinstance(row, Row):
            series.setdefault((row.mesh, row.structure, row.kind), []).append(row)
    for (mesh, structure, kind), group in series.items():
        sizes = [row.triangles for row in group]
        if len(set(sizes)) < 3:
            continue
        costs = {"search": [float(np.median(row.seconds)) / row.rays for row in group],
                 "build": [float(np.median(row.build)) for row in group]}
        for cost, seconds in costs.items():
            found = fit(sizes, seconds)
            out.append({"mesh": mesh, "structure": structure, "kind": kind, "cost": cost, "from": min(sizes), "to": max(sizes),
                        "times": seconds[-1] / seconds[0], **asdict(found)})
    return out


def machine(plan: Plan) -> str:
    return machine_line(f"{plan.threads} used to search", f"{plan.runs} runs of {plan.rays} rays")


def line(row: Row | Refused) -> str:
    """For the progress."""
    if isinstance(row, Refused):
        return f"{row.mesh}: {row.structure}: {row.reason}"
    return f"{row.mesh}: {row.structure}, {row.kind} rays: {np.median(row.mrays):.3g} Mray/s, {row.differ} differ"


def text(rows: Sequence[Row | Refused], machine: str) -> str:
    """For the terminal."""
    return f"{machine}\n\n{markdown(parts(rows))}\n{LEGEND}"


def data(rows: Sequence[Row | Refused]) -> dict[str, object]:
    """For JSON."""
    return {"rows": [row.as_dict() for row in rows if isinstance(row, Row)],
            "refused": [vars(row) for row in rows if isinstance(row, Refused)], "growth": growth(rows)}


def plot(rows: Sequence[Row | Refused], name: str) -> LogLogPlot:
    """Time to build or memory against time to search (one point a mesh; the last kind of ray that was measured), or the cost of
    a ray as triangles grow."""
    kind = next((row.kind for row in reversed(rows) if isinstance(row, Row)), "")
    series: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if isinstance(row, Row) and row.kind == kind:
            search = float(np.median(row.seconds)) / row.rays * 1e6
            x = (float(np.median(row.build)) / row.triangles * 1e6, row.bytes_per_triangle, float(row.triangles))
            series.setdefault(row.structure, []).append((x[PLOTS.index(name)], search))
    lines = [Series(structure, sorted(points) if name == PLOTS[2] else points) for structure, points in series.items()]
    return LogLogPlot(f"Structures, {kind} rays", AXES[name], "microseconds a ray", lines)


def write_report(rows: Sequence[Row | Refused], plan: Plan, folder: Path, machine: str) -> list[Path]:
    """Markdown and plots; the paths. Raises InputError where the system refuses."""
    names = [Path(mesh.name if isinstance(mesh, Mesh) else mesh).name for mesh in plan.meshes]
    command = " ".join(["python -m wrt bench accel", *names, f"--rays {plan.rays}", f"--runs {plan.runs}",
                        f"--threads {plan.threads}"])
    text = f"# Structures\n\nMachine: {machine}\n\nTo repeat: `{command}`\n\n{LEGEND}\n\n"
    return write(folder / REPORT, text + markdown([*parts(rows), *(Part(plot=name) for name in PLOTS)]),
                 {name: plot(rows, name) for name in PLOTS})
