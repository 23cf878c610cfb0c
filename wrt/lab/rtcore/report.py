"""What the model of the RT core says of some work, as rows of tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from wrt.core.html import html_table
from wrt.lab.bench.report import table
from wrt.lab.rtcore.model import TERMS, Prediction, Work, predict, sensitivity, span, sweep
from wrt.lab.rtcore.parameters import PARAMETERS, SWEEPS, Gpu

RANGE = ("boxes", "triangles", "warps")  # what the reported range is swept over
COLUMNS = ("rays", "nodes", "boxes", "triangles", "lines", *TERMS, "limit", "Grays/s", "range", "moved most by")
SIMT_COLUMNS = ("rays", "as they come", "packed", "sorted")
LEGEND = f"""\
nodes, boxes, triangles: a ray; lines: cache lines a ray that its warp asks for. {", ".join(TERMS)}: clocks a ray and RT core that
each part needs by itself, and in brackets how busy it is while the slowest (limit) is at its limit. Grays/s: with the assumptions
of the table of parameters (4 boxes or 1 triangle a clock, 4 warps at a time, L2 empty); range: over {", ".join(RANGE)} =
{"; ".join(", ".join(f"{value:g}" for value in SWEEPS[name]) for name in RANGE)}. moved most by: the assumptions that move the
Grays/s most when each is swept alone, with the factor from the least to the most. None of this is a measurement: Turing's rates
and its node format were never published."""


@dataclass(frozen=True)
class ModelRow:
    """prediction: with the basic assumptions; low, high: rays a second over RANGE; factors: of each assumption alone; simt: SIMT
    efficiencies; nodes, boxes, triangles, lines: a ray."""

    name: str
    rays: int
    nodes: float
    boxes: float
    triangles: float
    lines: float
    prediction: Prediction
    low: float
    high: float
    factors: dict[str, float]
    simt: dict[str, float]

    def as_dict(self) -> dict[str, object]:
        p = self.prediction
        return {"name": self.name, "rays": self.rays, "nodes": self.nodes, "boxes": self.boxes, "triangles": self.triangles,
                "lines": self.lines, "gpu": p.gpu.name, "clocks": p.terms, "limit": p.bottleneck, "utilisation": p.utilisation,
                "rays_per_second": p.rays_per_second, "low": self.low, "high": self.high, "factors": self.factors,
                "simt_efficiency": self.simt}


def model_row(work: Work, gpu: Gpu, simt: dict[str, float]) -> ModelRow:
    """Everything that the model says of this work; simt: as wrt.lab.rtcore.model.simt gives it."""
    prediction = predict(work, gpu)
    low, high = span(sweep(work, gpu, names=RANGE))
    lines = work.misses(gpu, prediction.core).accesses / len(work)
    return ModelRow(work.name, len(work), work.mean("nodes"), work.mean("boxes"), work.mean("primitives"), lines, prediction, low,
                    high, sensitivity(work, gpu), simt)


def cells(row: ModelRow) -> tuple[str, ...]:
    p = row.prediction
    terms = [f"{p.terms[name]:.3g} ({p.utilisation[name]:.0%})" for name in TERMS]
    most = ", ".join(f"{name} {factor:.2g}x" for name, factor in list(row.factors.items())[:2])
    return (row.name, f"{row.nodes:.1f}", f"{row.boxes:.1f}", f"{row.triangles:.1f}", f"{row.lines:.1f}", *terms, p.bottleneck,
            f"{p.rays_per_second / 1e9:.2f}", f"{row.low / 1e9:.2f} to {row.high / 1e9:.2f}", most)


def model_table(rows: Sequence[ModelRow]) -> str:
    return table(COLUMNS, [cells(row) for row in rows])


def simt_cells(row: ModelRow) -> tuple[str, ...]:
    return (row.name, *(f"{row.simt[name]:.0%}" for name in SIMT_COLUMNS[1:]))


def simt_table(rows: Sequence[ModelRow]) -> str:
    return table(SIMT_COLUMNS, [simt_cells(row) for row in rows])


def model_page(rows: Sequence[ModelRow]) -> str:
    """Both tables as HTML."""
    gpu = rows[0].prediction.gpu.name if rows else "a GPU"
    return html_table(f"Model of {gpu}", COLUMNS, map(cells, rows)) + html_table(
        "SIMT efficiency", SIMT_COLUMNS, map(simt_cells, rows))


def parameter_table() -> str:
    """Every number that the model starts from, with its status and source."""
    columns = ("parameter", "value", "status", "swept over", "source")
    return table(columns, [(p.name, p.value, p.status, p.range, p.source) for p in PARAMETERS])
