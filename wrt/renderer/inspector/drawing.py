"""A drawing of a sample's rays with matplotlib: the section of the scene by the plane that holds most of them."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from wrt.core.checks import as_path
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.types import PathLike
from wrt.renderer.inspector.section import Plane, cut, plane_of
from wrt.renderer.inspector.tree import AMBIENT, Light, Ray, Sample, color
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import icosphere
from wrt.scene.values import shift

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = (".png", ".svg", ".pdf")
SIZE, DPI = (8.0, 5.4), 150  # inches, and pixels per inch
COLORS = {"camera": "#202020", "reflected": "#1668c4", "coated": "#0b8f9c", "refracted": "#d1342b", "transmitted": "#c2378f",
          "onward": "#2b8a3e", "shadow ray": "#e59a00", "blocked": "#8a7f70"}
SHADOWS = ("shadow ray", "blocked")  # the keys of COLORS of dashed lines
OUTLINES = {"clear": "#4f8fb5", "emissive": "#c99a10", "opaque": "#6d6455"}
# A marker of matplotlib for each end of a ray, and its description.
ENDS = {"absorbed": ("o", "ends at a surface"), "emission": ("*", "ends at a light"), "missed": (">", "leaves the scene"),
        "cut by depth": ("s", "cut by depth"), "cut by throughput": ("X", "cut by throughput"), "blocked": ("x", "shadow ray blocked")}
LEAVES, STUB = 0.22, 0.1  # Length of a ray that leaves the scene, and of a ray that was cut, over the extent of the drawing.
FAR = 3.5  # A hit farther than this, over the distance of the first hit, does not widen the drawing.
NEAR = 0.8  # Longest part of the camera ray that is shown, over the largest distance between the first hit and another one.
MARGIN = 0.58  # half the size of the drawing over the extent of its points
WIDEST, THINNEST = 2.6, 0.8  # Of the lines, in points: throughput 1, and 0.


class Stroke(NamedTuple):
    """A line from start to end, (3,) float64 each. weight: 0 to 1. mark: a key of ENDS, or "". light: the light that it reaches, or ""."""

    kind: str
    start: np.ndarray
    end: np.ndarray
    weight: float
    mark: str
    light: str = ""

    @property
    def is_shadow(self) -> bool:
        return self.kind in SHADOWS

    @property
    def width(self) -> float:
        return (0.75 if self.is_shadow else 1.0) * (THINNEST + (WIDEST - THINNEST) * math.sqrt(self.weight))


def stroke_of(item: Ray | Light, throughput: np.ndarray, extent: float) -> Stroke:
    """Return the line of a ray, or of the shadow ray of a light. extent: of the drawing, in scene units."""
    weight = float(np.clip(throughput.max(), 0.0, 1.0))
    if isinstance(item, Ray):
        length = {"missed": LEAVES, "cut by depth": STUB, "cut by throughput": STUB}.get(item.ended)
        start = item.origin.astype(np.float64)
        end = item.end.astype(np.float64) if length is None else start + length * extent * _unit(item.direction)
        return Stroke(item.kind, start, end, weight, "" if item.ended == "continued" else item.ended)
    last, blocked = item.parts[-1], item.state in ("blocked", "cut")
    end, reaches = last.end.astype(np.float64), not blocked and item.light != AMBIENT
    if not np.isfinite(end).all():  # the background, or a directional light
        end, reaches = last.origin + LEAVES * extent * _unit(last.direction), False
    return Stroke("blocked" if blocked else "shadow ray", item.parts[0].origin.astype(np.float64), end,
                  weight * (1.0 if item.radiance.any() else 0.3), "blocked" if blocked else "" if reaches else "missed",
                  item.light if reaches else "")


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector, np.float64) / np.linalg.norm(vector.astype(np.float64))


def strokes_of(sample: Sample, extent: float) -> list[tuple[Ray | Light, Stroke]]:
    """Return the lines of all rays and of all lights that were asked, shadow rays first, so that paths are drawn over them."""
    drawn: list[tuple[Ray | Light, Ray]] = [(light, ray) for ray in sample.rays for light in ray.lights if light.parts]
    drawn += [(ray, ray) for ray in sample.rays]
    return [(item, stroke_of(item, ray.throughput, extent)) for item, ray in drawn]


def frame_points(sample: Sample) -> np.ndarray:
    """Return the points that a drawing must show, (N, 3) float64: a point of the camera ray, and the hits that are not too far.

    The point is the camera, unless the camera is so far from the first hit that the other rays would be small in the drawing."""
    rays = sample.rays
    eye = rays[0].origin.astype(np.float64)
    if not math.isfinite(rays[0].t):
        return np.array([eye, eye + rays[0].direction])
    hits = np.array([ray.end for ray in rays if math.isfinite(ray.t)], np.float64)
    hits = hits[np.linalg.norm(hits - eye, axis=1) <= FAR * np.linalg.norm(hits[0] - eye)]
    reach = NEAR * float(np.linalg.norm(hits - hits[0], axis=1).max()) / float(np.linalg.norm(hits[0] - eye))
    return np.concatenate([[hits[0] + (min(reach, 1.0) if reach else 1.0) * (eye - hits[0])], hits])


# --- the drawing ------------------------------------------------------------------------------------------------------


def figure(scene: Scene, camera: CameraKind, pixel: tuple[int, int], sample: Sample) -> "Figure":
    """Return the drawing of a sample with a ray."""
    with needed_by("drawing rays"):
        from matplotlib.figure import Figure
        from matplotlib.lines import Line2D

    drawn = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    strokes = draw_section(drawn.subplots(), scene, camera, sample)
    of = f"pixel {pixel[0]},{pixel[1]}, sample {sample.index}, radiance {color(sample.radiance)}"
    drawn.suptitle(f"{scene.name or 'scene'}: {of}", fontsize=10)
    kinds, marks = {stroke.kind for stroke in strokes}, {stroke.mark for stroke in strokes}
    handles = [Line2D([], [], color=shade, lw=1.8, ls="--" if kind in SHADOWS else "-", label=kind)
               for kind, shade in COLORS.items() if kind in kinds]
    handles += [Line2D([], [], color="#555555", marker=mark, ls="", ms=5.5, label=text)
                for name, (mark, text) in ENDS.items() if name in marks and name != "blocked"]
    drawn.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6), fontsize=8, frameon=False)
    return drawn


def require_drawable(path: PathLike) -> Path:
    """Return the path. Raises InputError if its suffix is none of FILES."""
    target = as_path(path, "path")
    if target.suffix.lower() not in FILES:
        raise InputError(f"cannot draw to {target.suffix or 'a file without a suffix'}", path=target, hint=f"use {', '.join(FILES)}")
    return target


def draw_section(axes: "Axes", scene: Scene, camera: CameraKind, sample: Sample) -> list[Stroke]:
    """Draw the outlines of the shapes that the plane of the rays cuts, and the rays over them; return the rays' lines."""
    plane, shown = plane_of(sample, camera), frame_points(sample)
    points, ratio = plane.project(shown), SIZE[0] / (SIZE[1] - 1.0)
    low, high = points.min(axis=0), points.max(axis=0)
    half = MARGIN * max(high[0] - low[0], ratio * (high[1] - low[1])) * np.array([1.0, 1.0 / ratio])
    low, high = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor="#fbfaf8")
    axes.set_title("section by the plane of the rays, onto which other rays are projected", fontsize=8, color="#5c564c")
    draw_outlines(axes, scene, plane, low, high)
    strokes = [stroke for _, stroke in strokes_of(sample, float((high - low).max()))]
    for stroke in strokes:
        draw_stroke(axes, stroke, plane.project(np.array([stroke.start, stroke.end])))
    eye = "camera" if np.allclose(shown[0], sample.rays[0].origin) else "from the camera"
    for name, point in {eye: shown[0], **{stroke.light: stroke.end for stroke in strokes if stroke.light}}.items():
        axes.annotate(name, tuple(plane.project(point)), (4, 5), textcoords="offset points", fontsize=8,
                      annotation_clip=True).set_in_layout(False)
    return strokes


