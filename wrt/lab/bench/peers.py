"""`python -m wrt bench peers`: wrt's structures beside Embree (robust and fast) and Warp's mesh_query_ray; the same rays by
turns, on one thread and on all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np

from wrt.accel.answers import Hits
from wrt.accel.base import Accelerator
from wrt.accel.build import build
from wrt.accel.geometry import Geometry
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import load_kernel, run_all, thread_count
from wrt.core.errors import InputError
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.accel import warm_up
from wrt.lab.bench.rays import RAY_KINDS, RaySet, ray_sets
from wrt.lab.bench.report import Part, check_plan, gathered, markdown
from wrt.lab.bench.report import machine as machine_line
from wrt.lab.bench.timing import alternate, spread
from wrt.lab.hard_cases.contestants import PEERS, Embree, Open3D, Peer, WarpMesh
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

SAME_T = 1e-4  # two triangles may meet a ray at the same place: another prim_id there is a tie
THREADS = ("one", "all", "both")
PARTS = 4  # a thread: into so many are rays cut for libraries that do not share them out themselves
COLUMNS = ("rays", "threads", "hit", "who", "Mray/s", "wrt / it", "differ")
LEGEND = """\
Mray/s: rays over the thread's CPU seconds (the clock's, where there are more threads), median of the runs by turns, the middle half
of them in brackets; rays and results are in each library's own arrays, and each thread has parts of the rays where a library takes
them on one. wrt / it: how many times as fast the first structure of the table is, run by run. differ: rays of which one says hit
and the other miss, or another primitive at another t (more than 1e-4 of it away); any-hit rays: another yes or no."""


@dataclass(frozen=True)
class Plan:
    """What to measure: mesh files (none: a sphere); structures of wrt, the first of which ratios are of; rivals (none: those that
    are installed); kinds of ray, rays of each kind, runs of each; on one thread, on all there are, or both. Raises InputError."""

    meshes: Sequence[str | Path] = ()
    structures: Sequence[str] = ("bvh",)
    rivals: Sequence[str] = ()
    kinds: Sequence[str] = tuple(RAY_KINDS)
    rays: int = 100_000
    runs: int = 7
    seed: int = 0
    threads: str = "both"

    def __post_init__(self) -> None:
        check_plan(self, {"structure": (self.structures, ACCELERATORS), "rival": (self.rivals, PEERS),
                          "kind of ray": (self.kinds, RAY_KINDS)}, rays=(1, 2**28), runs=(1, 1000))
        for name in self.rivals:
            if not PEERS[name].is_installed():
                raise InputError(f'{name} is not installed: pip install "wrt[peers]"')
        if not self.structures:
            raise InputError("structures must name one or more")
        if self.threads not in THREADS:
            raise InputError(f"threads must be {', '.join(THREADS)}, got {self.threads!r}")

    @property
    def chosen(self) -> list[str]:
        return list(dict.fromkeys(self.rivals)) or [name for name, peer in PEERS.items() if peer.is_installed()]

    @property
    def counts(self) -> list[int]:
        """Numbers of threads."""
        return sorted({1, thread_count(None)} if self.threads == "both" else {1 if self.threads == "one" else thread_count(None)})


@dataclass(frozen=True)
class Row:
    """One contestant, mesh and kind of ray. hit: share of the rays that hit; build: seconds, by the clock; seconds: the thread's
    CPU time of each run over `rays` rays, or the clock's where there are more threads; differ: rays with another answer than the
    first structure's."""

    mesh: str
    triangles: int
    kind: str
    rays: int
    hit: float
    name: str
    build: float
    seconds: tuple[float, ...]
    differ: int
    threads: int = 1

    @property
    def mrays(self) -> np.ndarray:
        """Million rays a second, run by run."""
        return self.rays / np.array(self.seconds) / 1e6

    def as_dict(self) -> dict[str, Any]:
        return asdict(self) | {"mrays_median": float(np.median(self.mrays))}


class Own:
    """A structure of wrt. search: the work that is timed, as a function of no argument, with rays and results in arrays of the
    library's own kind; told: its result as hits, or as yes or no for any-hit rays."""

    def __init__(self, name: str, geometry: Geometry) -> None:
        self.name = f"wrt {ACCELERATORS[name].name}"
        warm_up(name)
        begin = perf_counter()
        self.accel: Accelerator = build(geometry, name, threads=1)
        self.build = perf_counter() - begin

    def search(self, rays: RaySet, threads: int) -> Callable[[], Any]:
        import warp as wp

        device = self.accel.device
        origins, directions = (wp.array(a, dtype=wp.vec3, device=device) for a in (rays.origins, rays.directions))
        t_max = wp.array(rays.t_max, dtype=wp.float32, device=device)
        ask = self.accel.any_hit if rays.any_hit else self.accel.closest_hit
        return lambda: ask(origins, directions, 0.0, t_max, threads=threads)

    def told(self, rays: RaySet, out: Any) -> Hits | np.ndarray:
        return np.asarray(out.numpy()) if rays.any_hit else Hits(*(getattr(out, f).numpy() for f in ("t", "u", "v", "prim_id")))


