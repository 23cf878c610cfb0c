"""What `bench visibility` tells: tables for the terminal and for a file, and plots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from wrt.core.device import thread_count
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.lab.bench.report import Part, markdown, write
from wrt.lab.bench.report import machine as machine_line
from wrt.lab.bench.timing import spread
from wrt.lab.bench.visibility import Plan, Row, crossings, fits, series

REPORT = "visibility.md"
PLOTS = {"visibility-triangles.png": "triangles", "visibility-pixels.png": "pixels"}
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
    threads = f"{thread_count(plan.threads)} used" if plan.device == "cpu" else ""
    return machine_line(threads, f"structure {plan.accel}, {plan.runs} runs", device=plan.device)


def cells(row: Row) -> tuple[str, ...]:
    """One line of the table, as COLUMNS names it."""
    a = row.agreement
    return (Path(row.surface).name, f"{row.triangles}", f"{row.pixels}", f"{a.covered / a.pixels:.1%}",
            spread(row.raster, 1e3), spread(row.cast, 1e3), f"{1e3 * float(np.median(row.build)):.3g}",
            spread(row.ratios(False)), f"{np.median(row.ratios(True)):.3g}",
            f"{a.differ}", f"{a.ties}", f"{a.silhouettes}", f"{a.unexplained}", f"{a.depth_error:.1e}", f"{a.depth_share:.2f}")


def line(row: Row) -> str:
    """For the progress."""
    return "  ".join(cells(row)[:8])


def parts(rows: Sequence[Row], plots: bool = False) -> list[Part]:
    """All tables; `plots`: with the pictures of PLOTS, which stand beside the file."""
    out = []
    for name, sweep in PLOTS.items():
        lines = [cells(row) for key, group in series(rows).items() if key[0] == sweep for row in group]
        if lines:
            out.append(Part(f"As {sweep} grow", "", COLUMNS, lines, name if plots else ""))
    found = fits(rows)
    if found:
        told = "seconds ~ n^exponent over the whole sweep (± one standard deviation), and between its two last points."
        out.append(Part("Exponents", told, ("cost", "surface", "n", "exponent", "at the end"), [
            (f["cost"], Path(f["surface"]).name, f["sweep"], f"{f['exponent']:.3f} ± {f['error']:.3f}", f"{f['last']:.3f}")
            for f in found]))
    for c in crossings(rows):
        since = "throughout" if c["n"] is None else f"from about {c['n']:.2g} {c['sweep']} on"
        out.append(Part("", f"{Path(c['surface']).name}, as {c['sweep']} grow: {c['cheaper']} costs less {since}."))
    return out


def text(rows: Sequence[Row], machine: str) -> str:
    """For the terminal."""
    return f"{machine}\n\n{markdown(parts(rows))}\n{LEGEND}"


def data(rows: Sequence[Row]) -> dict[str, object]:
    """For JSON."""
    return {"rows": [row.as_dict() for row in rows], "exponents": fits(rows), "crossings": crossings(rows)}


def plot(rows: Sequence[Row], sweep: str) -> LogLogPlot:
    """Medians over what grows; on the sweep over triangles also with the build."""
    costs: dict[str, Callable[[Row], float]] = {
        "raster": lambda row: float(np.median(row.raster)), "cast": lambda row: float(np.median(row.cast))}
    if sweep == "triangles":
        costs["build + cast"] = lambda row: float(np.median(row.cast) + np.median(row.build))
    lines = [Series(f"{Path(surface).name}: {name}", [(float(getattr(row, sweep)), cost(row)) for row in group])
             for (which, surface), group in series(rows).items() if which == sweep for name, cost in costs.items()]
    other = "pixels" if sweep == "triangles" else "triangles"
    held = sorted({getattr(row, other) for row in rows if row.sweep == sweep})
    return LogLogPlot(f"Primary visibility, {' or '.join(map(str, held))} {other}", sweep, "seconds a picture", lines)


def write_report(rows: Sequence[Row], plan: Plan, folder: Path, machine: str) -> list[Path]:
    """Markdown and plots; the paths. Raises InputError where the system refuses."""
    command = " ".join(["python -m wrt bench visibility", *map(str, plan.meshes), f"--size {plan.size}",
                        f"--max-size {plan.max_size}", f"--max-triangles {plan.max_triangles}", f"--runs {plan.runs}"])
    text = f"# Rasterising against ray casting\n\nMachine: {machine}\n\nTo repeat: `{command}`\n\n{LEGEND}\n\n"
    return write(folder / REPORT, text + markdown(parts(rows, plots=True)),
                 {name: plot(rows, sweep) for name, sweep in PLOTS.items()})
