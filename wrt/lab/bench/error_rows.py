"""What `bench error` finds: variants, the truth, rows, slopes, and all of it; and what of them stands in tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wrt.core.html import html_table
from wrt.lab.bench.error_statistics import CONFIDENCE, Estimate
from wrt.renderer.options import Options
from wrt.scene.model import Scene

BASE = "as it is"
COLUMNS = ("setting", "spp", "seconds", "RMSE", "bias", "noise", "relMSE", "FLIP", "efficiency", "front")
SLOPE_COLUMNS = ("setting", "slope of MSE", "slope of noise", "theory")
# Of the variance. Independent samples: -1. Scrambled nets: -3 where the integrand is smooth (Owen 1997, "Scrambled Net Variance
# for Integrals of Smooth Functions"), -1 - 1/d where an edge crosses d dimensions (He and Wang 2015, "On the Convergence Rate
# of Randomized Quasi-Monte Carlo for Discontinuous Functions"): -1.5 here. Each pair of dimensions is a net by itself, so that
# what depends on two pairs at once (pixel and lens, pixel and light) falls as for independent samples.
THEORY = {"independent": "-1", "sobol": "-1 to -3"}


@dataclass(frozen=True)
class Variant:
    """One knob at one value (knob "" and value None: none is turned), ready to be rendered with."""

    knob: str
    value: Any
    scene: Scene
    options: Options

    @property
    def label(self) -> str:
        return f"{self.knob} = {self.value}" if self.knob else BASE


@dataclass(frozen=True)
class Reference:
    """What counts as the truth. pixels: (H, W, 3) float64, the mean over independent seeds; variance: of that mean, averaged
    over pixels and channels; lost: the share of light that was not followed (a bound on what its own cuts may hide)."""

    pixels: np.ndarray
    variance: float
    lost: float
    seeds: int
    spp: int
    max_depth: int
    min_throughput: float
    seconds: float

    @property
    def rmse(self) -> float:
        return float(np.sqrt(self.variance))

    def as_dict(self) -> dict[str, Any]:
        return {"rmse": self.rmse, "lost_throughput_per_sample": self.lost, "seeds": self.seeds, "spp_each": self.spp,
                "max_depth": self.max_depth, "min_throughput": self.min_throughput, "seconds": self.seconds,
                "mean": float(self.pixels.mean())}


@dataclass
class Row:
    """One variant at one number of samples.

    products: of the repeats' errors (statistics.gram). rmse: of one picture, the reference's own error taken out; NaN where
    it is below that. bias, noise: root mean squares over the pixels, rmse^2 = bias^2 + noise^2; bias is NaN where it cannot
    be told from noise, and `bias_below` bounds it. efficiency: 1 / (mse x seconds). digest: equal where all pixels are.
    """

    variant: Variant
    spp: int
    products: np.ndarray = field(repr=False)
    seconds: Estimate
    rmse: Estimate
    efficiency: Estimate
    relmse: Estimate
    flip: Estimate
    bias: float
    bias_below: float
    noise: float
    build_seconds: float
    rays_per_sample: float
    digest: str
    pareto: bool = False

    def as_dict(self) -> dict[str, Any]:
        v = self.variant
        return {"variant": v.label, "knob": v.knob or None, "value": v.value, "spp": self.spp, "bias": self.bias,
                "bias_below": self.bias_below, "noise": self.noise, "build_seconds": self.build_seconds,
                "rays_per_sample": self.rays_per_sample, "pareto": self.pareto,
                **{name: getattr(self, name).as_dict() for name in ("seconds", "rmse", "efficiency", "relmse", "flip")}}


@dataclass(frozen=True)
class Slope:
    """How a variant's log mse, and the log of its variance alone, fall with log spp."""

    variant: Variant
    mse: Estimate
    noise: Estimate

    @property
    def theory(self) -> str:
        return THEORY[self.variant.scene.settings.sampler]

    def as_dict(self) -> dict[str, Any]:
        return {"variant": self.variant.label, "mse": self.mse.as_dict(), "noise": self.noise.as_dict(), "theory": self.theory}


@dataclass
class Sweep:
    """Everything that was measured, and what it was measured on. interrupted: the number of the signal that ended it early."""

    scene: str
    size: tuple[int, int]
    repeats: int
    seed: int
    reference: Reference
    machine: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    slopes: list[Slope] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    interrupted: int | None = None

    @property
    def same_pixels(self) -> list[str]:
        """The variants whose pictures are, bit for bit, those of the scene as it is."""
        base = {row.spp: row.digest for row in self.rows if not row.variant.knob}
        same: dict[str, bool] = {}
        for row in self.rows:
            if row.variant.knob:
                same[row.variant.label] = same.get(row.variant.label, True) and row.digest == base.get(row.spp)
        return [label for label, equal in same.items() if equal]

    def _repr_html_(self) -> str:
        return html_table(f"Speed against error: {self.scene}", COLUMNS, map(cells, self.rows)) + html_table(
            "How fast the error falls", SLOPE_COLUMNS, map(slope_cells, self.slopes))

    def as_dict(self) -> dict[str, Any]:
        return {"scene": self.scene, "size": list(self.size), "repeats": self.repeats, "seed": self.seed,
                "confidence": CONFIDENCE, "reference": self.reference.as_dict(), "machine": self.machine,
                "rows": [row.as_dict() for row in self.rows], "slopes": [slope.as_dict() for slope in self.slopes],
                "same_pixels": self.same_pixels, "left_out": self.left_out, "interrupted": self.interrupted}


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
