"""`python -m wrt bench hard-cases`: the hard cases against other libraries' closest hits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median

from wrt.lab.bench.report import Columns, Part, Row, cells, grouped, machine_line, versions
from wrt.lab.hard_cases.conformance import COLUMNS as OF_A_CASE
from wrt.lab.hard_cases.conformance import results
from wrt.lab.hard_cases.libraries import LIBRARIES, usable
from wrt.lab.plans import HardCases as Plan

KINDS = ("lost", "invented", "wrong_triangle")
TITLE = "The hard cases and ray libraries"
COLUMNS: Columns = {"library": "{library}", **OF_A_CASE}
LEGEND = """\
lost: rays that must hit and are reported to miss. invented: hits of a triangle that the ray passes by more than float32's rounding, or
that are not on the ray. wrong triangle: a triangle nearer by more than the rounding was left out. Of faces at the same distance any is
right. ulp: the largest error of t, in float32 steps of the exact one. Input that is not finite may be refused."""


def rows(plan: Plan) -> Iterator[Row]:
    for name in plan.libraries or LIBRARIES:
        library, reason = LIBRARIES[name], usable(name)
        if reason:
            yield Row(library=library.name, missing=reason)
            continue
        for result in results(library.closest_hit, plan.cases, plan.rays, plan.seed):
            yield Row(library=library.name, missing="", note=result.note, wrong=result.wrong, **vars(result))


def line(row: Row) -> str:
    return f"{row.library}: {row.missing}" if row.missing else "  ".join(cells(COLUMNS, row))


def machine(plan: Plan) -> str:
    return machine_line("", versions("warp-lang", "embreex", "open3d", "mitsuba", "trimesh"))


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    asked = [row for row in rows if not row.missing]
    by_name = {name: group for (name,), group in grouped(asked, "library").items()}
    names, cases = list(by_name), {case: group for (case,), group in grouped(asked, "case").items()}
    groups: dict[str, list[Row]] = {}
    for row in asked:
        groups.setdefault(row.case[0], []).append(row)
    lines = [(letter, *_counted(group, names)) for letter, group in groups.items()]
    lines += [("all", *_counted(asked, names))] if asked else []
    lines += [(kind.replace("_", " "), "", *(str(sum(getattr(row, kind) for row in group)) for group in by_name.values()))
              for kind in KINDS]
    lines += [("ulp in the middle case", "", *(f"{median(row.t_ulp for row in group):.3g}" for group in by_name.values()))]
    every = []
    for case, group in cases.items():
        ulp = {row.library: row.t_ulp for row in group}
        rays, *counts = _counted(group, names)
        every.append((case, rays, *(f"{count} / {ulp[name]:.3g}" for name, count in zip(names, counts, strict=True))))
    missing = "\n\n".join(f"{row.library}: {row.missing}." for row in rows if row.missing)
    return [Part("Rays lost, invented and given to a wrong triangle", missing, ("group", "rays", *names), lines),
            Part("The same by case, and the largest error of t in ulp", "", ("case", "rays", *names), every)]


def _counted(group: Sequence[Row], names: Sequence[str]) -> list[str]:
    """Return the number of rays, and of each library the number of wrong ones."""
    mine = {name: [row for row in group if row.library == name] for name in names}
    out = [str(sum(row.rays for row in mine[names[0]]))]
    for rows in mine.values():
        errors = sum(bool(row.raised) and not row.refused for row in rows)
        out.append(f"{sum(row.wrong for row in rows)}{f' and {errors} errors' if errors else ''}")
    return out
