"""The bar chart that `bench peers -o` writes."""

from collections.abc import Sequence
from statistics import geometric_mean

from wrt.lab.bench.plot import bars
from wrt.lab.bench.report import Row, grouped
from wrt.lab.plans import Peers as Plan

KINDS = {"primary": "primary rays", "shadow": "any hit: shadow rays", "diffuse": "bounce: diffuse rays", "random": "random rays",
         "points": "closest points", "tiles": "64x64 pixels in many worlds"}


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
    return bars(panels, f"Nanoseconds a ray or point; {where}; less is better", suffix)
