"""`python -m wrt bench claims`: published claims about ray tracing hardware, repeated with exact counts."""

import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from wrt.lab.bench.plot import new_figure, picture_file
from wrt.lab.bench.report import Columns, Groups, Part, Row, grouped, tabled
from wrt.lab.claims import Claims as Plan
from wrt.lab.claims.claim import CLAIMS, SAME_SCENE, Figure, Study
from wrt.lab.claims.nodes import NAMES, WIDTHS
from wrt.lab.claims.scene_files import scene_files

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_COLUMNS, COLUMN_BARS = 3, 24  # of a picture: columns, and height in bars from which a column is divided
AROUND = 3  # height of a panel's title and axis in bars
TITLE = "Published claims, repeated"
OWN: Columns = {"claim": "{claim}", "what": "{what}", "unit": "{unit}", "ours": "{ours:.4g}"}
COMPARED: Columns = {**OWN, "published": lambda row: said(row.published), "ratio": "{ratio:.2f}", "verdict": "{verdict}"}
LEGEND = f"""\
published: a number, or the two ends of a range; ratio: ours over it, 1 within a range. agrees: within a factor of 1.5 ({SAME_SCENE:g}
where said), and on the same side of 1 for a unit of ratio. differs: the list of sources says what a measurement shows about it. Own
findings have no number to compare with. In brackets after a source: read in the original, quoted by others, the abstract alone, or memory.
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
    """Return the tables of compared and of other numbers, the tables of rules (width, order, culling), and a list with the source and
    set-up of each claim."""
    compared = [row for row in rows if row.published is not None]
    agree = sum(row.verdict == "agrees" for row in compared)
    rules = [row for row in rows if row.claim == "rules"]
    own = [row for row in rows if row.published is None and row.claim != "rules"]
    items = [item(group) for group in grouped(rows, "claim").values()]
    return [tabled(COMPARED, compared, "Compared numbers", f"{agree} of {len(compared)} compared numbers agree."),
            *([tabled(OWN, own, "Own findings")] if own else []), *rules_tables(rules),
            Part("Sources, differences of set-up, and what explains them", "\n".join(items))]


def item(rows: Sequence[Row]) -> str:
    """Return the list item of a claim: its source and set-up, and for each number what differs here and what a measurement shows."""
    given = [row.differences.split("; ") for row in rows if row.differences]
    clauses = list(dict.fromkeys(clause for each in given for clause in each))
    common = [clause for clause in clauses if clause.startswith("scene ") or all(clause in each for each in given)]
    here = f" Here: {'; '.join(common)}." if common else ""
    lines = [wrapped("- ", f"**{rows[0].claim}**: {rows[0].source} ({rows[0].sure}). Published set-up: {rows[0].setup}.{here}")]
    found: dict[tuple[str, str], list[str]] = {}
    for row in rows if rows[0].claim != "rules" else ():  # the rules have their tables
        own = "; ".join(clause for clause in row.differences.split("; ") if clause not in common)
        found.setdefault((own, row.reason), []).append(row.what)
    for (differences, reason), names in found.items():
        texts = [differences, f"measured: {reason}" if reason else ""]
        if any(texts):
            lines.append(wrapped("  - ", f"*{'; '.join(names)}*: {'; '.join(filter(None, texts))}"))
    return "\n".join(lines)


def wrapped(bullet: str, text: str) -> str:
    """Wrap the text of a list item."""
    return textwrap.fill(text, 140, initial_indent=bullet, subsequent_indent=" " * len(bullet), break_long_words=False,
                         break_on_hyphens=False)


def rules_of(rows: Sequence[Row]) -> dict[str, tuple[str, dict[tuple[int, str], float]]]:
    """Return, for each scene, the differences of set-up, and nodes a ray by width and rules."""
    out: dict[str, tuple[str, dict[tuple[int, str], float]]] = {}
    for row in rows:
        _, scene, width, rules = row.what.split(", ", 3)
        _, found = out.setdefault(scene, (row.differences.split("; planes")[0] + ".", {}))
        found[int(width.split()[1]), rules] = row.ours
    return out


def rules_tables(rows: Sequence[Row]) -> list[Part]:
    """Return a table for each scene."""
    return [Part(f"Nodes a ray by width, order and culling, {scene}", differences,
                 ("rules", *(f"width {width}" for width in WIDTHS)),
                 [(name, *(f"{found[width, name]:.1f}" for width in WIDTHS)) for name in NAMES.values()])
            for scene, (differences, found) in rules_of(rows).items()]


def line(row: Row) -> str:
    published = "" if row.published is None else f", published {said(row.published)}: {row.verdict}"
    return f"{row.claim}: {row.what}: {row.ours:.4g} {row.unit}{published}"


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    compared = [row for row in rows if row.published is not None]
    return {"compared": len(compared), "agree": sum(row.verdict == "agrees" for row in compared)}


def as_picture(rows: Sequence[Row], plan: Plan, machine: str, suffix: str) -> bytes:
    """Draw a panel for each claim and unit: bars for wrt's numbers, and the published number or range over each bar."""
    from matplotlib.patches import Patch

    panels = [Panel(len(group), partial(bars, rows=group))
              for group in grouped((row for row in rows if row.claim != "rules"), "claim", "unit").values()]
    rules = rules_of([row for row in rows if row.claim == "rules"])
    panels += [Panel(7, partial(curves, scene=scene, found=found)) for scene, (_, found) in rules.items()]
    columns = in_columns(panels)
    heights = [sum(panel.height + AROUND for panel in column) for column in columns]
    figure = new_figure(7.0 * len(columns), 0.27 * max(heights) + (0.6 if len(columns) > 1 else 0.9))
    for part, column, height in zip(figure.subfigures(1, len(columns), squeeze=False)[0], columns, heights, strict=True):
        ratios = [*(panel.height for panel in column), max(heights) - height + 0.01]
        axes = part.subplots(len(ratios), 1, squeeze=False, height_ratios=ratios)[:, 0]
        for panel, place in zip(column, axes, strict=False):
            panel.draw(place)
        axes[-1].set_axis_off()  # fills the column
    figure.legend(handles=[Patch(color="C0", label="wrt: agrees, or nothing to compare with"), Patch(color="C1", label="wrt: differs"),
                           Patch(color="k", label="published value or range, by the source in the title")],
                  loc="outside upper center", ncols=3 if len(columns) > 1 else 1, frameon=False, fontsize="small")
    return picture_file(figure, suffix)


