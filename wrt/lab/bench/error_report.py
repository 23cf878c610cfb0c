"""What `bench error` shows: a table for the terminal, and Markdown with a plot for a folder."""

from __future__ import annotations

from pathlib import Path

from wrt.core.json_text import json_text
from wrt.lab.bench.error_rows import COLUMNS, SLOPE_COLUMNS, Sweep, cells, number, slope_cells
from wrt.lab.bench.error_statistics import CONFIDENCE
from wrt.lab.bench.plot import LogLogPlot, Series
from wrt.lab.bench.report import Part, check_folder, table, write
from wrt.lab.bench.report import markdown as as_markdown


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


def text(sweep: Sweep) -> str:
    """For the terminal."""
    tables = table(COLUMNS, [*map(cells, sweep.rows)]), table(SLOPE_COLUMNS, [*map(slope_cells, sweep.slopes)])
    return "\n\n".join([*tables, "\n".join(notes(sweep))])


def markdown(sweep: Sweep, picture: str, command: str) -> str:
    """The whole report; `picture` is the plot's file name beside it, `command` what repeats it."""
    front = sorted((row for row in sweep.rows if row.pareto), key=lambda row: row.seconds.value)
    told = "\n\n".join([f"`{command}`", *(note.replace("*", "\\*") for note in notes(sweep))])
    return as_markdown([
        Part(f"Speed against error: {sweep.scene}", told), Part("Error over seconds", plot=picture),
        Part("The Pareto front", "", COLUMNS, [*map(cells, front)]),
        Part("How fast the error falls", "Log MSE, and log variance alone, over log spp.", SLOPE_COLUMNS,
             [*map(slope_cells, sweep.slopes)]),
        Part("Everything", "", COLUMNS, [*map(cells, sweep.rows)])])


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
    paths = {suffix: folder / f"{stem}_error.{suffix}" for suffix in ("md", "png", "json")}
    check_folder(folder, [paths["png"].name], parents=True)
    return paths


def write_report(sweep: Sweep, paths: dict[str, Path], command: str) -> None:
    """Markdown, plot and data. Raises InputError where one cannot be written."""
    picture = paths["png"].name
    write(paths["md"], markdown(sweep, picture, command), {picture: plot(sweep)})
    write(paths["json"], json_text(sweep.as_dict(), indent=1), {})
