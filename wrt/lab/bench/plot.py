"""Draw bars with matplotlib, as a picture file."""

import io
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from wrt.core.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 100


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
