"""Drawings of a walk in a plane through the ray: each box, cell and triangle appears as its section, so distances along the ray are exact.

The x axis is the ray itself. The y axis is at right angles to it, and as close as possible to the coordinate axis that the ray follows
least."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.core.checks import as_integer, as_path
from wrt.core.errors import InputError
from wrt.core.files import check_writable, replacing
from wrt.core.packages import needed_by
from wrt.core.types import PathLike
from wrt.renderer.inspector.section import Plane, cut

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from wrt.lab.walk.walk import Region, Walk

COLORS = {"entered": "tab:green", "missed": "tab:red", "taken": "tab:green", "dropped": "tab:red", "visited": "0.75", "stack": "tab:blue"}
MOST_FACES = 100_000  # the sections of larger meshes are not drawn


@dataclass(frozen=True, eq=False)
class Section:
    """A plane through a ray's origin, and along the ray in the plane's direction `across`. window: (x0, x1, y0, y1)."""

    plane: Plane
    length: float  # of the direction: x = t * length
    window: tuple[float, float, float, float]

    def outline(self, region: Region) -> np.ndarray:
        """Return the corners of a region's section within the window, (K, 2); (0, 2) if the plane misses it."""
        if region.radius != 0.0:
            squared = region.radius**2 - self.plane.distance(region.center) ** 2
            angle = np.linspace(0.0, 2.0 * np.pi, 73)
            circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            return self.plane.project(region.center) + np.sqrt(squared) * circle if squared > 0.0 else empty()
        x0, x1, y0, y1 = self.window
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        for normal, offset in zip(region.normals, region.offsets, strict=True):
            flat = np.array([normal @ self.plane.across, normal @ self.plane.up])
            corners = clipped(corners, flat, float(normal @ self.plane.origin + offset))
        return corners


def empty() -> np.ndarray:
    return np.zeros((0, 2))


def clipped(corners: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Clip a convex polygon (K, 2) to the half plane normal @ p + offset <= 0 (Sutherland and Hodgman 1974)."""
    if not np.isfinite(offset):
        return corners if offset < 0.0 else empty()
    height = corners @ normal + offset
    out = []
    for i in range(len(corners)):
        a, b = height[i - 1], height[i]
        if (a > 0.0) != (b > 0.0):
            out.append(corners[i - 1] + a / (a - b) * (corners[i] - corners[i - 1]))
        if b <= 0.0:
            out.append(corners[i])
    return np.array(out) if out else empty()


def section_of(walk: Walk) -> Section:
    """Choose the plane, and a window around the mesh's box and the ray's origin or, if that is far, the ray's part near the box."""
    direction = walk.direction.astype(np.float64)
    length = float(np.linalg.norm(direction))
    along = direction / length
    axis = np.eye(3)[int(np.argmin(np.abs(along)))]
    across = axis - (axis @ along) * along
    plane = Plane(walk.origin.astype(np.float64), along, across / np.linalg.norm(across))
    low, high = walk.geometry.bounds()  # of each triangle and sphere
    lo, hi = low.min(axis=0).astype(np.float64), high.max(axis=0).astype(np.float64)
    corners = np.array([[(lo, hi)[k >> a & 1][a] for a in range(3)] for k in range(8)])
    flat = plane.project(corners)
    x0, x1, y0, y1 = flat[:, 0].min(), flat[:, 0].max(), min(flat[:, 1].min(), 0.0), max(flat[:, 1].max(), 0.0)
    size = max(x1 - x0, y1 - y0)
    x0 = min(x0, max(0.0, x0 - 0.3 * size))
    return Section(plane, length, (x0 - 0.05 * size, x1 + 0.05 * size, y0 - 0.05 * size, y1 + 0.05 * size))


def draw(walk: Walk, axes: Axes | None, step: int | None) -> Axes:
    """Draw the walk up to a step. Green: entered; red: missed; grey: visited nodes; blue: entries of the stack; black: tested triangles."""
    if axes is None:
        with needed_by("a drawing"):
            import matplotlib.pyplot as plt
        axes = plt.subplots(figsize=(7.0, 5.0), layout="constrained")[1]
    last = len(walk) - 1 if step is None else as_integer(step, "step", -len(walk), len(walk) - 1) % max(len(walk), 1)
    section = section_of(walk)
    x0, x1, y0, y1 = section.window
    corners = walk.geometry.vertices.astype(np.float64)[walk.geometry.faces]
    if len(corners) <= MOST_FACES:
        axes.plot(*segments_of(cut(corners, section.plane)), color="0.8", lw=0.8, zorder=1)
    steps = walk.steps[: last + 1]
    draw_regions(walk, axes, section, last)
    tested = np.array([each.prim_id for each in steps if 0 <= each.prim_id < len(corners)], int)
    axes.plot(*segments_of(cut(corners[tested], section.plane)), color="black", lw=1.4, zorder=4)
    now = steps[-1] if steps else None
    end = min(now.best_t if now else walk.t_max, 1e30) * section.length
    axes.annotate("", (min(end, x1), 0.0), (max(walk.t_min * section.length, x0), 0.0), zorder=6,
                  arrowprops={"arrowstyle": "->", "color": "tab:orange", "lw": 1.6})
    if now is not None:
        if 0 <= now.prim_id < len(corners):
            color = COLORS["entered" if now.result == "closest hit" else "missed"]
            axes.plot(*segments_of(cut(corners[[now.prim_id]], section.plane)), color=color, lw=3.0, zorder=5)
        if now.best_prim >= 0:
            axes.plot([now.best_t * section.length], [0.0], "o", color="tab:orange", zorder=7)
        axes.set_title(f"{walk.structure}, step {last} of {len(walk) - 1}: {now.text}", fontsize="small", loc="left", wrap=True)
    unit = "t" if abs(section.length - 1.0) < 1e-6 else f"t times {section.length:.4g}"
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel=f"distance along the ray ({unit})", ylabel="distance from the ray")
    return axes


