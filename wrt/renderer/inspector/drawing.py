"""Drawings of a sample's rays with matplotlib: a section in 2D, and the rays over a picture from the side."""

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.checks import as_choice, as_path
from wrt.core.errors import InputError
from wrt.core.files import write_bytes
from wrt.core.packages import needed_by
from wrt.core.types import PathLike
from wrt.renderer.inspector.marks import draw_outline, draw_stroke, label_points, label_shapes
from wrt.renderer.inspector.section import frame, outlines, plane_of
from wrt.renderer.inspector.side_view import draw_picture
from wrt.renderer.inspector.strokes import COLORS, ENDS, strokes_of
from wrt.renderer.inspector.text import color
from wrt.renderer.inspector.tree import InspectedPixel, Sample

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VIEWS = ("section", "picture", "both")
FILES = (".png", ".svg", ".pdf")
DPI = 150
PANEL = (8.0, 4.5)  # inches


def figure(inspection: InspectedPixel, view: str, index: int | None) -> "Figure":
    """Return the drawing; Inspection.figure describes the arguments and errors."""
    as_choice(view, VIEWS, "view")
    sample = sample_of(inspection, index)
    with needed_by("drawing rays"):
        from matplotlib.figure import Figure

    chosen = VIEWS[:2] if view == "both" else (view,)
    drawn = Figure(figsize=(PANEL[0], PANEL[1] * len(chosen) + 0.7), dpi=DPI, layout="constrained")
    panels = drawn.subplots(len(chosen), 1, squeeze=False)[:, 0]
    for axes, name in zip(panels, chosen, strict=True):
        if name == "section":
            draw_section(axes, inspection, sample)
        else:
            draw_picture(axes, inspection, sample)
    (x, y), title = inspection.pixel, inspection.scene.name or "scene"
    drawn.suptitle(f"{title}: pixel {x},{y}, sample {sample.index}, radiance {color(sample.radiance)}", fontsize=10)
    add_legend(drawn, sample)
    return drawn


def save(inspection: InspectedPixel, path: PathLike, view: str, index: int | None) -> None:
    """Write the drawing; Inspection.save describes the arguments and errors."""
    target = require_drawable(path)
    drawn, file = figure(inspection, view, index), io.BytesIO()
    drawn.savefig(file, format=target.suffix.lower()[1:])
    write_bytes(target, file.getvalue())


def require_drawable(path: PathLike) -> Path:
    """Return the path. Raises InputError if its suffix is none of FILES."""
    target = as_path(path, "path")
    if target.suffix.lower() not in FILES:
        raise InputError(f"cannot draw to {target.suffix or 'a file without a suffix'}", path=target, hint=f"use {', '.join(FILES)}")
    return target


def sample_of(inspection: InspectedPixel, index: int | None) -> Sample:
    """Return the sample with an index, or the first sample for None. Raises InputError if it is missing or has no ray."""
    known = {sample.index: sample for sample in inspection.samples}
    sample = inspection.samples[0] if index is None else known.get(index)
    if sample is None:
        raise InputError(f"must be an inspected sample ({min(known)} to {max(known)}), got {index}", argument="sample")
    if sample.root is None:
        raise InputError("cannot be drawn: the camera has no ray here", argument="sample")
    return sample


def draw_section(axes: "Axes", inspection: InspectedPixel, sample: Sample) -> None:
    plane = plane_of(sample, inspection.camera)
    low, high = frame(sample, plane, PANEL[0] / PANEL[1])
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor="#fbfaf8")
    for spine in axes.spines.values():
        spine.set_color("#c9c3b8")
    shapes = outlines(inspection.scene, plane)
    for shape in shapes:
        draw_outline(axes, shape)
    extent = float((high - low).max())
    strokes = strokes_of(sample, extent)
    lines = plane.project(np.array([(stroke.start, stroke.end) for stroke in strokes]))
    for stroke, line in zip(strokes, lines, strict=True):
        draw_stroke(axes, stroke, line)
    label_shapes(axes, shapes, np.array([low, high]), lines)
    label_points(axes, sample, strokes, plane.project)
    ends = np.array([(stroke.start, stroke.end) for stroke in strokes if not stroke.goes_on])
    off = float(np.abs(plane.distance(ends)).max()) if len(ends) else 0.0
    note = f"; rays that leave it, by up to {off:.2g} units, are projected onto it" if off > 1e-3 * extent else ""
    axes.set_title(f"section by the plane of the rays{note}", fontsize=8, color="#5c564c")


def add_legend(drawn: "Figure", sample: Sample) -> None:
    """Explain the colours and markers that occur in the sample, below the drawing."""
    from matplotlib.lines import Line2D

    strokes = strokes_of(sample, 1.0)
    kinds, marks = {stroke.kind for stroke in strokes}, {stroke.mark for stroke in strokes}
    handles = [Line2D([], [], color=shade, lw=1.8, ls="--" if kind in ("shadow ray", "blocked") else "-", label=kind)
               for kind, shade in COLORS.items() if kind in kinds]
    handles += [Line2D([], [], color="#555555", marker=mark, ls="", ms=5.5, label=text)
                for name, (mark, text) in ENDS.items() if name in marks and name != "blocked"]
    drawn.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6), fontsize=8, frameon=False)
