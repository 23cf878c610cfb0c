"""Plots by matplotlib, as arrays of pixels: logarithmic ones of points by series, and histograms side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wrt.core.errors import InputError

Point = tuple[float, float]
DPI = 100
BINS = 60


@dataclass(frozen=True)
class Series:
    """Points in the order in which a line joins them. Series with the same label have one colour and one legend entry."""

    label: str
    points: Sequence[Point]


@dataclass(frozen=True)
class LogLogPlot:
    """What is shown; x and y must be positive (points that are not, or not finite, are left out). front: a line on top."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    front: Sequence[Point] = ()
    front_label: str = "front"

    def draw(self) -> np.ndarray:
        """(H, W, 3) uint8."""
        figure = new_figure(9.0, 6.0)
        axes = figure.subplots()
        axes.set(title=self.title, xlabel=self.x_label, ylabel=self.y_label, xscale="log", yscale="log")
        axes.grid(alpha=0.3)
        colors: dict[str, str] = {}
        for series in self.series:
            label = "_" if series.label in colors else series.label  # "_": not in the legend again
            color = colors.setdefault(series.label, f"C{len(colors) % 10}")
            axes.plot(*_columns(series.points), "o-", color=color, label=label, markersize=4, linewidth=1)
        if self.front:
            axes.plot(*_columns(self.front), "o-", color="black", markerfacecolor="none", markersize=9, label=self.front_label)
        if self.series:
            figure.legend(loc="outside right upper", frameon=False)
        return pixels(figure)


def histograms(panels: Mapping[str, Mapping[str, np.ndarray]], title: str) -> np.ndarray:
    """(H, W, 3) uint8: a panel for each counter, and in it a line for each kind of ray. Across: what a ray costs, from 0 to
    where 99.9% of all rays are; upwards: the share of the kind's rays, logarithmic. Values of 0 or more."""
    rows = math.ceil(len(panels) / 2)
    figure = new_figure(8.0, 0.7 + 2.4 * rows)
    figure.suptitle(title, fontsize="medium")
    colors: dict[str, str] = {}
    for axes, (counter, kinds) in zip(figure.subplots(rows, 2, squeeze=False).flat, panels.items(), strict=False):
        axes.set(title=counter, yscale="log")
        edges = bins(kinds)
        for name, values in kinds.items():
            color = colors.setdefault(name, f"C{len(colors) % 10}")
            if len(values):
                axes.stairs(np.histogram(values, edges)[0] / len(values), edges, color=color, label=name)
    handles = {text: handle for axes in figure.axes for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=max(len(handles), 1), frameon=False)
    return pixels(figure)


def bins(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Edges of the bins: whole numbers apart, up to where nearly all values are."""
    top = max((float(np.percentile(each, 99.9)) for each in values.values() if len(each)), default=1.0)
    width = max(1, math.ceil((top + 1.0) / BINS))
    return np.arange(0, math.ceil((top + 1.0) / width) + 1) * width


def new_figure(width: float, height: float) -> Any:
    """An empty matplotlib Figure of so many inches. Raises InputError where there is no matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(f'plots need matplotlib ({error}); pip install "wrt[plots]" installs it') from error
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def pixels(figure: Any) -> np.ndarray:
    """(H, W, 3) uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _columns(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    good = [point for point in points if all(math.isfinite(x) and x > 0.0 for x in point)]
    return [x for x, _ in good], [y for _, y in good]
