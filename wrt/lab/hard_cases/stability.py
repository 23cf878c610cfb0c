"""`python -m wrt stability`: run the hard cases on the intersection tests, and measure errors and speed."""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product

import numpy as np
import warp as wp

from wrt.accel.queries.all_hits import all_hits
from wrt.accel.structure import Structure
from wrt.core.device import launch_on, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.core.types import JsonObject, Kernel
from wrt.kernels.shade.surface import make_surface_at
from wrt.kernels.structs import Surfaces
from wrt.kernels.study.respawn import Respawn, make_respawn_kernel
from wrt.lab.bench.report import Columns
from wrt.lab.bench.report import Row as Line
from wrt.lab.bench.timing import alternate, quartiles
from wrt.lab.hard_cases.cases import UNKNOWN, HardCase, Verdict, check, chosen, chunks, fewer, generate, judge, judge_all_hits, judge_next
from wrt.lab.hard_cases.contestants import PEERS, Algorithm, Own, own_algorithms
from wrt.lab.plans import Stability as Plan
from wrt.renderer.progress import TimeLeft

ALL_HITS_TESTS = 20_000_000  # most ray-primitive tests of a case's all-hits check
ALL_HITS_RAYS = 2000  # rays of the all-hits check
SPEED_RAYS = 200_000
COMPARED = 2000  # hits of a case that the oracle compares with the closest hit, except for the default algorithm
CHUNK = 2**18  # rays beyond the sample at once

COLUMNS: Columns = {
    "case": "{case}", "algorithm": "{algorithm}",
    "rays": lambda row: {None: str(row.verdict.rays), True: "refused", False: "ACCEPTED"}[row.refused],
    **{head: partial(lambda form, row: form.format_map(vars(row)) if row.refused is None else "", form) for head, form in {
        "judged": "{judged}", "misses": "{verdict.misses}", "false hits": "{verdict.false_hits}", "wrong prim": "{verdict.wrong_prim}",
        "self-hits": "{verdict.self_hits}", "duplicates": "{verdict.duplicate_hits}", "ties": "{verdict.ties}",
        "near ties": "{verdict.near_ties}", "borderline": "{verdict.borderline}", "t ulp max": "{verdict.t.largest:.3g}",
        "t ulp 99.9 %": "{verdict.t.p999:.3g}", "t / bound": "{verdict.t.largest_ratio:.2g}"}.items()}}


@dataclass
class CaseRow:
    """Result of one case and algorithm. judged: rays that the oracle judged; refused: None for finite input, True if refused."""

    case: str
    algorithm: str
    verdict: Verdict = field(default_factory=Verdict)
    judged: int = 0
    refused: bool | None = None

    def as_dict(self) -> JsonObject:
        return {name: value for name, value in vars(self).items() if name != "verdict"} | self.verdict.as_dict()


class Result(Line):
    """Results of `run`. rows: a CaseRow for each case and algorithm; speed: algorithm -> result of `measure_speed`.
    - not_installed: names of missing libraries; undone: names of unfinished cases; interrupted: number of the signal that ended the run."""


def run(plan: Plan, report: Callable[[CaseRow], None] = lambda row: None, progress: Callable[[str], None] = lambda line: None) -> Result:
    """Run every chosen case with every algorithm, on the same rays.

    report: receives each finished row; progress: receives lines of text from any thread.
    After Ctrl-C, return the finished rows, or raise KeyboardInterrupt if no row is finished. Raise InputError for an unknown case."""
    begin, names, algorithms = time.perf_counter(), chosen(plan.cases), all_algorithms(plan)
    progress("measuring the speed")
    found = Result(rows=[], speed=measure_speed(algorithms, plan.runs), interrupted=None, undone=[],
                   not_installed=[peer.name for peer in PEERS.values() if plan.peers and not peer.is_installed()])
    left = TimeLeft(len(names) * len(algorithms))
    try:
        for name, algorithm in product(names, algorithms):
            progress(f"{left.done:.0f} of {left.total} rows are done; now {name}, {algorithm.name}{left}")
            row = run_case(name, fewer(name, min(plan.sample, plan.rays)), algorithm, plan.seed)
            if row is not None and algorithm is algorithms[0] and row.refused is None:
                row.verdict = sum(judge_further(name, plan, progress), row.verdict)
            left.done += 1
            if row is not None:
                found.rows.append(row)
                report(row)
    except KeyboardInterrupt as stop:
        if not found.rows:
            raise
        found.interrupted = int(getattr(stop, "number", signal.SIGINT))
        last = found.rows[-1]
        found.undone = names[names.index(last.case) + (last.algorithm == algorithms[-1].name):]
    found.seconds = time.perf_counter() - begin
    return found