class Panel(NamedTuple):
    """A chart. height: in bars, without its title and axis."""

    height: int
    draw: "Callable[[Axes], None]"


def in_columns(panels: Sequence[Panel]) -> list[list[Panel]]:
    """Arrange panels in up to MOST_COLUMNS columns of about equal height, in their order."""
    total = sum(panel.height + AROUND for panel in panels)
    count = min(MOST_COLUMNS, len(panels), 1 + total // COLUMN_BARS)
    columns: list[list[Panel]] = [[] for _ in range(count)]
    above = 0
    for panel in panels:
        height = panel.height + AROUND
        columns[int(count * (above + 0.5 * height) / total)].append(panel)
        above += height
    return [column for column in columns if column]


def bars(axes: "Axes", rows: Sequence[Row]) -> None:
    """Draw the numbers of a claim that have one unit."""
    claim, unit, source = rows[0].claim, rows[0].unit, rows[0].source
    if all(row.published is None for row in rows):
        source = f"wrt's own, beside {source}"
    at = np.arange(len(rows))[::-1]
    axes.barh(at, [row.ours for row in rows], color=["C0" if row.verdict != "differs" else "C1" for row in rows], height=0.6)
    for y, row in zip(at, rows, strict=True):
        if row.published is not None:
            low, high = row.published if isinstance(row.published, tuple) else (row.published, row.published)
            axes.fill_betweenx([y - 0.42, y + 0.42], low, high, color="0.2", alpha=0.25, linewidth=0.0)
            axes.vlines([low, high], y - 0.42, y + 0.42, color="k", linewidth=2.0)
        text = f"{row.ours:.3g}" + ("" if row.published is None else f"  (published {said(row.published)})")
        end = max(row.ours, 0.0, *(np.ravel(row.published) if row.published is not None else ()))
        axes.text(end, y, f"  {text}", va="center", fontsize="x-small")
    axes.set_yticks(at, [textwrap.fill(row.what, 40) for row in rows], fontsize="x-small")
    axes.margins(x=0.6)
    axes.set_title(textwrap.fill(f"{claim}: {source}", 66), fontsize="small", loc="left")
    axes.set_xlabel(unit or "correlation (no unit)", fontsize="x-small")
    axes.tick_params(axis="x", labelsize="x-small")


def curves(axes: "Axes", scene: str, found: dict[tuple[int, str], float]) -> None:
    """Draw nodes a ray over the width."""
    for name in NAMES.values():
        axes.plot(WIDTHS, [found[width, name] for width in WIDTHS], marker="o", label=name)
    axes.set_xticks(WIDTHS)
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"rules: wrt's own, {scene}: width, order of children,\nculling of popped entries", fontsize="small", loc="left")
    axes.set_xlabel("children of a node (number)", fontsize="x-small")
    axes.set_ylabel("nodes a ray (number)", fontsize="x-small")
    axes.tick_params(labelsize="x-small")
    axes.legend(fontsize="x-small")


WRITERS = {".png": as_picture, ".svg": as_picture}
