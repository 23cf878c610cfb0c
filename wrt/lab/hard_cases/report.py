"""Results of `stability`: tables for the terminal, and a report as Markdown."""

from collections.abc import Sequence

import numpy as np

from wrt.core.threads import thread_count
from wrt.lab.bench.report import Columns, Part, machine_line, markdown, repeating, table, tabled
from wrt.lab.bench.report import Row as Line
from wrt.lab.bench.timing import shown
from wrt.lab.hard_cases.cases import Verdict
from wrt.lab.hard_cases.stability import COLUMNS, COMPARED, CaseRow, Plan, Result

LEGEND = f"""\
judged: the first rays of a case, {{sample}} at most, which the oracle judges. For further rays the right answer is known in advance:
a closed surface must be hit, a triangle with collinear corners must not be hit, and a ray must not hit the triangle on which it starts.
misses: lost rays. false hits: reported hits of a primitive that the ray misses. wrong prim: a nearer primitive exists. All three by more
than the derived error bound. The next three are within the bound, so not wrong. ties: equal exact t. near ties: the bound hides which
primitive is nearer, counted for all hits of the default and for {COMPARED} hits a case of other algorithms. borderline: the exact ray
passes an edge by less than the bound. duplicates: an all-hits query reports one crossing of a surface twice. t ulp: error of t in float32
steps at the exact t. t / bound: largest error of t over its bound."""


def sums(rows: Sequence[CaseRow]) -> dict[str, Verdict]:
    """Return the sum of each algorithm's verdicts over all cases."""
    out: dict[str, Verdict] = {}
    for row in rows:
        out[row.algorithm] = out.get(row.algorithm, Verdict()) + row.verdict
    return out


def wrong(verdict: Verdict) -> int:
    return verdict.misses + verdict.false_hits + verdict.wrong_prim + verdict.self_hits


def usual_error(rows: Sequence[CaseRow], algorithm: str) -> float:
    """Return the median over the cases of the 99.9th percentile of the error of t, in ulp.
    A percentile over all rays would show only two or three ill-conditioned cases, such as edge-on or denormal triangles."""
    errors = [row.verdict.t.percentile(99.9) for row in rows if row.algorithm == algorithm]
    return float(np.median([error for error in errors if np.isfinite(error)] or [np.nan]))


WRONG: Columns = {"misses": "{v.misses}", "false hits": "{v.false_hits}", "wrong prim": "{v.wrong_prim}",
                  "self-hits": "{v.self_hits}", "t over bound": "{v.t.over}"}
ALL: Columns = {
    "algorithm": "{name}", "rays": "{v.rays}", **WRONG,
    "wrong per million": lambda row: f"{1e6 * wrong(row.v) / max(row.v.rays, 1):.3g}", "typical t ulp": "{error:.3g}",
    "Mray/s": lambda row: shown(row.mrays_per_second), "speed / default": lambda row: shown(row.ratio_to_default),
    "B/triangle": "{bytes_per_triangle:.0f}"}
GROUPS: Columns = {"group": "{name}", "rays": "{v.rays}", "judged": "{judged}", **WRONG, "t / bound": "{v.t.largest_ratio:.2g}"}


def _summary(result: Result) -> Part:
    lines = [Line(name=name, v=v, error=usual_error(result.rows, name), **vars(result.speed[name]))
             for name, v in sums(result.rows).items()]
    text = ("Sums over all cases. typical t ulp: median over the cases of the 99.9th percentile. Mray/s: one thread, case A's sphere of "
            "159,200 triangles, median [quartiles] of alternating runs.")
    return tabled(ALL, lines, "All cases", text)


def _groups(result: Result) -> Part:
    """Return the table that sums the default algorithm's verdicts by group of cases."""
    default = next(iter(result.speed))
    rows = [row for row in result.rows if row.algorithm == default]
    letters = {letter: letter for letter in sorted({row.case[0] for row in result.rows})} | {"A to H": "ABCDEFGH"}
    groups = {name: [row for row in rows if row.case[0] in group] for name, group in letters.items()}
    return tabled(GROUPS, [Line(name=name, judged=sum(row.judged for row in group), v=sum((row.verdict for row in group), Verdict()))
                           for name, group in groups.items()], f"The default ({default}) by group")


def text(result: Result, plan: Plan, machine: str) -> str:
    """Return the whole report as Markdown."""
    head = "\n\n".join([f"Machine: {machine}; the run took {result.seconds:.0f} s.", f"To repeat: `{repeating(plan)}`",
                        LEGEND.format(sample=plan.sample), *(f"{line}." for line in _notes(result))])
    return markdown([Part("Stability of the intersection tests", head), _summary(result), _groups(result),
                     tabled(COLUMNS, result.rows, "Every case")])


def summary(result: Result) -> str:
    """Return the tables and notes that the terminal shows at the end."""
    out = [table(part.head, part.lines) for part in (_summary(result), _groups(result))]
    return "\n\n".join([*out, *_notes(result)])


def _notes(result: Result) -> list[str]:
    """Return sentences that name the unfinished cases and the libraries that are not installed."""
    undone = [f"Interrupted; not done, or not with all algorithms: {', '.join(result.undone)}"] if result.undone else []
    return [*undone, *(f"{name}: not installed" for name in result.not_installed)]


def machine(plan: Plan) -> str:
    return machine_line(f"{thread_count(plan.threads)} threads used")