def all_algorithms(plan: Plan) -> list[Algorithm]:
    """Return wrt's intersection tests, the default first. If plan.peers is True, also return the installed other libraries."""
    return [*own_algorithms(), *(peer() for peer in PEERS.values() if plan.peers and peer.is_installed())]


def run_case(name: str, rays: int, algorithm: Algorithm, seed: int = 0) -> CaseRow | None:
    """Run one case, let the oracle judge it, and return its row, or None if the algorithm does not support the case.
    Peers support only triangles, finite input and t_min = 0."""
    row = CaseRow(name, algorithm.name)
    for case in chunks(name, rays, seed):
        if case.refused:
            if algorithm.is_peer:
                return None
            row.refused = row.refused is not False and _is_refused(case, algorithm)
            continue
        if (algorithm.is_peer and case.t_min.any()) or not algorithm.prepare(case.geometry):
            return None
        hits = algorithm.closest(case.origins, case.directions, case.t_min, case.t_max)
        is_default = algorithm.name == Own().name
        row.verdict += judge(case, hits, None if is_default else min(COMPARED, case.compared), lowest=not algorithm.is_peer)
        row.judged += len(case)
        if isinstance(algorithm, Own):
            if case.next_directions is not None:
                row.verdict += judge_next(case, *respawn(algorithm, case))
            if not len(case.geometry.spheres) and len(case.geometry) * ALL_HITS_RAYS <= ALL_HITS_TESTS:
                row.verdict += _judge_all(algorithm, case)
    return row


def judge_further(name: str, plan: Plan, progress: Callable[[str], None]) -> Iterator[Verdict]:
    """Yield verdicts, without the oracle, on the rays beyond the sample, traced by the default algorithm on all threads."""
    left, begin = fewer(name, plan.rays) - fewer(name, plan.sample), time.perf_counter()
    own = threading.local()  # each thread has its own structure

    def part(index: int) -> Verdict:
        own.default = getattr(own, "default", None) or Own()
        return further_chunk(name, plan, index, own.default)

    pool = ThreadPoolExecutor(thread_count(plan.threads))
    try:
        for i, verdict in enumerate(pool.map(part, range(n_chunks(name, plan))), 1):
            done = min(CHUNK * i, left) / 1e6
            progress(f"{name}, {done:.1f} of {left / 1e6:.1f} M further rays, {done / (time.perf_counter() - begin):.2f} Mray/s")
            yield verdict
    finally:
        pool.shutdown(cancel_futures=True)


