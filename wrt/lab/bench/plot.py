"""Draw bars with matplotlib, as a picture file."""

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
