"""`python -m wrt bench claims`: published claims about ray tracing hardware, repeated with exact counts."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from wrt.lab.bench.plot import new_figure
from wrt.lab.bench.report import Columns, Part, Row, grouped, tabled
from wrt.lab.claims.claim import CLAIMS, SAME_SCENE, Figure, Study
from wrt.lab.claims.nodes import NAMES, WIDTHS
from wrt.lab.claims.scene_files import scene_files
from wrt.lab.plans import Claims as Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TITLE = "Published claims, repeated"
FOUND: Columns = {"claim": "{claim}", "what": "{what}", "unit": "{unit}",
                  "published": lambda row: said(row.published), "ours": "{ours:.4g}",
                  "ratio": lambda row: "" if row.ratio is None else f"{row.ratio:.2f}", "verdict": "{verdict}"}
SOURCES: Columns = {"claim": "{claim}", "source": "{source}", "their set-up": "{setup}", "how sure": "{sure}"}
DETAILS: Columns = {"what": "{what}", "differences of set-up": "{differences}", "measured": "{reason}"}
LEGEND = f"""\
published: a number, or the two ends of a range; ratio: ours over it, 1 within a range. agrees: within a factor of 1.5 ({SAME_SCENE:g}
where said), and on the same side of 1 for a unit of ratio. differs: the column "measured" of the second table says what a measurement
shows about it. own finding: no number to compare with. how sure: read in the original, quoted by others, the abstract alone, or memory.
Generated scenes stand in for scenes without a file. Nothing is timed: equal options give equal rows."""
FIELDS = ("claim", "what", "unit", "published_low", "published_high", "ours", "ratio", "verdict", "source", "setup", "sure", "differences",
          "reason")


def said(published: float | tuple[float, float] | None) -> str:
    """Write a published number or range."""
    if published is None:
        return ""
    return f"{published[0]:.4g} to {published[1]:.4g}" if isinstance(published, tuple | list) else f"{published:.4g}"


def rows(plan: Plan) -> Iterator[Row]:
    study = Study(scene_files(plan.scene), plan.side)
    for name in dict.fromkeys(plan.names) or CLAIMS:
        for figure in CLAIMS[name].measure(study):
            yield row_of(name, figure)


def row_of(name: str, figure: Figure) -> Row:
    claim = CLAIMS[name]
    return Row(claim=name, **vars(figure), ratio=figure.ratio, verdict=figure.verdict, source=claim.source, setup=claim.setup,
    sure=claim.sure)


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    """Return the table of numbers, the table of rules (width, order, culling), details of each number, and the sources."""
    compared = [row for row in rows if row.published is not None]
    agree = sum(row.verdict == "agrees" for row in compared)
    numbers = [row for row in rows if row.claim != "rules"]
    first = {row.claim: row for row in rows}
    return [tabled(FOUND, numbers, "Numbers", f"{agree} of {len(compared)} compared numbers agree."),
            *rules_tables([row for row in rows if row.claim == "rules"]),
            tabled(DETAILS, numbers, "Differences and what explains them"), tabled(SOURCES, first.values(), "Sources")]


def rules_of(rows: Sequence[Row]) -> dict[str, dict[tuple[int, str], float]]:
    """Return, for each scene, nodes a ray by width and rules."""
    out: dict[str, dict[tuple[int, str], float]] = {}
    for row in rows:
        _, scene, width, rules = row.what.split(", ", 3)
        out.setdefault(scene, {})[int(width.split()[1]), rules] = row.ours
    return out


def rules_tables(rows: Sequence[Row]) -> list[Part]:
    return [Part(f"Nodes a ray by width, order and culling, {scene}", rows[0].differences.split("; planes")[0] + ".",
                 ("rules", *(f"width {width}" for width in WIDTHS)),
                 [(name, *(f"{found[width, name]:.1f}" for width in WIDTHS)) for name in NAMES.values()])
            for scene, found in rules_of(rows).items()]


def line(row: Row) -> str:
    published = "" if row.published is None else f", published {said(row.published)}: {row.verdict}"
    return f"{row.claim}: {row.what}: {row.ours:.4g} {row.unit}{published}"


def facts(rows: Sequence[Row], plan: Plan) -> dict[str, object]:
    compared = [row for row in rows if row.published is not None]
    return {"compared": len(compared), "agree": sum(row.verdict == "agrees" for row in compared)}


def as_csv(rows: Sequence[Row], plan: Plan, machine: str, suffix: str) -> bytes:
    """Return one line per number; a published range has two ends."""
    out = io.StringIO()
    writer = csv.DictWriter(out, FIELDS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        low, high = row.published if isinstance(row.published, tuple) else (row.published, row.published)
        writer.writerow({**vars(row), "published_low": low, "published_high": high})
    return out.getvalue().encode()


def as_picture(rows: Sequence[Row], plan: Plan, machine: str, suffix: str) -> bytes:
    """Draw a panel for each claim and unit: bars for wrt's numbers, and the published number or range over each bar."""
    panels = list(grouped((row for row in rows if row.claim != "rules"), "claim", "unit").items())
    rules = rules_of([row for row in rows if row.claim == "rules"])
    draw: list[tuple[int, Callable[[Axes], None]]] = [
        (len(group) + 2, lambda axes, key=key, group=group: bars(axes, key[0], key[1], group)) for key, group in panels]  # type: ignore[misc]
    draw += [(10, lambda axes, scene=scene, found=found: curves(axes, scene, found)) for scene, found in rules.items()]  # type: ignore[misc]
    figure = new_figure(12.0, 0.3 * sum(height for height, _ in draw) + 1.0)
    axes = figure.subplots(len(draw), 1, squeeze=False, height_ratios=[height for height, _ in draw])[:, 0]
    for (_, each), place in zip(draw, axes, strict=True):
        each(place)
    from matplotlib import rc_context

    out = io.BytesIO()
    with rc_context({"svg.hashsalt": "wrt"}):
        figure.savefig(out, format=suffix[1:], metadata={"Date": None} if suffix == ".svg" else {"Software": None})
    return out.getvalue()


