"""Rays, outlines and names on the axes of matplotlib, for both drawings."""

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from wrt.renderer.inspector.section import Outline
from wrt.renderer.inspector.strokes import COLORS, ENDS, Stroke, frame_points
from wrt.renderer.inspector.tree import Sample

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Colours of the inside and the outline of a shape.
FILLS = {"clear": ("#d3e8f5", "#4f8fb5"), "emissive": ("#ffe9a8", "#c99a10"), "opaque": ("#dcd6cb", "#6d6455")}
FAINT = 0.35  # opacity of hidden parts


def draw_outline(axes: "Axes", shape: Outline) -> None:
    """Draw the section of a shape; closed curves are filled."""
    fill, edge = FILLS["clear" if shape.material.is_clear else "emissive" if shape.material.is_emissive else "opaque"]
    for curve in shape.curves:
        if len(curve) > 2 and np.allclose(curve[0], curve[-1]):
            axes.fill(*curve.T, facecolor=fill, edgecolor=edge, linewidth=1.2, zorder=1)
        else:
            axes.plot(*curve.T, color=edge, linewidth=2.0, zorder=1, solid_capstyle="round")


def draw_stroke(axes: "Axes", stroke: Stroke, points: np.ndarray, hidden: np.ndarray | None = None) -> None:
    """Draw a ray.

    points: (N, 2), from its start to its end, in the coordinates of the axes; hidden: (N - 1,) bool, the parts to draw faintly."""
    from matplotlib.patheffects import Normal
    from matplotlib.patheffects import Stroke as Casing

    hidden = np.zeros(len(points) - 1, bool) if hidden is None else hidden
    shade, shadow = COLORS[stroke.kind], stroke.is_shadow
    width, order = (0.75 if shadow else 1.0) * stroke.width, 3 if shadow else 4
    casing = [Casing(linewidth=width + 1.6, foreground="white", alpha=0.75), Normal()]
    for first, end, faint in runs(hidden):
        axes.plot(*points[first : end + 1].T, color=shade, linewidth=width, zorder=order, alpha=FAINT if faint else 1.0,
                  linestyle=(0, (3, 1.6)) if shadow else "-", path_effects=[] if faint else casing)
    alpha, along = FAINT if hidden[len(hidden) // 2 :].any() else 1.0, points[-1] - points[0]
    heads = [] if shadow else [points[0] + 0.55 * along]
    if stroke.goes_on and stroke.mark in ("missed", ""):
        heads.append(points[-1])
    elif stroke.mark:
        crossed = stroke.mark == "blocked"
        axes.plot(*points[-1], marker=ENDS[stroke.mark][0], color=shade, ms=6.0, mec=shade if crossed else "white",
                  mew=1.6 if crossed else 0.8, zorder=6, alpha=alpha)
    for head in heads:
        arrow = {"arrowstyle": "-|>", "lw": 0.0, "mutation_scale": 8.0 + 3.0 * width, "color": shade, "alpha": alpha}
        arrow |= {"shrinkA": 0.0, "shrinkB": 0.0}
        axes.annotate("", head + 0.02 * along, head, zorder=order, annotation_clip=True, arrowprops=arrow)


def runs(flags: np.ndarray) -> list[tuple[int, int, bool]]:
    """Return (first, end, flag) of each run of equal flags."""
    edges = [0, *(np.flatnonzero(np.diff(flags)) + 1).tolist(), len(flags)]
    return [(first, end, bool(flags[first])) for first, end in pairwise(edges)]


def label_points(axes: "Axes", sample: Sample, strokes: list[Stroke], project: Callable[[np.ndarray], np.ndarray]) -> None:
    """Mark and name the camera and the lights that are seen. project: from world space (N, 3) to the coordinates of the axes (N, 2)."""
    from matplotlib.patheffects import withStroke

    eye, shown = sample.rays[0].origin.astype(np.float64), frame_points(sample)[0]
    here = bool(np.allclose(eye, shown))
    points = [("camera" if here else "from the camera", "o" if here else "", COLORS["camera"], shown)]
    lights = {stroke.light: stroke.end for stroke in strokes if stroke.light}  # of a light with an area, one point
    points += [(name, "*", "#ffc400", end) for name, end in lights.items()]
    for name, marker, shade, point in points:
        (x, y), = project(np.asarray(point, np.float64)[None])
        share = axes.transAxes.inverted().transform(axes.transData.transform((x, y)))
        if not (np.isfinite(share).all() and (share >= 0.0).all() and (share <= 1.0).all()):
            continue
        star = marker == "*"
        axes.plot([x], [y], marker=marker, ms=13 if star else 8, color=shade, mec="#8a6500" if star else "white", mew=0.9, zorder=6)
        right, high = share[0] > 0.85, share[1] > 0.93
        text = axes.annotate(name, (x, y), (-8 if right else 8, -13 if high else 7), textcoords="offset points", fontsize=8,
                             color="#202020", ha="right" if right else "left", zorder=7,
                             path_effects=[withStroke(linewidth=2.2, foreground="white")])
        text.set_in_layout(False)


def label_shapes(axes: "Axes", shapes: list[Outline], corners: np.ndarray, lines: np.ndarray) -> None:
    """Write the name of each shape at its part in the frame, where it covers no other name and as little as possible of the lines.

    corners: lowest and highest corner of the frame, (2, 2). lines: (N, 2, 2)."""
    low, high = corners
    size = high - low
    steps = np.linspace(0.0, 1.0, 65)[:, None]
    points_of_lines = np.concatenate([line[0] + steps * (line[1] - line[0]) for line in lines])
    taken: list[tuple[np.ndarray, np.ndarray]] = []
    for shape in shapes:
        points = np.concatenate(shape.curves)
        points = points[((points > low) & (points < high)).all(axis=1)]
        if not len(points):
            continue
        half = np.array([0.0055 * len(shape.name) + 0.008, 0.022]) * size
        tops = [points[index] for index in (points[:, 1].argmax(), points[:, 1].argmin(), points[:, 0].argmin(), points[:, 0].argmax())]
        shifts = half * [(0.0, 1.2), (0.0, -1.2), (1.1, 0.0), (-1.1, 0.0), (0.9, 1.2), (-0.9, 1.2), (0.9, -1.2), (-0.9, -1.2)]
        places = [np.clip(top + shift, low + half, high - half) for top in (*tops, points.mean(axis=0)) for shift in shifts]
        free = [place for place in places if all((np.abs(place - other) > half + size_of).any() for other, size_of in taken)]
        if free:
            place = min(free, key=lambda place: int((np.abs(points_of_lines - place) < half).all(axis=1).sum()))
            axes.text(place[0], place[1], shape.name, fontsize=7.5, ha="center", va="center", color="#4a443a", zorder=7,
                      bbox={"facecolor": "white", "alpha": 0.6, "pad": 0.8, "linewidth": 0})
            taken.append((place, half))
