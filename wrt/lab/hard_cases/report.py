"""Results of `stability`: tables for the terminal, and a report as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wrt.core.threads import thread_count
from wrt.lab.bench.report import Columns, Part, machine_line, markdown, repeating, table, tabled
from wrt.lab.bench.report import Row as Line
from wrt.lab.bench.timing import shown
from wrt.lab.hard_cases.cases import Verdict
from wrt.lab.hard_cases.stability import ASKED, COLUMNS, Plan, Result, Row

LEGEND = f"""\
judged: the first rays of a case, {{sample}} at most, which the oracle judged. The answer of the others is known without it: a closed
surface must be hit, corners on a line never, and a ray must not hit the triangle that it leaves. misses, false hits, wrong prim: rays
lost, invented, or given to a primitive behind another one, by more than the derived error bound. Within the bound nothing is wrong, but
counted: ties (the same exact t), near ties (the bound hides which is nearer; for the default of all hits, else of {ASKED} a case) and
borderline (the exact ray passes an edge by less than the bound). duplicates: one crossing of a surface that an all-hits query reports
twice. t: error in float32 ulp of the exact distance, and its share of the bound."""


def sums(rows: Sequence[Row]) -> dict[str, Verdict]:
    """Return the verdict of each algorithm over all cases, in their order."""
    out: dict[str, Verdict] = {}
    for row in rows:
        out[row.algorithm] = out.get(row.algorithm, Verdict()) + row.verdict
    return out


def wrong(verdict: Verdict) -> int:
    return verdict.misses + verdict.false_hits + verdict.wrong_prim + verdict.self_hits


def usual_error(rows: Sequence[Row], algorithm: str) -> float:
    """Return the 99.9th percentile of the error of t (ulp) in the median one of an algorithm's cases.
    Over all rays it would be that of two or three ill-conditioned cases: triangles seen edge-on, or denormal ones."""
    errors = [row.verdict.t.percentile(99.9) for row in rows if row.algorithm == algorithm]
    return float(np.median([error for error in errors if np.isfinite(error)] or [np.nan]))


WRONG: Columns = {"misses": "{v.misses}", "false hits": "{v.false_hits}", "wrong prim": "{v.wrong_prim}",
                  "self-hits": "{v.self_hits}", "t over bound": "{v.t.over}"}
ALL: Columns = {
    "algorithm": "{name}", "rays": "{v.rays}", **WRONG,
    "wrong per million": lambda row: f"{1e6 * wrong(row.v) / max(row.v.rays, 1):.3g}", "usual t ulp": "{error:.3g}",
    "Mray/s": lambda row: shown(row.mrays_per_second), "speed / default": lambda row: shown(row.ratio_to_default),
    "B/tri": "{bytes_per_triangle:.0f}"}
GROUPS: Columns = {"group": "{name}", "rays": "{v.rays}", "judged": "{judged}", **WRONG, "t / bound": "{v.t.largest_ratio:.2g}"}


def _summary(result: Result) -> Part:
    lines = [Line(name=name, v=v, error=usual_error(result.rows, name), **vars(result.speed[name]))
             for name, v in sums(result.rows).items()]
    text = ("Summed over all cases. usual t ulp: the 99.9th percentile in the median case. Speed on one thread, case A's sphere of 159,200 "
            "triangles, runs in turn: median [quartiles].")
    return tabled(ALL, lines, "All cases", text)


def _groups(result: Result) -> Part:
    """Sum up the default by the letters of the cases."""
    default = next(iter(result.speed))
    rows = [row for row in result.rows if row.algorithm == default]
    letters = {letter: letter for letter in sorted({row.case[0] for row in result.rows})} | {"A to H": "ABCDEFGH"}
    groups = {name: [row for row in rows if row.case[0] in those] for name, those in letters.items()}
    return tabled(GROUPS, [Line(name=name, judged=sum(row.judged for row in mine), v=sum((row.verdict for row in mine), Verdict()))
                           for name, mine in groups.items()], f"The default ({default}) by group")


def text(result: Result, plan: Plan) -> str:
    """Return the whole report as Markdown."""
    head = "\n\n".join([f"Machine: {machine(plan)}; {result.seconds:.0f} s in all.", f"To repeat: `{repeating(plan)}`",
                        LEGEND.format(sample=plan.sample), *(f"{line}." for line in _notes(result))])
    return markdown([Part("Stability of the intersection tests", head), _summary(result), _groups(result),
                     tabled(COLUMNS, result.rows, "Every case")])


def summary(result: Result) -> str:
    """Return what the terminal shows at the end."""
    out = [table(part.head, part.lines) for part in (_summary(result), _groups(result))]
    return "\n\n".join([*out, *_notes(result)])


def _notes(result: Result) -> list[str]:
    """Return what is missing in the results."""
    undone = [f"Interrupted; not done, or not with all algorithms: {', '.join(result.undone)}"] if result.undone else []
    return [*undone, *(f"{name}: not installed" for name in result.not_installed)]


def machine(plan: Plan) -> str:
    return machine_line(f"{thread_count(plan.threads)} used")
