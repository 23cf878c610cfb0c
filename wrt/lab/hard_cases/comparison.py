"""`python -m wrt bench hard-cases`: test the closest hits of wrt and other libraries on the hard cases."""

from collections.abc import Sequence
from functools import partial
from statistics import median

from wrt.lab.bench.report import Columns, Groups, Part, Row, cells, grouped, machine_line, versions
from wrt.lab.hard_cases.conformance import COLUMNS as CASE_COLUMNS
from wrt.lab.hard_cases.conformance import Case, case_names
from wrt.lab.hard_cases.libraries import LIBRARIES, Library, usable
from wrt.lab.plans import HardCases as Plan

KINDS = ("lost", "invented", "wrong_triangle")
TITLE = "The hard cases and ray libraries"
COLUMNS: Columns = {"library": "{library}", **CASE_COLUMNS}
LEGEND = """\
lost: rays that must hit but are reported to miss. invented: reported hits of a triangle that the ray misses by more than float32
rounding, or reported points that are not on the ray. wrong triangle: another triangle is nearer by more than the rounding. At equal
distance any face is right. ulp: largest error of t, in float32 steps at the exact t. Input that is not finite may be refused."""


def groups(plan: Plan) -> Groups:
    for name in plan.libraries or LIBRARIES:
        library, reason = LIBRARIES[name], usable(name)
        if reason:
            yield partial(list, [Row(library=library.name, missing=reason)])
            continue
        for case in case_names(plan.cases):
            yield partial(case_rows, library, Case(case, plan.rays, plan.seed))


def case_rows(library: Library, case: Case) -> list[Row]:
    result = case.result(library.closest_hit)
    return [Row(library=library.name, missing="", note=result.note, wrong=result.wrong, **vars(result))]


def line(row: Row) -> str:
    return f"{row.library}: {row.missing}" if row.missing else "  ".join(cells(COLUMNS, row))


def machine(plan: Plan) -> str:
    return machine_line("", versions("warp-lang", "embreex", "open3d", "mitsuba", "trimesh"))


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    measured = [row for row in rows if not row.missing]
    by_name = {name: group for (name,), group in grouped(measured, "library").items()}
    names, cases = list(by_name), {case: group for (case,), group in grouped(measured, "case").items()}
    groups: dict[str, list[Row]] = {}
    for row in measured:
        groups.setdefault(row.case[0], []).append(row)
    lines = [(letter, *_counted(group, names)) for letter, group in groups.items()]
    lines += [("all", *_counted(measured, names))] if measured else []
    lines += [(kind.replace("_", " "), "", *(str(sum(getattr(row, kind) for row in group)) for group in by_name.values()))
              for kind in KINDS]
    lines += [("median case: largest error of t, ulp", "", *(f"{median(row.t_ulp for row in group):.3g}" for group in by_name.values()))]
    every = []
    for case, group in cases.items():
        ulp = {row.library: row.t_ulp for row in group}
        rays, *counts = _counted(group, names)
        every.append((case, rays, *(f"{count} / {ulp[name]:.3g}" for name, count in zip(names, counts, strict=True))))
    missing = "\n\n".join(f"{row.library}: {row.missing}." for row in rows if row.missing)
    return [Part("Wrong rays: lost, invented or wrong triangle", missing, ("group", "rays", *names), lines),
            Part("Wrong rays / largest error of t in ulp, by case", "", ("case", "rays", *names), every)]


def _counted(group: Sequence[Row], names: Sequence[str]) -> list[str]:
    """Return cells of a table: the number of rays, then each library's number of wrong rays."""
    by_library = {name: [row for row in group if row.library == name] for name in names}
    out = [str(sum(row.rays for row in by_library[names[0]]))]
    for rows in by_library.values():
        errors = sum(bool(row.raised) and not row.refused for row in rows)
        out.append(f"{sum(row.wrong for row in rows)}{f' and {errors} errors' if errors else ''}")
    return out
