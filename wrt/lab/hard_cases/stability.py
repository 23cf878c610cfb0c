"""`python -m wrt stability`: run the hard cases on intersection tests and ray libraries, and measure errors and speed."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial

import numpy as np
import warp as wp

from wrt.accel.queries.all_hits import all_hits
from wrt.accel.snapshot import Structure
from wrt.core.device import launch_on, upload
from wrt.core.errors import InputError
from wrt.core.types import Kernel
from wrt.kernels.shade.surface import make_surface_at
from wrt.kernels.structs import Surfaces
from wrt.kernels.study.respawn import Respawn, make_respawn_kernel
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench.contestants import Contestant, Own, contestant, installed
from wrt.lab.bench.report import Columns, Groups, Part, Row, cells, grouped, machine_line, tabled, versions
from wrt.lab.bench.timing import alternate, spread
from wrt.lab.hard_cases import Stability as Plan
from wrt.lab.hard_cases.cases import UNKNOWN, HardCase, Verdict, check, chosen, chunks, fewer, generate, judge, judge_all_hits, judge_next
from wrt.scene.mesh import Mesh

DEFAULT = "bvh8"
TESTS = (DEFAULT, *(f"{DEFAULT}:triangle={name}" for name in list(RAY_TRIANGLE)[1:]),
         *(f"{DEFAULT}:box={name}" for name in list(RAY_AABB)[1:]))
PEERS = ("embree", "embree:mode=fast", "warp", "open3d", "mitsuba")
ALL_HITS_TESTS = 20_000_000  # most ray-primitive tests of a case's all-hits check
ALL_HITS_RAYS = 2000  # rays of the all-hits check
SPEED_RAYS = 200_000
COMPARED = 2000  # hits of a case that the oracle compares with the closest hit, except for the first contestant
CHUNK = 2**18  # rays beyond the sample at once
TITLE = "Stability of intersection tests"
WRONG: Columns = {"misses": "{v.misses}", "false hits": "{v.false_hits}", "wrong prim": "{v.wrong_prim}", "self-hits": "{v.self_hits}"}
ERRORS: Columns = {"t ulp max": "{v.t.largest:.3g}", "t ulp 99.9 %": "{v.t.p999:.3g}", "t / bound": "{v.t.largest_ratio:.2g}"}
COLUMNS: Columns = {
    "case": "{case}", "contestant": "{name}", "rays": lambda row: row.note or str(row.v.rays),
    **{head: partial(lambda form, row: "" if row.note else form.format_map(vars(row)), form) for head, form in {
        "judged": "{judged}", **WRONG, "duplicates": "{v.duplicate_hits}", "ties": "{v.ties}", "near ties": "{v.near_ties}",
        "borderline": "{v.borderline}", **ERRORS}.items()}}
ALL: Columns = {
    "contestant": "{name}", "rays": "{v.rays}", **WRONG, "t over bound": "{v.t.over}", "errors": "{errors}",
    "wrong per million": lambda row: f"{1e6 * wrong(row.v) / max(row.v.rays, 1):.3g}", "typical t ulp": "{typical:.3g}",
    "Mray/s": lambda row: spread(row.mrays), "speed / first": lambda row: spread(row.ratios)}
LEGEND = f"""\
judged: the first rays of a case (--sample), which the oracle judges. For further rays the right answer is known in advance: a closed
surface must be hit, a triangle with collinear corners must not be hit, and a ray must not hit the triangle on which it starts. misses:
lost rays. false hits: reported hits of a primitive that the ray misses. wrong prim: a nearer primitive exists. All three by more than the
derived error bound. The next three are within the bound, so not wrong. ties: equal exact t. near ties: the bound hides which primitive is
nearer, counted for all hits of the first contestant and for {COMPARED} hits a case of the others. borderline: the exact ray passes an edge
by less than the bound. duplicates: an all-hits query reports one crossing of a surface twice. t ulp: error of t in float32 steps at the
exact t. t / bound: largest error of t over the bound of wrt's watertight test. typical t ulp: median over the cases of the 99.9th
percentile. errors: cases of finite input in which the contestant raised an error. Input that is not finite may be refused. Mray/s: one
thread, case A's sphere of 159,200 triangles, median [quartiles] of alternating runs."""


def contestants(plan: Plan) -> list[Contestant]:
    """Return the contestants: by default wrt's intersection tests, the default tests first."""
    return [contestant(name) for name in dict.fromkeys([*(plan.contestants or TESTS), *(installed(PEERS) if plan.peers else ())])]


