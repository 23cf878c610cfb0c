"""`python -m wrt bench claims`: published claims about ray tracing hardware, repeated with exact counts."""

import textwrap
from collections.abc import Sequence
from functools import partial

from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, tabled
from wrt.lab.claims import Claims as Plan
from wrt.lab.claims.claim import AGREES, CLAIMS, Figure, Study
from wrt.lab.claims.scenes import scene_files

TITLE = "Published claims, repeated"
OWN: Columns = {"claim": "{claim}", "what": "{what}", "unit": "{unit}", "ours": "{ours:.4g}"}
COMPARED: Columns = {**OWN, "published": lambda row: said(row.published), "ratio": "{ratio:.2f}", "verdict": "{verdict}"}
LEGEND = f"""\
published: a number, or the two ends of a range; ratio: ours over it, 1 within a range. agrees: within a factor of {AGREES:g},
and on the same side of 1 for a unit of ratio. differs: the list of sources says what a measurement shows about it. Own findings have no
number to compare with. In brackets after a source: read in the original, quoted by others, or the abstract alone.
Generated scenes stand in for scenes without a file. Nothing is timed: equal options give equal rows."""


def said(published: float | tuple[float, float] | None) -> str:
    """Write a published number or range."""
    if published is None:
        return ""
    return f"{published[0]:.4g} to {published[1]:.4g}" if isinstance(published, tuple | list) else f"{published:.4g}"


def groups(plan: Plan) -> Groups:
    study = Study(scene_files(plan.scene), plan.side)
    return (partial(claim_rows, study, name) for name in dict.fromkeys(plan.names) or CLAIMS)


def claim_rows(study: Study, name: str) -> list[Row]:
    return [row_of(name, figure) for figure in CLAIMS[name].measure(study)]


def row_of(name: str, figure: Figure) -> Row:
    claim = CLAIMS[name]
    return Row(claim=name, **vars(figure), ratio=figure.ratio, verdict=figure.verdict, source=claim.source, setup=claim.setup,
               sure=claim.sure)


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    """Return the tables of compared and of other numbers, and a list with the source and set-up of each claim."""
    compared = [row for row in rows if row.published is not None]
    agree = sum(row.verdict == "agrees" for row in compared)
    own = [row for row in rows if row.published is None]
    items = [item(group) for group in grouped(rows, "claim").values()]
    return [tabled(COMPARED, compared, "Compared numbers", f"{agree} of {len(compared)} compared numbers agree."),
            *([tabled(OWN, own, "Own findings")] if own else []),
            Part("Sources, differences of set-up, and what explains them", "\n".join(items))]


def item(rows: Sequence[Row]) -> str:
    """Return the list item of a claim: its source and set-up, and for each number what differs here and what a measurement shows."""
    lines = [wrapped("- ", f"**{rows[0].claim}**: {rows[0].source} ({rows[0].sure}). Published set-up: {rows[0].setup}.")]
    for (differences, reason), group in grouped(rows, "differences", "reason").items():
        texts = (differences, f"measured: {reason}" if reason else "")
        lines.append(wrapped("  - ", f"*{'; '.join(row.what for row in group)}*: {'; '.join(filter(None, texts))}"))
    return "\n".join(lines)


def wrapped(bullet: str, text: str) -> str:
    """Wrap the text of a list item."""
    return textwrap.fill(text, 140, initial_indent=bullet, subsequent_indent=" " * len(bullet), break_long_words=False,
                         break_on_hyphens=False)


def line(row: Row) -> str:
    published = "" if row.published is None else f", published {said(row.published)}: {row.verdict}"
    return f"{row.claim}: {row.what}: {row.ours:.4g} {row.unit}{published}"


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    compared = [row for row in rows if row.published is not None]
    return {"compared": len(compared), "agree": sum(row.verdict == "agrees" for row in compared)}
