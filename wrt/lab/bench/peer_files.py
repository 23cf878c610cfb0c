"""Files that `bench peers -o` writes besides Markdown: the figures as CSV, and a bar chart by kind of ray."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from statistics import geometric_mean

from wrt.lab.bench.plot import bars, new_figure
from wrt.lab.bench.report import Row, grouped, repeating
from wrt.lab.plans import Peers as Plan

FIELDS = ("mesh", "triangles", "kind", "threads", "library", "mode", "ns", "ratio", "differ", "rays")
KINDS = {"primary": "primary rays", "shadow": "any hit: shadow rays", "diffuse": "bounce: diffuse rays", "random": "random rays",
         "points": "closest points", "tiles": "64x64 pixels in many worlds"}


def check_output(suffix: str) -> None:
    """Raise InputError if a file with this suffix cannot be made here: charts need matplotlib."""
    if suffix in (".svg", ".png"):
        new_figure(1.0, 1.0)


def figures(rows: Sequence[Row], plan: Plan, machine: str, suffix: str) -> bytes:
    """Return the figures as CSV, with lines that begin with # for the command and the machine. Docs' plots read such files."""
    text = io.StringIO()
    text.write(f"# ns: median nanoseconds a ray or point; ratio: speed of wrt over the library's\n# command: {repeating(plan)}\n"
               f"# machine: {machine}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(FIELDS)
    for row in rows:
        writer.writerow([row.mesh, row.triangles, row.kind, row.threads, row.library, row.name, f"{row.ns:.4g}", f"{row.first_over_it:.3f}",
                         row.differ, row.rays])
    return text.getvalue().encode()


def chart(rows: Sequence[Row], plan: Plan, machine: str, suffix: str) -> bytes:
    """Return a picture: a panel for each kind of ray, a bar for each library in its best mode; fewest threads, geometric means over the
    meshes."""
    fewest = min(row.threads for row in rows)
    best: dict[tuple[str, str], list[float]] = {}
    used = [row for row in rows if row.threads == fewest]
    for (_, _, kind, library), modes in grouped(used, "mesh", "triangles", "kind", "library").items():
        best.setdefault((kind, library), []).append(min(row.ns for row in modes))
    panels: dict[str, dict[str, float]] = {}
    for (kind, library), each in best.items():
        panels.setdefault(KINDS[kind], {})[library] = geometric_mean(each)
    where = f"{fewest} thread{'s' if fewest > 1 else ''}" if plan.device == "cpu" else plan.device
    return bars(panels, f"Nanoseconds a ray or point; {where}; less is better", suffix.removeprefix("."))