def groups(plan: Plan) -> Groups:
    """Yield the group with each contestant's speed, then a group for each case and contestant."""
    all_of_them = contestants(plan)
    yield partial(speed_rows, all_of_them, plan.runs)
    for name in chosen(plan.cases):
        for one in all_of_them:
            yield partial(case_rows, plan, name, one, one is all_of_them[0])


def speed_rows(all_of_them: Sequence[Contestant], runs: int) -> list[Row]:
    """Measure all contestants on one thread in alternating runs, on case A's sphere of 159,200 triangles."""
    case = generate("A_origin_uniform", SPEED_RAYS, seed=1)
    for one in all_of_them:
        one.prepare(case.geometry)
    seconds = alternate({one.name: partial(one.closest, case.origins, case.directions) for one in all_of_them}, runs)
    return [Row(name=one.name, mrays=(SPEED_RAYS / seconds[one.name] / 1e6).tolist(),
                ratios=(seconds[all_of_them[0].name] / seconds[one.name]).tolist()) for one in all_of_them]


def case_rows(plan: Plan, name: str, one: Contestant, first: bool) -> list[Row]:
    """Run one case; return its row, or no row if the contestant does not support the case. first: judge further rays, too."""
    row = run_case(name, fewer(name, min(plan.sample, plan.rays)), one, plan.seed, None if first else COMPARED)
    if row is None:
        return []
    if first and isinstance(one, Own) and not row.note:
        row.v = sum(judge_further(name, plan, one), row.v)
    return [row]


def run_case(name: str, rays: int, one: Contestant, seed: int = 0, compared: int | None = COMPARED) -> Row | None:
    """Run one case, let the oracle judge it, and return its row, or None if the contestant does not support the case: another library
    supports only triangles and t_min = 0. compared: as for `judge`."""
    row, own = Row(case=name, name=one.name, v=Verdict(), judged=0, note=""), isinstance(one, Own)
    for case in chunks(name, rays, seed):
        if case.refused and own:
            row.note = "refused" if _is_refused(case, one) else "ACCEPTED"
            continue
        try:
            if (case.t_min.any() and not own) or not one.prepare(case.geometry):
                return None
            with np.errstate(all="ignore"):  # of rays that are not finite
                hits = one.closest(case.origins, case.directions, case.t_min, case.t_max)
        except Exception as error:
            if own:
                raise
            row.note = "refused" if case.refused else f"{type(error).__name__}: {error}".splitlines()[0][:100]
            return row
        row.v += judge(case, hits, None if compared is None else min(compared, case.compared), lowest=own)
        row.judged += len(case)
        if isinstance(one, Own):
            if case.next_directions is not None:
                row.v += judge_next(case, *respawn(one, case))
            if not len(case.geometry.spheres) and len(case.geometry) * ALL_HITS_RAYS <= ALL_HITS_TESTS:
                row.v += _judge_all(one, case)
    return row