def bars(axes: Axes, claim: str, unit: str, group: Sequence[Row]) -> None:
    source = group[0].source if any(row.published is not None for row in group) else "wrt's own, beside " + group[0].source
    at = np.arange(len(group))[::-1]
    axes.barh(at, [row.ours for row in group], color=["C0" if row.verdict != "differs" else "C1" for row in group], height=0.6)
    for y, row in zip(at, group, strict=True):
        if row.published is not None:
            low, high = row.published if isinstance(row.published, tuple) else (row.published, row.published)
            axes.fill_betweenx([y - 0.42, y + 0.42], low, high, color="0.2", alpha=0.25, linewidth=0.0)
            axes.vlines([low, high], y - 0.42, y + 0.42, color="k", linewidth=2.0)
        text = f"{row.ours:.3g}" + ("" if row.published is None else f"  (published {said(row.published)})")
        end = max(row.ours, 0.0, *(np.ravel(row.published) if row.published is not None else ()))
        axes.text(end, y, f"  {text}", va="center", fontsize="x-small")
    axes.set_yticks(at, [row.what for row in group], fontsize="x-small")
    axes.margins(x=0.25)
    axes.set_title(f"{claim}: {source}", fontsize="small", loc="left")
    axes.set_xlabel(f"{unit or 'correlation (no unit)'}; black: published", fontsize="x-small")
    axes.tick_params(axis="x", labelsize="x-small")


def curves(axes: Axes, scene: str, found: dict[tuple[int, str], float]) -> None:
    for name in NAMES.values():
        axes.plot(WIDTHS, [found[width, name] for width in WIDTHS], marker="o", label=name)
    axes.set_xticks(WIDTHS)
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"rules: wrt's own, {scene}: width, order of children, culling of popped entries", fontsize="small", loc="left")
    axes.set_xlabel("children of a node (number)", fontsize="x-small")
    axes.set_ylabel("nodes a ray (number)", fontsize="x-small")
    axes.legend(fontsize="x-small")


def check_output(suffix: str) -> None:
    """Raise InputError if matplotlib is missing for a picture."""
    if suffix in (".png", ".svg"):
        new_figure(1.0, 1.0)


WRITERS = {".csv": as_csv, ".png": as_picture, ".svg": as_picture}
