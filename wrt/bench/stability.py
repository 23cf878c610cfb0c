"""`python -m wrt stability`: the hard cases against the algorithms, speed beside error."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.base import Structure
from wrt.bench.algorithms import PEERS, Algorithm, Own, own_algorithms
from wrt.bench.hard_cases import HARD_CASES, HardCase, Verdict, chunks, generate, judge, judge_all_hits, judge_next
from wrt.device import load_kernel, upload
from wrt.errors import InputError
from wrt.kernels.query import HitList, RayArrays, Respawn, make_all_hits_kernel, make_respawn_kernel
from wrt.kernels.structs import Surfaces
from wrt.kernels.surface import make_surface_at
from wrt.kernels.traverse import Units

ALL_HITS_TESTS = 20_000_000  # ray-primitive tests that a case's all-hits check may take
ALL_HITS_RAYS = 2000
SPEED_RAYS, SPEED_RUNS = 200_000, 5


@dataclass
class Row:
    """One case with one algorithm. offset_self_hits: re-hits of the start triangle if only the offset kept rays off it.
    refused: for input that is not finite, whether the host said so."""

    case: str
    algorithm: str
    verdict: Verdict = field(default_factory=Verdict)
    offset_self_hits: int = 0
    refused: bool | None = None
    mrays: float = float("nan")
    bytes_per_triangle: float = float("nan")

    def as_dict(self) -> dict[str, Any]:
        return {"case": self.case, "algorithm": self.algorithm, "mrays_per_second": self.mrays,
                "bytes_per_triangle": self.bytes_per_triangle, "offset_self_hits": self.offset_self_hits,
                "refused": self.refused, **self.verdict.as_dict()}


def run(cases: Sequence[str], rays: int, *, peers: bool = False, seed: int = 0,
        report: Callable[[Row], None] | None = None) -> list[Row]:
    """Every case (names in HARD_CASES or letters of groups; an empty list is all) with every algorithm, `rays` rays each.

    The same rays for all. `report` is called with each row as it is done. Raises InputError for an unknown case.
    """
    names = chosen(cases)
    algorithms: list[Algorithm] = [*own_algorithms(), *(PEERS[name]() for name in PEERS if peers)]
    speeds = measure_speed(algorithms)
    rows = []
    for name in names:
        for algorithm in algorithms:
            row = run_case(name, rays, algorithm, seed)
            if row is None:
                continue
            row.mrays, row.bytes_per_triangle = speeds[algorithm.name]
            rows.append(row)
            if report is not None:
                report(row)
    return rows


def chosen(cases: Sequence[str]) -> list[str]:
    """Names of cases from names and letters of groups. Raises InputError where there is none of that name."""
    names: list[str] = []
    for case in cases or list(HARD_CASES):
        found = [name for name in HARD_CASES if name == case or name.split("_")[0] == case]
        if not found:
            raise InputError(f"no hard case {case!r}; there is {', '.join(HARD_CASES)}")
        names += found
    return names


def run_case(name: str, rays: int, algorithm: Algorithm, seed: int = 0) -> Row | None:
    """One case, in parts; None where the algorithm cannot take it (peers: spheres, and input that is not finite)."""
    row = Row(name, algorithm.name)
    for case in chunks(name, rays, seed):
        if case.refused:
            if algorithm.is_peer:
                return None
            row.refused = row.refused is not False and _is_refused(case, algorithm)
            continue
        if not algorithm.prepare(case.geometry):
            return None
        hits = algorithm.closest(case.origins, case.directions, case.t_min, case.t_max)
        row.verdict += judge(case, hits)
        if isinstance(algorithm, Own):
            if case.next_directions is not None:
                row.verdict += judge_next(case, *respawn(algorithm, case, exclude=True))
                row.offset_self_hits += judge_next(case, *respawn(algorithm, case, exclude=False)).self_hits
            if not len(case.geometry.spheres) and len(case.geometry) * ALL_HITS_RAYS <= ALL_HITS_TESTS:
                row.verdict += _judge_all(algorithm, case)
    return row


def _is_refused(case: HardCase, algorithm: Algorithm) -> bool:
    """Whether input that is not finite gives an InputError: rays by the query, vertices by Mesh."""
    from wrt.mesh import Mesh

    try:
        Mesh(case.geometry.vertices, case.geometry.faces)
        algorithm.prepare(case.geometry)
        algorithm.closest(case.origins, case.directions)
    except InputError:
        return True
    return False


def _surfaces(case: HardCase, device: Any) -> Any:
    geometry = case.geometry
    surfaces = Surfaces()
    surfaces.n_triangles = len(geometry.faces)
    surfaces.vertices = upload(geometry.vertices, wp.vec3, device)
    surfaces.faces = upload(geometry.faces, wp.vec3i, device)
    surfaces.spheres = upload(geometry.spheres, wp.vec4, device)
    surfaces.prim_material = wp.zeros(len(geometry), dtype=wp.int32, device=device)
    return surfaces


def _rays(case: HardCase, device: Any, rows: slice = slice(None)) -> Any:
    rays = RayArrays()
    rays.origin = upload(case.origins[rows], wp.vec3, device)
    rays.direction = upload(case.directions[rows], wp.vec3, device)
    rays.t_min, rays.t_max = upload(case.t_min[rows], wp.float32, device), upload(case.t_max[rows], wp.float32, device)
    return rays


@cache
def _respawn_kernel(structure: Structure) -> Any:
    surface_at = make_surface_at(structure.units.spheres, False, False, False)
    return make_respawn_kernel(structure.struct, structure.traversal(any_hit=False), surface_at)


def respawn(algorithm: Own, case: HardCase, *, exclude: bool) -> tuple[np.ndarray, np.ndarray]:
    """prim_id of each ray's hit, and of the ray that goes on from it towards case.next_directions."""
    accel, n = algorithm.accel, len(case)
    kernel = _respawn_kernel(accel.structure)
    load_kernel(kernel, accel.device)
    out = Respawn()
    assert case.next_directions is not None
    out.direction = upload(case.next_directions, wp.vec3, accel.device)
    out.exclude = int(exclude)
    out.first_prim_id, out.next_prim_id = (wp.empty(n, dtype=wp.int32, device=accel.device) for _ in range(2))
    wp.launch(kernel, dim=n, inputs=[accel.data, _surfaces(case, accel.device), _rays(case, accel.device), out, 0],
              device=accel.device)
    return out.first_prim_id.numpy(), out.next_prim_id.numpy()


