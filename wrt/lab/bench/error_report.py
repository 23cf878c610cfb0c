"""Results of `bench error`, and their tables for the terminal, a report and a notebook."""

import math

from wrt.lab.bench.error_statistics import CONFIDENCE, Estimate
from wrt.lab.bench.report import Columns, Part, Row, markdown, tabled, tables_page

BASE = "as it is"
# Slopes of log variance over log spp. Independent samples have -1. Scrambled nets have -3 if the integrand is smooth (Owen 1997,
# "Scrambled Net Variance for Integrals of Smooth Functions"). They have -1 - 1/d if an edge crosses d dimensions (He and Wang 2015, "On
# the Convergence Rate of Randomized Quasi-Monte Carlo for Discontinuous Functions"). Here d is 2: each pair of dimensions is a net by
# itself. An integrand that depends on two pairs at once (pixel and lens, pixel and light) has -1, as for independent samples.
THEORY = {"independent": "-1", "sobol": "-1 to -3"}


class Sweep(Row):
    """Results of a sweep over knobs.

    - rows: one row for each variant and spp (samples per pixel); knob None: the unchanged scene; products: `gram` of the row's pictures.
    - rmse: square root of one picture's mean squared error less the reference's variance; NaN unless this difference is above 0.
    - bias: root mean square bias, NaN if noise hides it; bias_below: its upper bound. rmse^2 = bias^2 + noise^2.
    - efficiency: 1 / (mse x seconds). slopes: for each variant, the slopes of log mse and of log variance over log spp.
    - same_pixels: variants whose pixels equal those of the unchanged scene. interrupted: number of the signal that ended the sweep."""

    def _repr_html_(self) -> str:
        return tables_page(tables(self))


def number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def interval(x: Estimate) -> str:
    """Format a value, and half the width of its confidence interval in percent of the value."""
    if math.isnan(x.value):
        return "-"
    half = 0.5 * (x.high - x.low) / abs(x.value) if x.value else math.nan
    return number(x.value) + ("" if math.isnan(half) else f" ±{100.0 * half:.0f}%")


def range_of(x: Estimate, digits: str) -> str:
    return "-" if math.isnan(x.value) else f"{x.value:{digits}} [{x.low:{digits}}, {x.high:{digits}}]"


COLUMNS: Columns = {
    "setting": "{variant}", "spp": "{spp}", "seconds": lambda row: interval(row.seconds), "RMSE": lambda row: interval(row.rmse),
    "bias": lambda row: f"< {number(row.bias_below)}" if math.isnan(row.bias) else number(row.bias),
    "noise": lambda row: number(row.noise), "relMSE": lambda row: number(row.relmse.value), "FLIP": lambda row: interval(row.flip),
    "efficiency": lambda row: range_of(row.efficiency, ".3g"), "front": lambda row: "*" if row.pareto else ""}
SLOPE_COLUMNS: Columns = {"setting": "{variant}", "slope of MSE": lambda slope: range_of(slope.mse, ".2f"),
                          "slope of noise": lambda slope: range_of(slope.noise, ".2f"), "theory": "{theory}"}


def notes(sweep: Sweep) -> list[str]:
    """Return paragraphs that explain how the figures were measured."""
    r, machine = sweep.reference, sweep.machine
    lines = [
        f"{sweep.size[0]}x{sweep.size[1]} pixels, {sweep.repeats} seeds each, on {machine['device']},"
        f" {machine['threads']} threads ({machine['system']}), wrt {machine['wrt']}.",
        f"Reference: the mean (float64) of {r.seeds} pictures with {r.spp_each} spp each, exact Fresnel, max_depth {r.max_depth},"
        f" min_throughput {r.min_throughput:g}, rendered in {r.seconds:.0f} s. Its standard error is {number(r.rmse)} (root mean square"
        f" over the pixels, whose mean is {number(r.mean)}). Cut rays had {number(r.lost_throughput_per_sample)} of the throughput.",
        f"Seconds are those of tracing alone. The seeds give {CONFIDENCE:.0%} confidence intervals. RMSE, bias and efficiency exclude the"
        " reference's variance; relMSE and FLIP include it. RMSE^2 = bias^2 + noise^2. A bias with < is an upper bound, because noise"
        " hides the bias. Efficiency is 1 / (MSE x seconds). front: * marks the Pareto front; no other row is as fast and more accurate"
        " by over 1%.",
        "Theory of the slopes: -1 for independent samples. Scrambled nets have -3 if the integrand is smooth and -1.5 if an edge"
        " crosses it. Each pair of dimensions is a net by itself: light that depends on two pairs (pixel and lens, pixel and light) has"
        " -1.",
    ]
    if sweep.same_pixels:
        lines.append(f"Pixels equal to those of the unchanged scene, bit for bit: {', '.join(sweep.same_pixels)}.")
    return lines + [f"Left out: {line}." for line in sweep.left_out]


def tables(sweep: Sweep) -> list[Part]:
    return [tabled(COLUMNS, sweep.rows, f"Speed against error: {sweep.scene}"),
            tabled(SLOPE_COLUMNS, sweep.slopes, "Slopes of the error", "Slopes of log MSE, and of log variance (noise), over log spp.")]


def text(sweep: Sweep) -> str:
    """Return the report as Markdown."""
    return markdown([*tables(sweep), Part("", "\n\n".join(notes(sweep)))]).rstrip()
