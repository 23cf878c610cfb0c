"""What `bench error` shows: a table for the terminal, and Markdown with a plot for a folder."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from wrt.core.errors import InputError
from wrt.lab.bench.error import Row, Slope, Sweep
from wrt.lab.bench.error_statistics import CONFIDENCE, Estimate
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.picture.image import check_writable, write_codes

COLUMNS = ("setting", "spp", "seconds", "RMSE", "bias", "noise", "relMSE", "FLIP", "efficiency", "front")
SLOPE_COLUMNS = ("setting", "slope of MSE", "slope of noise", "theory")


def number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def interval(x: Estimate) -> str:
    """The value and how far it may be off, as a percentage."""
    if math.isnan(x.value):
        return "-"
    half = 0.5 * (x.high - x.low) / abs(x.value) if x.value else math.nan
    return number(x.value) + ("" if math.isnan(half) else f" ±{100.0 * half:.0f}%")


def cells(row: Row) -> tuple[str, ...]:
    bias = f"< {number(row.bias_below)}" if math.isnan(row.bias) else number(row.bias)
    efficiency = f"{number(row.efficiency.value)} [{number(row.efficiency.low)}, {number(row.efficiency.high)}]"
    return (row.variant.label, str(row.spp), interval(row.seconds), interval(row.rmse), bias, number(row.noise),
            number(row.relmse.value), interval(row.flip), "-" if math.isnan(row.efficiency.value) else efficiency,
            "*" if row.pareto else "")


def slope_cells(slope: Slope) -> tuple[str, ...]:
    def shown(x: Estimate) -> str:
        return "-" if math.isnan(x.value) else f"{x.value:.2f} [{x.low:.2f}, {x.high:.2f}]"

    return slope.variant.label, shown(slope.mse), shown(slope.noise), slope.theory


def notes(sweep: Sweep) -> list[str]:
    """What must be known to read the numbers, a sentence or two each."""
    r, machine = sweep.reference, sweep.machine
    lines = [
        f"{sweep.size[0]}x{sweep.size[1]} pixels, {sweep.repeats} seeds each, on {machine['device']},"
        f" {machine['threads']} threads ({machine['system']}), wrt {machine['wrt']}.",
        f"Reference: the mean (float64) of {r.seeds} seeds of {r.spp} spp, exact Fresnel, max_depth {r.max_depth},"
        f" min_throughput {r.min_throughput:g}, in {r.seconds:.0f} s. Its standard error is {number(r.rmse)} (root mean square"
        f" over the pixels, whose mean is {number(float(r.pixels.mean()))}); {number(r.lost)} of the light was not followed.",
        f"Seconds are of tracing alone. Intervals are {CONFIDENCE:.0%}, from the seeds. The reference's variance is taken out"
        " of RMSE, bias and efficiency, not out of relMSE and FLIP. RMSE^2 = bias^2 + noise^2; < is a bias that noise hides."
        " Efficiency is 1 / (MSE x seconds). * is on the Pareto front: nothing here is faster and as near, to 1%.",
        "Slopes, in theory: -1 for independent samples. For scrambled nets -3 where the integrand is smooth and -1.5 where an"
        " edge crosses it; each pair of dimensions is a net of its own, so that what depends on two pairs at once (pixel and"
        " lens, pixel and light) falls with -1.",
    ]
    if sweep.same_pixels:
        lines.append(f"The same pixels as with the scene as it is, bit for bit: {', '.join(sweep.same_pixels)}.")
    return lines + [f"Left out: {line}." for line in sweep.left_out]


def aligned(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, the others to the right."""
    table = [tuple(header), *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    return ["  ".join(cell.ljust(width) if i == 0 else cell.rjust(width)
                      for i, (cell, width) in enumerate(zip(row, widths, strict=True))).rstrip() for row in table]


def text(sweep: Sweep) -> str:
    """For the terminal."""
    parts = [aligned(COLUMNS, map(cells, sweep.rows)), aligned(SLOPE_COLUMNS, map(slope_cells, sweep.slopes)), notes(sweep)]
    return "\n\n".join("\n".join(lines) for lines in parts)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(header) + " |", "| --- |" + " ---: |" * (len(header) - 1),
            *("| " + " | ".join(cell.replace("*", "\\*") for cell in row) + " |" for row in rows)]


def markdown(sweep: Sweep, picture: str, command: str) -> str:
    """The whole report; `picture` is the plot's file name beside it, `command` what repeats it."""
    lines = [f"# Speed against error: {sweep.scene}", "", f"`{command}`", ""]
    for note in notes(sweep):
        lines += [note.replace("*", "\\*"), ""]
    lines += [f"![Error over seconds]({picture})", "", "## The Pareto front", ""]
    front = sorted((row for row in sweep.rows if row.pareto), key=lambda row: row.seconds.value)
    lines += [*markdown_table(COLUMNS, map(cells, front)), "", "## How fast the error falls", ""]
    lines += ["Log MSE, and log variance alone, over log spp.", ""]
    lines += markdown_table(SLOPE_COLUMNS, map(slope_cells, sweep.slopes))
    lines += ["", "## Everything", "", *markdown_table(COLUMNS, map(cells, sweep.rows))]
    return "\n".join(lines) + "\n"


def plot(sweep: Sweep) -> LogLogPlot:
    """RMSE over seconds: a line a variant, a colour a knob, the Pareto front on top."""
    series = []
    for variant in dict.fromkeys(row.variant.label for row in sweep.rows):
        mine = [row for row in sweep.rows if row.variant.label == variant]
        series.append(Series(mine[0].variant.knob or variant, [(row.seconds.value, row.rmse.value) for row in mine]))
    front = sorted((row.seconds.value, row.rmse.value) for row in sweep.rows if row.pareto)
    return LogLogPlot(sweep.scene, "seconds of tracing", "RMSE (linear radiance)", series, front, "Pareto front")


def report_paths(folder: Path, stem: str) -> dict[str, Path]:
    """Where a report's files go; makes the folder. Raises InputError where nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made: {error.strerror}", folder) from error
    paths = {suffix: folder / f"{stem}_error.{suffix}" for suffix in ("md", "png", "json")}
    check_writable(paths["png"])
    return paths


def write_report(sweep: Sweep, paths: dict[str, Path], command: str) -> None:
    """Markdown, plot and data. Raises InputError where one cannot be written."""
    write_codes(paths["png"], plot(sweep).draw())
    texts = {"md": markdown(sweep, paths["png"].name, command), "json": json.dumps(without_nan(sweep.as_dict()), indent=1)}
    for suffix, content in texts.items():
        try:
            paths[suffix].write_text(content, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", paths[suffix]) from error


def without_nan(value: Any) -> Any:
    """JSON has no NaN and no infinity: they become null."""
    if isinstance(value, dict):
        return {key: without_nan(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
