"""What `bench visibility` tells: tables for the terminal and for a file, and plots."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import wrt
from wrt.core.device import describe_devices, thread_count
from wrt.core.errors import InputError
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.lab.bench.visibility import Plan, Row, crossings, fits, series
from wrt.picture.image import check_writable, write_codes

REPORT = "visibility.md"
PLOTS = {"triangles": "visibility-triangles.png", "pixels": "visibility-pixels.png"}
COLUMNS = ("surface", "triangles", "pixels", "covered", "raster ms", "cast ms", "build ms", "cast / raster", "with build", "differ",
           "ties", "silhouettes", "unexplained", "depth error", "of bound")
LEGEND = """\
covered: pixels with a triangle. raster: a z-buffer, all triangles; cast: one ray a pixel through a structure that is there;
build: of that structure. Medians of alternating runs, ratios taken run by run; in brackets the middle half of the runs. cast /
raster above 1: rasterising is cheaper; with build: as if the structure were built for this one picture. differ: pixels with
another prim_id, of which ties (depths agree within their bound: common edges, coincident triangles), silhouettes (the rays'
answer is the exact one within a rounding error, some 1e-4 pixels, of the centre), and unexplained (must be 0). depth error: the
largest relative one where prim_id agrees, and its share of the bound derived for it (must not be above 1)."""


def machine(plan: Plan) -> str:
    """Device, threads and how busy the machine is: without them no time means anything."""
    name = next((line for line in describe_devices() if line.startswith(plan.device + ":")), plan.device)
    load = f", load average {os.getloadavg()[0]:.1f} at the start" if hasattr(os, "getloadavg") else ""
    threads = f", {thread_count(plan.threads)} used" if plan.device == "cpu" else ""
    return f"{name}{threads}{load}; wrt {wrt.__version__}, structure {plan.accel}, {plan.runs} runs"


def spread(values: Any, scale: float, digits: int = 3) -> str:
    """Median, and the quartiles in brackets."""
    low, middle, high = (float(x) * scale for x in np.quantile(values, (0.25, 0.5, 0.75)))
    return f"{middle:.{digits}g} [{low:.{digits}g}, {high:.{digits}g}]"


def cells(row: Row) -> tuple[str, ...]:
    """One line of the table, as COLUMNS names it."""
    a = row.agreement
    return (Path(row.surface).name, f"{row.triangles}", f"{row.pixels}", f"{a.covered / a.pixels:.1%}",
            spread(row.raster, 1e3), spread(row.cast, 1e3), f"{1e3 * float(np.median(row.build)):.3g}",
            spread(row.ratios(False), 1.0), f"{np.median(row.ratios(True)):.3g}",
            f"{a.differ}", f"{a.ties}", f"{a.silhouettes}", f"{a.unexplained}", f"{a.depth_error:.1e}", f"{a.depth_share:.2f}")


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose columns are also straight as plain text; numbers to the right."""
    texts = [[str(cell).replace("|", "\\|") for cell in line] for line in (head, *lines)]
    width = [max(len(line[i]) for line in texts) for i in range(len(head))]

    def text(line: Sequence[str]) -> str:
        padded = [cell.ljust(width[i]) if i == 0 else cell.rjust(width[i]) for i, cell in enumerate(line)]
        return f"| {' | '.join(padded)} |"

    rule = [":" + "-" * (width[0] - 1), *("-" * (w - 1) + ":" for w in width[1:])]
    return "\n".join([text(texts[0]), text(rule), *map(text, texts[1:])])


def markdown(rows: Sequence[Row], plots: bool = False) -> str:
    """All tables; `plots`: with the pictures of PLOTS, which stand beside the file."""
    parts = []
    for sweep in ("triangles", "pixels"):
        lines = [cells(row) for key, group in series(rows).items() if key[0] == sweep for row in group]
        if lines:
            parts.append(f"## As {sweep} grow\n\n{table(COLUMNS, lines)}\n")
            if plots:
                parts.append(f"![cost over {sweep}]({PLOTS[sweep]})\n")
    found = fits(rows)
    if found:
        parts.append("## Exponents\n\nseconds ~ n^exponent over the whole sweep (± one standard deviation), and "
                     "between its two last points.\n")
        parts.append(table(("cost", "surface", "n", "exponent", "at the end"), [
            (f["cost"], Path(f["surface"]).name, f["sweep"], f"{f['exponent']:.3f} ± {f['error']:.3f}", f"{f['last']:.3f}")
            for f in found]) + "\n")
    for c in crossings(rows):
        since = "throughout" if c["n"] is None else f"from about {c['n']:.2g} {c['sweep']} on"
        parts.append(f"{Path(c['surface']).name}, as {c['sweep']} grow: {c['cheaper']} costs less {since}.\n")
    return "\n".join(parts)


def plot(rows: Sequence[Row], sweep: str) -> LogLogPlot:
    """Medians over what grows; on the sweep over triangles also with the build."""
    lines = []
    for (which, surface), group in series(rows).items():
        if which != sweep:
            continue
        name = Path(surface).name
        costs = {f"{name}: raster": lambda row: np.median(row.raster), f"{name}: cast": lambda row: np.median(row.cast)}
        if sweep == "triangles":
            costs[f"{name}: build + cast"] = lambda row: np.median(row.cast) + np.median(row.build)
        lines += [Series(label, [(float(getattr(row, sweep)), float(cost(row))) for row in group])
                  for label, cost in costs.items()]
    held = {row.pixels if sweep == "triangles" else row.triangles for row in rows if row.sweep == sweep}
    what = f"{' or '.join(map(str, sorted(held)))} {'pixels' if sweep == 'triangles' else 'triangles'}"
    return LogLogPlot(f"Primary visibility, {what}", sweep, "seconds a picture", lines)


def check_folder(folder: Path) -> None:
    """Make the folder if it is not there; InputError where nothing can be written to it."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"no folder to write to: {error.strerror}", folder) from error
    for name in PLOTS.values():
        check_writable(folder / name)


def write_report(rows: Sequence[Row], plan: Plan, folder: Path, told: str) -> list[Path]:
    """Markdown and plots; the paths. told: the line of `machine`. Raises InputError where the system refuses."""
    check_folder(folder)
    command = " ".join(["python -m wrt bench visibility", *map(str, plan.meshes), f"--size {plan.size}",
                        f"--max-size {plan.max_size}", f"--max-triangles {plan.max_triangles}", f"--runs {plan.runs}"])
    text = (f"# Rasterising against ray casting\n\nMachine: {told}\n\nTo repeat: `{command}`\n\n{LEGEND}\n\n"
            f"{markdown(rows, plots=True)}")
    paths = [folder / REPORT]
    try:
        paths[0].write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", paths[0]) from error
    for sweep, name in PLOTS.items():
        write_codes(folder / name, plot(rows, sweep).draw())
        paths.append(folder / name)
    return paths
