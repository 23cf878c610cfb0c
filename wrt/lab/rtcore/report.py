"""What the model of the RT core says of some work, as rows of tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from wrt.lab.bench.report import Columns, Part, Row, tabled, tables_page
from wrt.lab.rtcore.model import TERMS, Work, predict, sensitivity, span, sweep
from wrt.lab.rtcore.parameters import PARAMETERS, SWEEPS, Gpu

RANGE = ("boxes", "triangles", "warps")  # what the reported range is swept over
def term(name: str) -> Callable[[Row], str]:
    return lambda row: f"{row.clocks[name]:.3g} ({row.utilisation[name]:.0%})"


MODEL_COLUMNS: Columns = {
    "rays": "{name}", "nodes": "{nodes:.1f}", "boxes": "{boxes:.1f}", "triangles": "{triangles:.1f}", "lines": "{lines:.1f}",
    **{name: term(name) for name in TERMS}, "limit": "{limit}", "Grays/s": lambda row: f"{row.rays_per_second / 1e9:.2f}",
    "range": lambda row: f"{row.low / 1e9:.2f} to {row.high / 1e9:.2f}",
    "moved most by": lambda row: ", ".join(f"{name} {factor:.2g}x" for name, factor in list(row.factors.items())[:2])}
SIMT_COLUMNS: Columns = {
    "rays": "{name}", **{name: f"{{simt_efficiency[{name}]:.0%}}" for name in ("as they come", "packed", "sorted")}}
PARAMETER_COLUMNS: Columns = {"parameter": "{name}", "value": "{value}", "status": "{status}", "swept over": "{range}",
                              "source": "{source}"}
LEGEND = f"""\
nodes, boxes, triangles: a ray; lines: cache lines a ray that its warp asks for. {", ".join(TERMS)}: clocks a ray and RT core that
each part needs by itself, and in brackets how busy it is while the slowest (limit) is at its limit. Grays/s: with the assumptions
of the table of parameters (4 boxes or 1 triangle a clock, 4 warps at a time, L2 empty); range: over {", ".join(RANGE)} =
{"; ".join(", ".join(f"{value:g}" for value in SWEEPS[name]) for name in RANGE)}. moved most by: the assumptions that move the
Grays/s most when each is swept alone, with the factor from the least to the most. None of this is a measurement: Turing's rates
and its node format were never published."""


def model_row(work: Work, gpu: Gpu, simt: dict[str, float], **facts: Any) -> Row:
    """Everything that the model says of this work: clocks, limit, utilisation and rays_per_second with the basic assumptions; low,
    high: rays a second over RANGE; factors: of each assumption alone; nodes, boxes, triangles, lines: a ray. simt: as
    wrt.lab.rtcore.model.simt gives it; facts: more that is known of it."""
    p = predict(work, gpu)
    low, high = span(sweep(work, gpu, names=RANGE))
    return Row(**facts, name=work.name, rays=len(work), nodes=work.mean("nodes"), boxes=work.mean("boxes"),
               triangles=work.mean("primitives"), lines=work.misses(gpu, p.core).accesses / len(work), gpu=gpu.name, clocks=p.terms,
               limit=p.bottleneck, utilisation=p.utilisation, rays_per_second=p.rays_per_second, low=low, high=high,
               factors=sensitivity(work, gpu), simt_efficiency=simt, _prediction=p)


def model_page(rows: Sequence[Row]) -> str:
    """Both tables as HTML."""
    gpu = rows[0].gpu if rows else "a GPU"
    return tables_page([tabled(MODEL_COLUMNS, rows, f"Model of {gpu}"), tabled(SIMT_COLUMNS, rows, "SIMT efficiency")])


def parameters() -> Part:
    """Every number that the model starts from, with its status and source."""
    return tabled(PARAMETER_COLUMNS, PARAMETERS, "The parameters of the model")