def n_chunks(name: str, plan: Plan) -> int:
    """Return the number of chunks of rays beyond the sample; 0 for a case that only the oracle can judge."""
    left = fewer(name, plan.rays) - fewer(name, plan.sample)
    if left <= 0:
        return 0
    probe = generate(name, 64, plan.seed)
    return 0 if (probe.expected == UNKNOWN).all() and probe.next_directions is None else -(-left // CHUNK)


def further_chunk(name: str, plan: Plan, index: int, own: Own | None = None) -> Verdict:
    """Return the verdict, without the oracle, on one chunk of the rays beyond the sample."""
    own = own or Own()
    left = fewer(name, plan.rays) - fewer(name, plan.sample)
    first = -(-fewer(name, plan.sample) // CHUNK)  # the sample has used the seeds below
    case = generate(name, min(CHUNK, left - index * CHUNK), (plan.seed, first + index))
    own.prepare(case.geometry)
    verdict = check(case, own.closest(case.origins, case.directions, case.t_min, case.t_max))
    if case.next_directions is None:
        verdict.rays -= int((case.expected == UNKNOWN).sum())  # these rays were not judged
        return verdict
    return verdict + judge_next(case, *respawn(own, case))


def _is_refused(case: HardCase, algorithm: Algorithm) -> bool:
    """Return True if Mesh or the query raises InputError for a case whose input is not finite."""
    from wrt.scene.mesh import Mesh

    with suppress(InputError):
        Mesh(case.geometry.vertices, case.geometry.faces)
        algorithm.prepare(case.geometry)
        algorithm.closest(case.origins, case.directions)
        return False
    return True


@cache
def _respawn_kernel(structure: Structure) -> Kernel:
    surface_at = make_surface_at(structure.units.spheres, False, False, False)
    return make_respawn_kernel(structure.struct, structure.traversal(any_hit=False), surface_at)


def respawn(algorithm: Own, case: HardCase) -> tuple[np.ndarray, np.ndarray]:
    """Return prim_id of each ray's hit, and prim_id of the next hit from that point along case.next_directions, (N,) int32 each."""
    accel, n = algorithm.accel, len(case)
    assert case.next_directions is not None
    out = Respawn()
    out.direction = upload(case.next_directions, wp.vec3, accel.device)
    out.exclude = 1
    out.first_prim_id, out.next_prim_id = (wp.empty(n, dtype=wp.int32, device=accel.device) for _ in range(2))
    surfaces, geometry = Surfaces(), case.geometry
    surfaces.n_triangles = len(geometry.faces)
    surfaces.vertices, surfaces.faces = upload(geometry.vertices, wp.vec3, accel.device), upload(geometry.faces, wp.vec3i, accel.device)
    surfaces.spheres = upload(geometry.spheres, wp.vec4, accel.device)
    surfaces.prim_material = wp.zeros(len(geometry), dtype=wp.int32, device=accel.device)
    launch_on(accel.device, _respawn_kernel(accel.structure), n, accel.data, surfaces, case.on(accel.device), out, 0)
    return out.first_prim_id.numpy(), out.next_prim_id.numpy()


def _judge_all(algorithm: Own, case: HardCase) -> Verdict:
    """Judge all hits of the first ALL_HITS_RAYS rays; return a verdict with the duplicates only."""
    part = replace(case, **{name: getattr(case, name)[:ALL_HITS_RAYS] for name in ("origins", "directions", "t_min", "t_max", "expected")})
    hits = all_hits(algorithm.accel, part.origins, part.directions, part.t_min, part.t_max)
    verdict = judge_all_hits(part, hits.ray_id, hits.prim_id, hits.t)
    return Verdict(duplicate_hits=verdict.duplicate_hits, examples=[e for e in verdict.examples if "twice" in e["why"]])


def measure_speed(algorithms: Sequence[Algorithm], runs: int) -> dict[str, Line]:
    """Measure all algorithms on one thread in alternating runs, on case A's sphere of 159,200 triangles.
    Return for each one the quartiles of Mray/s and of the ratio to the first (default) algorithm's Mray/s, and bytes per triangle."""
    case = generate("A_origin_uniform", SPEED_RAYS, seed=1)
    for algorithm in algorithms:
        algorithm.prepare(case.geometry)
    seconds = alternate({a.name: partial(a.closest, case.origins, case.directions) for a in algorithms}, runs)
    default = seconds[algorithms[0].name]
    return {a.name: Line(mrays_per_second=quartiles(SPEED_RAYS / seconds[a.name] / 1e6),
                         ratio_to_default=quartiles(default / seconds[a.name]), bytes_per_triangle=a.bytes_per_triangle)
            for a in algorithms}