@cache
def _all_hits_kernel(units: Units) -> Any:
    return make_all_hits_kernel(units)


def _judge_all(algorithm: Own, case: HardCase) -> Verdict:
    """All hits along the first ALL_HITS_RAYS rays; only what concerns duplicates is added to the case's verdict."""
    accel, n = algorithm.accel, min(len(case), ALL_HITS_RAYS)
    units = accel.structure.units
    out = HitList()
    out.capacity = max(64, len(case.geometry))
    out.count = wp.zeros(n, dtype=wp.int32, device=accel.device)
    out.prim_id = wp.zeros(n * out.capacity, dtype=wp.int32, device=accel.device)
    out.t = wp.zeros(n * out.capacity, dtype=wp.float32, device=accel.device)
    primitives = upload(case.geometry.primitives(units), units.triangle_test.record, accel.device)
    wp.launch(_all_hits_kernel(units), dim=n, device=accel.device,
              inputs=[primitives, _surfaces(case, accel.device), _rays(case, accel.device, slice(n)), out, 0])
    count = out.count.numpy()
    told = np.arange(out.capacity)[None, :] < count[:, None]
    part = HardCase(case.geometry, case.origins[:n], case.directions[:n], case.t_min[:n], case.t_max[:n], case.expected[:n],
                    closed=case.closed, name=case.name)
    prim_id, t = (array.numpy().reshape(n, -1)[told] for array in (out.prim_id, out.t))
    verdict = judge_all_hits(part, np.nonzero(told)[0], prim_id, t)
    return Verdict(duplicate_hits=verdict.duplicate_hits, examples=[e for e in verdict.examples if "twice" in e["why"]])


