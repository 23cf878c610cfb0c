"""What `bench accel` tells: tables for the terminal and for a file, and plots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wrt.lab.bench.accel import YARDSTICK, Plan, Refused, Row, growth, parts
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.lab.bench.report import Part, markdown, write
from wrt.lab.bench.report import machine as machine_line
from wrt.scene.mesh import Mesh

REPORT = "accel.md"
AXES = {"accel-build.png": "microseconds of build a triangle", "accel-memory.png": "bytes a triangle",
        "accel-growth.png": "triangles"}
PLOTS = tuple(AXES)
LEGEND = f"""\
build: median of the builds, all cores. B/triangle: of the whole structure, triangles included; peak B: what the process grew by
at the first build, a triangle. SAH: expected nodes and triangles of a random line through the root, costing 1 each. refs:
primitives in all leaves over triangles. nodes, boxes, triangles: fetched and tested, a ray (closest hit). Mray/s: median of the
alternating runs, the middle half of them in brackets; / first: over that of the first structure of the table, run by run. differ:
rays with another prim_id or another bit of t than {YARDSTICK}, of all; wrong: the same against brute force, of as many rays as
2e8 tests allow. Both must be 0."""


def machine(plan: Plan) -> str:
    return machine_line(f"{plan.threads} used to search", f"{plan.runs} runs of {plan.rays} rays")


def line(row: Row | Refused) -> str:
    """For the progress."""
    if isinstance(row, Refused):
        return f"{row.mesh}: {row.structure}: {row.reason}"
    return f"{row.mesh}: {row.structure}, {row.kind} rays: {np.median(row.mrays):.3g} Mray/s, {row.differ} differ"


def text(rows: Sequence[Row | Refused], machine: str) -> str:
    """For the terminal."""
    return f"{machine}\n\n{markdown(parts(rows))}\n{LEGEND}"


def data(rows: Sequence[Row | Refused]) -> dict[str, object]:
    """For JSON."""
    return {"rows": [row.as_dict() for row in rows if isinstance(row, Row)],
            "refused": [vars(row) for row in rows if isinstance(row, Refused)], "growth": growth(rows)}


def plot(rows: Sequence[Row | Refused], name: str) -> LogLogPlot:
    """Time to build or memory against time to search (one point a mesh; the last kind of ray that was measured), or the cost of
    a ray as triangles grow."""
    kind = next((row.kind for row in reversed(rows) if isinstance(row, Row)), "")
    series: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if isinstance(row, Row) and row.kind == kind:
            search = float(np.median(row.seconds)) / row.rays * 1e6
            x = (float(np.median(row.build)) / row.triangles * 1e6, row.bytes_per_triangle, float(row.triangles))
            series.setdefault(row.structure, []).append((x[PLOTS.index(name)], search))
    lines = [Series(structure, sorted(points) if name == PLOTS[2] else points) for structure, points in series.items()]
    return LogLogPlot(f"Structures, {kind} rays", AXES[name], "microseconds a ray", lines)


def write_report(rows: Sequence[Row | Refused], plan: Plan, folder: Path, machine: str) -> list[Path]:
    """Markdown and plots; the paths. Raises InputError where the system refuses."""
    names = [Path(mesh.name if isinstance(mesh, Mesh) else mesh).name for mesh in plan.meshes]
    command = " ".join(["python -m wrt bench accel", *names, f"--rays {plan.rays}", f"--runs {plan.runs}",
                        f"--threads {plan.threads}"])
    text = f"# Structures\n\nMachine: {machine}\n\nTo repeat: `{command}`\n\n{LEGEND}\n\n"
    return write(folder / REPORT, text + markdown([*parts(rows), *(Part(name, plot=name) for name in PLOTS)]),
                 {name: plot(rows, name) for name in PLOTS})