def draw_outlines(axes: "Axes", scene: Scene, plane: Plane, low: np.ndarray, high: np.ndarray) -> None:
    """Draw the sections of all shapes that the plane cuts, each with its name at its highest part between the corners of the drawing."""
    from matplotlib.collections import LineCollection

    named = [(thing.name or f"object {i}", thing) for i, thing in enumerate(scene.objects)]
    for i, sphere in enumerate(scene.spheres):
        ball = Object(icosphere(4, sphere.radius), (sphere.material,), shift(np.array(sphere.center)))
        named.append((sphere.name or f"sphere {i}", ball))
    for name, thing in named:
        vertices = thing.mesh.vertices.astype(np.float64) @ thing.placement[:3, :3].T + thing.placement[:3, 3]
        lines, material = cut(vertices[thing.mesh.faces], plane), thing.materials[0]
        shade = OUTLINES["clear" if material.is_clear else "emissive" if material.is_emissive else "opaque"]
        axes.add_collection(LineCollection(list(lines), colors=shade, linewidths=1.6, capstyle="round", zorder=1))
        ends = lines.reshape(-1, 2)
        inside = ends[((ends > low) & (ends < high)).all(axis=1)]
        if len(inside):
            axes.annotate(name, tuple(inside[inside[:, 1].argmax()]), (0, 3), textcoords="offset points", fontsize=7.5, ha="center",
                          color=shade, zorder=7).set_in_layout(False)


def draw_stroke(axes: "Axes", stroke: Stroke, ends: np.ndarray) -> None:
    """Draw a line from ends[0] to ends[1], (2, 2), with an arrow in the middle of a path and a marker at the end."""
    shade, order = COLORS[stroke.kind], 3 if stroke.is_shadow else 4
    axes.plot(*ends.T, color=shade, linewidth=stroke.width, zorder=order, linestyle=(0, (3, 1.6)) if stroke.is_shadow else "-")
    if stroke.mark:
        axes.plot(*ends[1], marker=ENDS[stroke.mark][0], color=shade, ms=6.0, mec=shade if stroke.mark == "blocked" else "white", zorder=6)
    if not stroke.is_shadow:
        along = ends[1] - ends[0]
        axes.annotate("", ends[0] + 0.57 * along, ends[0] + 0.55 * along, zorder=order, annotation_clip=True,
                      arrowprops={"arrowstyle": "-|>", "lw": 0.0, "mutation_scale": 8.0 + 3.0 * stroke.width, "color": shade,
                                  "shrinkA": 0.0, "shrinkB": 0.0})