def measure_speed(algorithms: Sequence[Algorithm]) -> dict[str, tuple[float, float]]:
    """Mray/s on one thread (median of alternating runs) and bytes a triangle, on case A's sphere of 159,200 triangles."""
    case = generate("A_origin_uniform", SPEED_RAYS, seed=1)
    seconds: dict[str, list[float]] = {algorithm.name: [] for algorithm in algorithms}
    for algorithm in algorithms:
        algorithm.prepare(case.geometry)
        algorithm.closest(case.origins[:100], case.directions[:100])
    for _ in range(SPEED_RUNS):
        for algorithm in algorithms:
            begin = time.perf_counter()
            algorithm.closest(case.origins, case.directions)
            seconds[algorithm.name].append(time.perf_counter() - begin)
    return {a.name: (SPEED_RAYS / float(np.median(seconds[a.name])) / 1e6, a.bytes_per_triangle) for a in algorithms}


COLUMNS = ("case", "algorithm", "rays", "misses", "false hits", "wrong prim", "self-hits", "duplicates", "ties",
           "t ulp max", "t ulp 99.9 %", "t / bound", "Mray/s", "B/tri")


def cells(row: Row) -> tuple[str, ...]:
    """A row as text, in the order of COLUMNS."""
    v = row.verdict
    if row.refused is not None:
        said = "refused" if row.refused else "ACCEPTED"
        return (row.case, row.algorithm, said, *[""] * 9, f"{row.mrays:.2f}", f"{row.bytes_per_triangle:.0f}")
    return (row.case, row.algorithm, str(v.rays), *(str(n) for n in (v.misses, v.false_hits, v.wrong_prim, v.self_hits,
            v.duplicate_hits, v.ties)), f"{v.t.largest:.3g}", f"{v.t.percentile(99.9):.3g}", f"{v.t.largest_ratio:.2g}",
            f"{row.mrays:.2f}", f"{row.bytes_per_triangle:.0f}")


def markdown(rows: Sequence[Row]) -> str:
    """The table, after one summary line an algorithm."""
    lines = ["# Stability of the intersection tests", "", "Summed over the cases, with the speed on one thread beside it.", "",
             "| algorithm | rays | misses | false hits | wrong prim | self-hits | duplicates | t over bound | Mray/s | B/tri |",
             "| --- |" + " ---: |" * 9]
    for name in dict.fromkeys(row.algorithm for row in rows):
        mine = [row for row in rows if row.algorithm == name]
        v = sum((row.verdict for row in mine), Verdict())
        lines.append(f"| {name} | {v.rays} | {v.misses} | {v.false_hits} | {v.wrong_prim} | {v.self_hits} | {v.duplicate_hits} "
                     f"| {v.t.over} | {mine[0].mrays:.2f} | {mine[0].bytes_per_triangle:.0f} |")
    lines += ["", "| " + " | ".join(COLUMNS) + " |", "| --- | --- |" + " ---: |" * (len(COLUMNS) - 2)]
    lines += ["| " + " | ".join(cells(row)) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def check_report(path: Path) -> None:
    """Raise InputError where write_report could not write, before the work."""
    if path.suffix.lower() != ".md":
        raise InputError("the report is Markdown: use .md", path)
    if not path.parent.is_dir():
        raise InputError("no such folder", path.parent)


def write_report(rows: Sequence[Row], path: Path) -> None:
    """A Markdown file; written whole or not at all."""
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_text(markdown(rows))
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(f"cannot be written: {error.strerror}", path) from error
