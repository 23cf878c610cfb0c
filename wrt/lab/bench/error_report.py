"""Results of `bench error`, and their tables for the terminal, a report and a notebook."""

from __future__ import annotations

import math

from wrt.lab.bench.error_statistics import CONFIDENCE, Estimate
from wrt.lab.bench.report import Columns, Part, Row, markdown, tabled, tables_page

BASE = "as it is"
# Slopes of the variance. Independent samples: -1. Scrambled nets: -3 if the integrand is smooth (Owen 1997, "Scrambled Net Variance for
# Integrals of Smooth Functions"). An edge across d dimensions makes it -1 - 1/d (He and Wang 2015, "On the Convergence Rate of Randomized
# Quasi-Monte Carlo for Discontinuous Functions"): -1.5 here. Each pair of dimensions is a net of its own. So whatever depends on two
# pairs at once (pixel and lens, pixel and light) falls as for independent samples.
THEORY = {"independent": "-1", "sobol": "-1 to -3"}


class Sweep(Row):
    """Results of a sweep over knobs.

    - rows: a variant (one knob at one value; None: nothing is turned) at one number of samples; products: statistics.gram of its repeats.
    - rmse: of one picture, without the reference's own error; NaN below that error. rmse^2 = bias^2 + noise^2, root mean squares.
    - bias: NaN if noise hides it; `bias_below` bounds it. efficiency: 1 / (mse x seconds).
    - slopes: of a variant's log mse, and of the log of its variance alone, over log spp.
    - same_pixels: variants with the pixels of the unchanged scene. interrupted: number of the signal that ended the sweep early."""

    def _repr_html_(self) -> str:
        return tables_page(tables(self))


def number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def interval(x: Estimate) -> str:
    """Return the value and half its confidence interval in percent."""
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
    """Return what a reader must know about the figures, a sentence or two each."""
    r, machine = sweep.reference, sweep.machine
    lines = [
        f"{sweep.size[0]}x{sweep.size[1]} pixels, {sweep.repeats} seeds each, on {machine['device']},"
        f" {machine['threads']} threads ({machine['system']}), wrt {machine['wrt']}.",
        f"Reference: the mean (float64) of {r.seeds} seeds of {r.spp_each} spp, exact Fresnel, max_depth {r.max_depth},"
        f" min_throughput {r.min_throughput:g}, in {r.seconds:.0f} s. Its standard error is {number(r.rmse)} (root mean square"
        f" over the pixels, whose mean is {number(r.mean)}); {number(r.lost_throughput_per_sample)} of the light was not followed.",
        f"Seconds are of tracing alone. Intervals are {CONFIDENCE:.0%}, from the seeds. The reference's variance is subtracted from RMSE,"
        " bias and efficiency, not from relMSE and FLIP. RMSE^2 = bias^2 + noise^2; < is a bias that noise hides. Efficiency is"
        " 1 / (MSE x seconds). * is on the Pareto front: nothing else is faster and as accurate, within 1%.",
        "Slopes, in theory: -1 for independent samples. For scrambled nets -3 where the integrand is smooth and -1.5 where an edge"
        " crosses it. Each pair of dimensions is a net of its own: light that depends on two pairs at once (pixel and lens, pixel and"
        " light) falls with -1.",
    ]
    if sweep.same_pixels:
        lines.append(f"The same pixels as with the scene as it is, bit for bit: {', '.join(sweep.same_pixels)}.")
    return lines + [f"Left out: {line}." for line in sweep.left_out]


def tables(sweep: Sweep) -> list[Part]:
    return [tabled(COLUMNS, sweep.rows, f"Speed against error: {sweep.scene}"),
            tabled(SLOPE_COLUMNS, sweep.slopes, "How fast the error falls", "Log MSE, and log variance alone, over log spp.")]


def text(sweep: Sweep) -> str:
    """Return the report as Markdown."""
    return markdown([*tables(sweep), Part("", "\n\n".join(notes(sweep)))]).rstrip()