def judge_further(name: str, plan: Plan, one: Own) -> Iterator[Verdict]:
    """Yield verdicts, without the oracle, on chunks of the rays beyond the sample. A case that only the oracle can judge has none."""
    sample = fewer(name, plan.sample)
    left, probe = fewer(name, plan.rays) - sample, generate(name, 64, plan.seed)
    if (probe.expected == UNKNOWN).all() and probe.next_directions is None:
        return
    for index in range(-(-max(left, 0) // CHUNK)):
        seed = plan.seed, -(-sample // CHUNK) + index  # the sample has used the seeds below
        case = generate(name, min(CHUNK, left - index * CHUNK), seed)
        one.prepare(case.geometry)
        verdict = check(case, one.accel.closest_hit(case.origins, case.directions, case.t_min, case.t_max))
        if case.next_directions is None:
            verdict.rays -= int((case.expected == UNKNOWN).sum())  # these rays were not judged
        else:
            verdict += judge_next(case, *respawn(one, case))
        yield verdict


def _is_refused(case: HardCase, one: Contestant) -> bool:
    """Return True if Mesh or the query raises InputError for a case whose input is not finite."""
    with suppress(InputError):
        Mesh(case.geometry.vertices, case.geometry.faces)
        one.prepare(case.geometry)
        one.closest(case.origins, case.directions)
        return False
    return True


@cache
def _respawn_kernel(structure: Structure) -> Kernel:
    surface_at = make_surface_at(structure.units.spheres, False, False, False)
    return make_respawn_kernel(structure.struct, structure.traversal(any_hit=False), surface_at)


def respawn(one: Own, case: HardCase, exclude: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return prim_id of each ray's hit, (N,) int32. A second ray starts there along case.next_directions; return its hit's prim_id, too.
    exclude: the second ray excludes the triangle on which it starts, as in a render."""
    accel, n = one.accel, len(case)
    assert case.next_directions is not None
    out = Respawn()
    out.direction = upload(case.next_directions, wp.vec3, accel.device)
    out.exclude = int(exclude)
    out.first_prim_id, out.next_prim_id = (wp.empty(n, dtype=wp.int32, device=accel.device) for _ in range(2))
    surfaces, geometry = Surfaces(), case.geometry
    surfaces.n_triangles = len(geometry.faces)
    surfaces.vertices, surfaces.faces = upload(geometry.vertices, wp.vec3, accel.device), upload(geometry.faces, wp.vec3i, accel.device)
    surfaces.spheres = upload(geometry.spheres, wp.vec4, accel.device)
    surfaces.prim_material = wp.zeros(len(geometry), dtype=wp.int32, device=accel.device)
    launch_on(accel.device, _respawn_kernel(accel.structure), n, accel.data, surfaces, case.on(accel.device), out, 0)
    return out.first_prim_id.numpy(), out.next_prim_id.numpy()


def _judge_all(one: Own, case: HardCase) -> Verdict:
    """Judge all hits of the first ALL_HITS_RAYS rays; return a verdict with the duplicates only."""
    part = replace(case, **{name: getattr(case, name)[:ALL_HITS_RAYS] for name in ("origins", "directions", "t_min", "t_max", "expected")})
    hits = all_hits(one.accel, part.origins, part.directions, part.t_min, part.t_max)
    verdict = judge_all_hits(part, hits.ray_id, hits.prim_id, hits.t)
    return Verdict(duplicate_hits=verdict.duplicate_hits, examples=[e for e in verdict.examples if "twice" in e["why"]])


def wrong(verdict: Verdict) -> int:
    return verdict.misses + verdict.false_hits + verdict.wrong_prim + verdict.self_hits


def typical_error(rows: Sequence[Row]) -> float:
    """Return the median over the cases of the 99.9th percentile of the error of t, in ulp.
    A percentile over all rays would show only two or three ill-conditioned cases, such as edge-on or denormal triangles."""
    errors = [row.v.t.p999 for row in rows]
    return float(np.median([error for error in errors if np.isfinite(error)] or [np.nan]))


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    """Return the sums over all cases, the wrong rays by group of cases, and every row."""
    speed = {row.name: row for row in rows if "mrays" in vars(row)}
    judged = [row for row in rows if "case" in vars(row)]
    names = list(dict.fromkeys(row.name for row in judged))
    sums = []
    for (name,), mine in grouped(judged, "name").items():
        errors = sum(bool(row.note) and row.note not in ("refused", "ACCEPTED") for row in mine)
        sums.append(Row(**{**vars(speed[name]), "v": _sum(mine), "typical": typical_error(mine), "errors": errors}))
    lines = []
    for group in [*sorted({row.case[0] for row in judged}), "A to H"]:
        of_group = [row for row in judged if row.case[0] in (group if len(group) == 1 else "ABCDEFGH")]
        verdicts = [_sum([row for row in of_group if row.name == name]) for name in names]
        lines.append((group, *(f"{wrong(v)} of {v.rays}" for v in verdicts)))
    return [tabled(ALL, sums, "All cases"), Part("Wrong rays by group of cases", "", ("group", *names), lines),
            tabled(COLUMNS, judged, "Every case")]


def _sum(rows: Sequence[Row]) -> Verdict:
    return sum((row.v for row in rows), Verdict())


def line(row: Row) -> str:
    return "  ".join(cells(COLUMNS, row)) if "case" in vars(row) else f"{row.name}: {spread(row.mrays)} Mray/s"


def machine(plan: Plan) -> str:
    missing = [name for name in PEERS if plan.peers and contestant(name).missing()]
    return machine_line("", versions("warp-lang", "embreex", "open3d", "mitsuba", "trimesh"),
                        *([f"not installed: {', '.join(missing)}"] if missing else []))