def draw_regions(walk: Walk, axes: Axes, section: Section, last: int) -> None:
    """Draw the sections of all visited nodes, of the stack's entries, and of the step `last`."""
    regions, steps = walk.regions, walk.steps
    outlines: list[tuple[Region | None, dict[str, Any]]] = []
    known: dict[tuple[int, int], Region] = {}
    for i, each in enumerate(steps[: last + 1]):
        region = regions[i]
        if region is not None:
            known[(each.index, each.count)] = region
            if each.kind in ("node", "cell", "leaf"):
                outlines.append((region, {"ec": COLORS["visited"], "lw": 1.0, "zorder": 2}))
    if last >= 0:
        now = steps[last]
        outlines += [(known.get((entry.index, entry.count)), {"ec": COLORS["stack"], "lw": 1.2, "zorder": 3}) for entry in now.stack]
        region = regions[last] or (known.get((now.index, now.count)) if now.kind in ("push", "pop") else None)
        color = COLORS.get(now.result, COLORS["stack"] if now.kind == "push" else "black")
        outlines.append((region, {"ec": color, "lw": 2.2, "zorder": 4, "ls": "--" if now.result in ("missed", "dropped") else "-"}))
    from matplotlib.patches import Polygon

    for region, style in outlines:
        outline = empty() if region is None else section.outline(region)
        if len(outline) > 1:
            axes.add_patch(Polygon(outline, closed=True, fill=False, **style))


def segments_of(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of segments (N, 2, 2) for one call of `plot`, with NaN between them."""
    padded = np.concatenate([ends, np.full((len(ends), 1, 2), np.nan)], axis=1).reshape(-1, 2)
    return padded[:, 0], padded[:, 1]


def write_picture(walk: Walk, path: PathLike, fps: int) -> None:
    """Write an animation (.gif) or a picture (.png), as Walk.save describes."""
    target = as_path(path, "path")
    suffix = target.suffix.lower()
    if suffix not in (".gif", ".png"):
        raise InputError("must have the suffix .gif, .png, .json or .txt", path=path)
    if not len(walk):
        raise InputError("there is no step to draw: the ray tests nothing", path=path)
    as_integer(fps, "fps", 1, 60)
    check_writable(target)
    with needed_by("a drawing"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from PIL import Image
    figure = Figure(figsize=(7.0, 5.0), dpi=100, layout="constrained")
    canvas, frames = FigureCanvasAgg(figure), []
    for step in range(len(walk)) if suffix == ".gif" else [len(walk) - 1]:
        figure.clear()
        draw(walk, figure.subplots(), step)
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    with replacing(target) as file:
        if suffix == ".png":
            frames[0].save(file, format="png")
        else:
            frames[0].save(file, format="gif", save_all=True, append_images=frames[1:], duration=1000 // fps, loop=0)