class Rival:
    """A library of wrt.lab.hard_cases.contestants; search and told as for Own."""

    def __init__(self, peer: Peer, geometry: Geometry) -> None:
        self.peer, self.name = peer, peer.name
        begin = perf_counter()
        peer.prepare(geometry)
        if isinstance(peer, Embree):  # it builds when it is first asked
            peer.closest(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
        self.build = perf_counter() - begin

    def search(self, rays: RaySet, threads: int) -> Callable[[], list[Any]]:
        """Gives the results of the parts of the rays, one after another."""
        if isinstance(self.peer, Open3D):
            return self._search_part(rays, threads)
        count = len(rays) if threads == 1 else max(-(-len(rays) // (PARTS * threads)), 1)
        searches = [self._search_part(rays.part(slice(first, first + count)), 1) for first in range(0, len(rays), count)]
        out: list[Any] = [None] * len(searches)

        def search(i: int) -> None:
            out[i] = searches[i]()[0]

        def all_parts() -> list[Any]:
            run_all([partial(search, i) for i in range(len(searches))], threads)
            return out

        return all_parts

    def _search_part(self, rays: RaySet, threads: int) -> Callable[[], list[Any]]:
        peer, o, d = self.peer, np.ascontiguousarray(rays.origins), np.ascontiguousarray(rays.directions)
        if isinstance(peer, Embree):
            if rays.any_hit:
                return lambda: [peer.scene.run(o, d, dists=rays.t_max, query="OCCLUDED")]
            return lambda: [peer.scene.run(o, d, query="INTERSECT")]
        if isinstance(peer, WarpMesh):
            return _warp_search(peer, rays)
        assert isinstance(peer, Open3D)
        bundle = peer.tensor(np.concatenate([o, d], axis=1))
        if rays.any_hit:
            return lambda: [peer.scene.test_occlusions(bundle, tnear=0.0, tfar=1.0, nthreads=threads)]
        return lambda: [peer.scene.cast_rays(bundle, nthreads=threads)]

    def told(self, rays: RaySet, out: list[Any]) -> Hits | np.ndarray:
        if not rays.any_hit:
            return self.peer.closest(rays.origins, rays.directions, 0.0, rays.t_max)
        if isinstance(self.peer, Embree):
            return np.concatenate(out) >= 0
        return np.concatenate([part.numpy() for part in out]).astype(bool)


def _warp_search(peer: WarpMesh, rays: RaySet) -> Callable[[], list[Any]]:
    """Warp wants unit directions, and its any-hit query a length beside them."""
    import warp as wp

    from wrt.kernels.study.peers import warp_mesh_any, warp_mesh_query

    n, device = len(rays), peer.device
    length = np.linalg.norm(rays.directions.astype(np.float64), axis=1)
    o, d = (wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (rays.origins, rays.directions / length[:, None]))
    reach = wp.array(np.minimum(rays.t_max * length, 1e38).astype(np.float32), dtype=wp.float32, device=device)
    load_kernel(warp_mesh_any if rays.any_hit else warp_mesh_query, device)

    def any_hit() -> list[Any]:
        dark = wp.empty(n, dtype=wp.bool, device=device)
        wp.launch(warp_mesh_any, dim=n, inputs=[peer.mesh.id, o, d, reach, dark], device=device)
        return [dark]

    def closest() -> list[Any]:
        t, u, v = (wp.empty(n, dtype=wp.float32, device=device) for _ in range(3))
        prim_id = wp.empty(n, dtype=wp.int32, device=device)
        wp.launch(warp_mesh_query, dim=n, inputs=[peer.mesh.id, o, d, t, u, v, prim_id], device=device)
        return [prim_id]

    return any_hit if rays.any_hit else closest


def differing(found: Hits | np.ndarray, truth: Hits | np.ndarray) -> int:
    """Rays with another answer; another primitive at the same t is none."""
    if isinstance(found, Hits) and isinstance(truth, Hits):
        hit, expected = found.prim_id >= 0, truth.prim_id >= 0
        both = hit & expected & (found.prim_id != truth.prim_id)
        apart = np.abs(np.where(both, found.t, 0.0) - np.where(both, truth.t, 0.0)) > SAME_T * np.where(both, truth.t, 1.0)
        return int(((hit != expected) | (both & apart)).sum())
    return int((np.asarray(found) != np.asarray(truth)).sum())


def meshes(plan: Plan) -> Iterator[Mesh]:
    yield from map(as_mesh, plan.meshes)
    if not plan.meshes:
        yield icosphere(5)


def run(plan: Plan, report: Callable[[Row], None] | None = None) -> list[Row]:
    """Measure everything; `report` gets each row as it is done. Raises InputError (a file, a structure)."""
    return gathered((row for mesh in meshes(plan) for row in _mesh_rows(plan, mesh)), report)


def _mesh_rows(plan: Plan, mesh: Mesh) -> Iterator[Row]:
    geometry, name = Geometry.of(mesh), Path(mesh.name or "mesh").name
    own = [Own(structure, geometry) for structure in dict.fromkeys(plan.structures)]
    everybody: list[Own | Rival] = [*own, *(Rival(PEERS[rival](), geometry) for rival in plan.chosen)]
    for kind, rays in ray_sets(own[0].accel, plan.rays, plan.seed).items():
        for threads in plan.counts if kind in plan.kinds else ():
            yield from _measured((name, len(mesh.faces)), everybody, rays, threads, plan.runs)


def _measured(mesh: tuple[str, int], everybody: Sequence[Own | Rival], rays: RaySet, threads: int, runs: int) -> Iterator[Row]:
    searches = [who.search(rays, threads) for who in everybody]
    told = [who.told(rays, search()) for who, search in zip(everybody, searches, strict=True)]
    hit = float((told[0].prim_id >= 0).mean() if isinstance(told[0], Hits) else np.mean(told[0]))
    seconds = alternate(dict(enumerate(searches)), runs, thread_time if threads == 1 else perf_counter)
    for i, who in enumerate(everybody):
        yield Row(*mesh, rays.kind, len(rays), hit, who.name, who.build, tuple(seconds[i].tolist()), differing(told[i], told[0]),
                  threads)


def groups(rows: Sequence[Row]) -> list[list[Row]]:
    """Rows of the same rays on as many threads, in their order; the first is what ratios are of."""
    found: dict[tuple[str, int, str, int], list[Row]] = {}
    for row in rows:
        found.setdefault((row.mesh, row.triangles, row.kind, row.threads), []).append(row)
    return list(found.values())


def ratio(first: Row, other: Row) -> float:
    """How many times as fast the first one is: median over the runs."""
    return float(np.median(np.array(other.seconds) / np.array(first.seconds)))


def means(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Of each rival (and its threads, where they are several) and kind of ray: the geometric mean over the meshes of how many
    times as fast the first structure is."""
    logs: dict[str, dict[str, list[float]]] = {}
    for group in groups(rows):
        for row in group[1:]:
            name = row.name if row.threads == 1 else f"{row.name}, {row.threads} threads"
            logs.setdefault(name, {}).setdefault(row.kind, []).append(np.log(ratio(group[0], row)))
    return {name: {kind: float(np.exp(np.mean(values))) for kind, values in kinds.items()} for name, kinds in logs.items()}


def machine(plan: Plan) -> str:
    from importlib.metadata import PackageNotFoundError, version

    versions = []
    for package in ("warp-lang", "embreex", "open3d"):
        with suppress(PackageNotFoundError):
            versions.append(f"{package} {version(package)}")
    return machine_line(f"{' and '.join(map(str, plan.counts))} used", ", ".join(versions),
                        f"{plan.runs} runs of {plan.rays} rays by turns")


def cells(row: Row, first: Row) -> tuple[str, ...]:
    """One line of the table, as COLUMNS names it."""
    return (row.kind, f"{row.threads}", f"{row.hit:.0%}", row.name, spread(row.mrays), f"{ratio(first, row):.2f}", f"{row.differ}")


def line(row: Row) -> str:
    """For the progress."""
    return f"{row.mesh}: {'  '.join(cells(row, row))}"


def text(rows: Sequence[Row], machine: str) -> str:
    """All tables as Markdown."""
    parts = [Part("", machine)]
    by_mesh: dict[tuple[str, int], list[list[Row]]] = {}
    for group in groups(rows):
        by_mesh.setdefault((group[0].mesh, group[0].triangles), []).append(group)
    for (mesh, triangles), parted in by_mesh.items():
        built = ", ".join(f"{row.name} {row.build:.2f} s" for row in parted[0])
        parts.append(Part(f"{mesh}, {triangles} triangles", f"Built by the clock: {built}.", COLUMNS,
                          [cells(row, group[0]) for group in parted for row in group]))
    kinds = list(dict.fromkeys(row.kind for row in rows))
    lines = [(name, *(f"{by_kind[kind]:.2f}" for kind in kinds)) for name, by_kind in means(rows).items()]
    if lines:
        parts.append(Part(f"Geometric means over {len(by_mesh)} meshes of wrt / it", "", ("who", *kinds), lines))
    return markdown([*parts, Part("", LEGEND)])


def data(rows: Sequence[Row]) -> dict[str, object]:
    """For JSON."""
    return {"rows": [row.as_dict() for row in rows], "means": means(rows)}
