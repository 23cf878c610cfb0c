"""Draw histograms with matplotlib, as an array of pixels."""

import io
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 100
BINS = 60  # most bins of a histogram


def histograms(panels: Mapping[str, Mapping[str, np.ndarray]], title: str) -> np.ndarray:
    """Return the picture, (H, W, 3) uint8: a panel for each counter, with a line for each kind of ray.
    The x axis is the value, up to the 99.9th percentile. The y axis is the share of the rays, logarithmic.
    panels: counter -> kind of ray -> the counter's value for each ray, (N,)."""
    rows = math.ceil(len(panels) / 2)
    figure = new_figure(8.0, 0.7 + 2.4 * rows)
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.suptitle(title, fontsize="medium")
    colors: dict[str, str] = {}
    for axes, (counter, kinds) in zip(figure.subplots(rows, 2, squeeze=False).flat, panels.items(), strict=False):
        axes.set(title=counter, xlabel="number a ray", ylabel="share of rays", yscale="log")
        edges = bins(kinds)
        for name, values in kinds.items():
            color = colors.setdefault(name, f"C{len(colors) % 10}")
            if len(values):
                axes.stairs(np.histogram(values, edges)[0] / len(values), edges, color=color, label=name)
    handles = {text: handle for axes in figure.axes for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=max(len(handles), 1), frameon=False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def bins(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return bin edges: whole numbers at equal distances, from 0 up to the largest of the arrays' 99.9th percentiles."""
    top = max((float(np.percentile(each, 99.9)) for each in values.values() if len(each)), default=1.0)
    width = max(1, math.ceil((top + 1.0) / BINS))
    return np.arange(0, math.ceil((top + 1.0) / width) + 1) * width


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty matplotlib Figure of this size in inches. Raise InputError if matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(f"plots need matplotlib ({error})", hint='pip install "wrt[plots]" installs it') from error
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def bars(panels: Mapping[str, Mapping[str, float]], title: str, suffix: str) -> bytes:
    """Return a picture file: a panel for each kind, with a bar and its value for each name. The first bar of a panel is highlighted.
    panels: kind -> name -> value > 0. suffix: .svg or .png."""
    rows = math.ceil(len(panels) / 2)
    figure = new_figure(9.0, 0.6 + rows * (0.5 + 0.24 * max(map(len, panels.values()))))
    figure.suptitle(title, fontsize="medium")
    axes = figure.subplots(rows, 2, squeeze=False)
    for each in axes.flat[len(panels):]:
        each.set_visible(False)
    for each, (kind, values) in zip(axes.flat, panels.items(), strict=False):
        bar = each.barh(list(values), list(values.values()), color=["C0", *["0.7"] * (len(values) - 1)])
        each.bar_label(bar, [f" {value:,.0f}" for value in values.values()], fontsize="small")
        each.set_title(kind, fontsize="medium")
        each.set(xticks=[], xlim=(0, 1.25 * max(values.values())))
        each.spines[["top", "right", "bottom"]].set_visible(False)
        each.invert_yaxis()
    return picture_file(figure, suffix)


def picture_file(figure: "Figure", suffix: str) -> bytes:
    """Return the contents of a .svg or .png file; equal figures give equal bytes."""
    from matplotlib import rc_context

    out = io.BytesIO()
    with rc_context({"svg.hashsalt": "wrt"}):
        figure.savefig(out, format=suffix[1:], metadata={"Date": None} if suffix == ".svg" else {"Software": None})
    return out.getvalue()
