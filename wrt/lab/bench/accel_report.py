"""What `bench accel` tells: tables for the terminal and for a file, and plots."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import wrt
from wrt.core.device import describe_devices
from wrt.core.errors import InputError
from wrt.core.html import html_table
from wrt.lab.bench.accel import YARDSTICK, Plan, Refused, Row, growth
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.lab.bench.visibility_report import spread, table
from wrt.picture.image import check_writable, write_codes
from wrt.scene.mesh import Mesh

REPORT = "accel.md"
PLOTS = ("accel-build.png", "accel-memory.png", "accel-growth.png")
COLUMNS = ("structure", "rays", "build ms", "B/triangle", "peak B", "SAH", "depth", "refs", "nodes", "boxes", "triangles", "Mray/s",
           "/ first", "differ", "wrong")
LEGEND = f"""\
build: median of the builds, all cores. B/triangle: of the whole structure, triangles included; peak B: what the process grew by
at the first build, a triangle. SAH: expected nodes and triangles of a random line through the root, costing 1 each. refs:
primitives in all leaves over triangles. nodes, boxes, triangles: fetched and tested, a ray (closest hit). Mray/s: median of the
alternating runs, the middle half of them in brackets; / first: over that of the first structure of the table, run by run. differ:
rays with another prim_id or another bit of t than {YARDSTICK}, of all; wrong: the same against brute force, of as many rays as
2e8 tests allow. Both must be 0."""


def machine(plan: Plan) -> str:
    """Device, threads and how busy the machine is: without them no time means anything."""
    load = f", load average {os.getloadavg()[0]:.1f} at the start" if hasattr(os, "getloadavg") else ""
    runs = f"{plan.runs} runs of {plan.rays} rays"
    return f"{describe_devices()[0]}, {plan.threads} used to search{load}; wrt {wrt.__version__}, {runs}"


def cells(row: Row, first: Row) -> tuple[str, ...]:
    """One line of the table, as COLUMNS names it."""
    return (row.structure, row.kind, f"{1e3 * float(np.median(row.build)):.3g}", f"{row.bytes_per_triangle:.0f}",
            f"{row.peak_bytes / row.triangles:.0f}", f"{row.sah_cost:.3g}", f"{row.depth}",
            f"{row.references / row.triangles:.2f}", f"{row.nodes:.3g}", f"{row.boxes:.3g}",
            f"{row.primitives:.3g}", spread(row.mrays, 1.0), f"{np.median(row.mrays / first.mrays):.2f}", f"{row.differ}",
            f"{row.wrong} of {row.checked}")


def by_mesh(rows: Sequence[Row | Refused]) -> dict[tuple[str, int], list[Row]]:
    out: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        if isinstance(row, Row):
            out.setdefault((row.mesh, row.triangles), []).append(row)
    return out


def markdown(rows: Sequence[Row | Refused], plots: bool = False) -> str:
    """All tables; `plots`: with the pictures of PLOTS, which stand beside the file."""
    parts = []
    for (mesh, triangles), group in by_mesh(rows).items():
        first = {row.kind: row for row in reversed(group)}
        parts.append(f"## {mesh}, {triangles} triangles\n\n{table(COLUMNS, [cells(row, first[row.kind]) for row in group])}\n")
    refused = [row for row in rows if isinstance(row, Refused)]
    if refused:
        parts.append("## Not built\n\n" + "\n".join(f"- {row.structure} over {row.mesh}: {row.reason}" for row in refused) + "\n")
    grown = growth(rows)
    if grown:
        parts.append("## As triangles grow\n\nseconds ~ n^exponent (± one standard deviation); times: last over first.\n")
        parts.append(table(("structure", "mesh", "rays", "cost", "triangles", "exponent", "times"), [
            (g["structure"], g["mesh"], g["kind"], g["cost"], f"{g['from']} to {g['to']}",
             f"{g['exponent']:.3f} ± {g['error']:.3f}", f"{g['times']:.2f}") for g in grown]) + "\n")
    if plots:
        parts += [f"![{name}]({name})\n" for name in PLOTS]
    return "\n".join(parts)


def page(rows: Sequence[Row | Refused]) -> str:
    """The tables as HTML."""
    parts = []
    for (mesh, triangles), group in by_mesh(rows).items():
        first = {row.kind: row for row in reversed(group)}
        parts.append(html_table(f"{mesh}, {triangles} triangles", COLUMNS, [cells(row, first[row.kind]) for row in group]))
    refused = [(row.mesh, row.structure, row.reason) for row in rows if isinstance(row, Refused)]
    return "".join(parts) + (html_table("Not built", ("mesh", "structure", "reason"), refused) if refused else "")


def plot(rows: Sequence[Row | Refused], name: str) -> LogLogPlot:
    """Time to build or memory against time to search (one point a mesh; the last kind of ray that was measured), or the cost of
    a ray as triangles grow."""
    kind = next((row.kind for row in reversed(rows) if isinstance(row, Row)), "")
    series: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if isinstance(row, Row) and row.kind == kind:
            search = float(np.median(row.seconds)) / row.rays * 1e6
            x = {PLOTS[0]: float(np.median(row.build)) / row.triangles * 1e6, PLOTS[1]: row.bytes_per_triangle,
                 PLOTS[2]: float(row.triangles)}[name]
            series.setdefault(row.structure, []).append((x, search))
    label = {PLOTS[0]: "microseconds of build a triangle", PLOTS[1]: "bytes a triangle", PLOTS[2]: "triangles"}[name]
    lines = [Series(structure, sorted(points) if name == PLOTS[2] else points) for structure, points in series.items()]
    return LogLogPlot(f"Structures, {kind} rays", label, "microseconds a ray", lines)


def check_folder(folder: Path) -> None:
    """Make the folder if it is not there; InputError where nothing can be written to it."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"no folder to write to: {error.strerror}", folder) from error
    for name in PLOTS:
        check_writable(folder / name)


def write_report(rows: Sequence[Row | Refused], plan: Plan, folder: Path, told: str) -> list[Path]:
    """Markdown and plots; the paths. told: the line of `machine`. Raises InputError where the system refuses."""
    check_folder(folder)
    names = [Path(mesh.name if isinstance(mesh, Mesh) else mesh).name for mesh in plan.meshes]
    command = " ".join(["python -m wrt bench accel", *names, f"--rays {plan.rays}", f"--runs {plan.runs}",
                        f"--threads {plan.threads}"])
    text = f"# Structures\n\nMachine: {told}\n\nTo repeat: `{command}`\n\n{LEGEND}\n\n{markdown(rows, plots=True)}"
    paths = [folder / REPORT]
    try:
        paths[0].write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", paths[0]) from error
    for name in PLOTS:
        write_codes(folder / name, plot(rows, name).draw())
        paths.append(folder / name)
    return paths
