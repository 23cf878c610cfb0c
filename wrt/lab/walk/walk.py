"""One ray through a structure, step by step: `wrt.walk`. The steps come from the recorder that counts, as those of `wrt.trace`.

Drawings are in a plane through the ray: each box, cell and triangle appears as its section, so distances along the ray are exact. The
x axis is the ray. The y axis is at right angles to it, and as close as possible to the coordinate axis that the ray follows least."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.observed import RecordedSteps, record_steps
from wrt.core.checks import as_integer, as_path, shown
from wrt.core.errors import InputError
from wrt.core.files import check_writable, replacing, write_bytes
from wrt.core.packages import needed_by
from wrt.core.types import ArrayLike, JsonObject, PathLike
from wrt.lab.walk.steps import Region, WalkStep, plain, regions_of, steps_of
from wrt.renderer.inspector.section import Plane, cut

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = {"entered": "tab:green", "missed": "tab:red", "taken": "tab:green", "dropped": "tab:red", "visited": "0.75", "stack": "tab:blue"}
MOST_FACES = 100_000  # the sections of larger meshes are not drawn


@dataclass(frozen=True, eq=False)
class Walk:
    """The steps of one ray that searches its closest hit. It prints as a list, and draws itself."""

    structure: str  # Its name.
    origin: np.ndarray  # (3,) float32.
    direction: np.ndarray  # (3,) float32.
    t_min: float
    t_max: float
    recorded: RecordedSteps
    geometry: Geometry

    def __len__(self) -> int:
        return len(self.recorded.steps)

    @cached_property
    def regions(self) -> list[Region | None]:
        """Region of space that each step is about, None for pushes, pops and tests."""
        return regions_of(self.recorded.steps)

    @cached_property
    def steps(self) -> tuple[WalkStep, ...]:
        return tuple(steps_of(self.recorded, self.regions, self.t_max))

    @property
    def counts(self) -> dict[str, int]:
        """The counters of the ray (`Hits.counters`), except its number of rays."""
        counts = self.recorded.counts[0]
        return {name: int(counts[name]) for name in counts.dtype.names if name != "probes"}

    def __str__(self) -> str:
        width = len(str(len(self)))
        head = f"{self.structure}: ray from {listed(self.origin)} along {listed(self.direction)}, t from {self.t_min:g} to {self.t_max:g}"
        if self.geometry.origin is not None:
            head += f"; all coordinates minus {listed(self.geometry.origin)}"
        lines = [f"{i:{width}}  {'  ' * max(step.depth, 0)}{step.text}" for i, step in enumerate(self.steps)]
        last = self.steps[-1] if len(self) else None
        found = f"hits triangle {last.best_prim} at t = {last.best_t:.6g}" if last is not None and last.best_prim >= 0 else "hits nothing"
        sums = ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in self.counts.items() if value)
        return "\n".join([head, *lines, f"The ray {found}: {sums}."])

    def as_dict(self) -> JsonObject:
        """Return the walk for JSON."""
        return plain({"structure": self.structure, "origin": self.origin.tolist(), "direction": self.direction.tolist(),
                      "t_min": self.t_min, "t_max": self.t_max, "counts": self.counts, "steps": [step.as_dict() for step in self.steps]})

    def draw(self, axes: Axes | None = None, step: int | None = None) -> Axes:
        """Draw the walk up to a step, in the plane through the ray, as wrt.lab.walk.walk.draw describes.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Where to draw; by default in a new figure.
        step : int, optional
            Index of the step, also from the end; the last by default.

        Returns
        -------
        Axes
            The axes.
        """
        return draw(self, axes, step)

    def save(self, path: PathLike, fps: int = 2) -> None:
        """Write the walk to a file: .gif (an animation with a frame per step), .png (the last step), .json or .txt (all steps).

        Parameters
        ----------
        path : str or path
            The file.
        fps : int
            Frames per second of an animation, 1 to 60.

        Raises
        ------
        InputError
            For another suffix, and if the file cannot be written.
        """
        suffix = str(path).lower().rpartition(".")[2]
        if suffix in ("json", "txt"):
            write_bytes(path, (json.dumps(self.as_dict(), indent=1) if suffix == "json" else str(self)).encode() + b"\n")
        else:
            write_picture(self, path, fps)


def listed(values: np.ndarray) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"


def walk(accel: Accelerator, origin: ArrayLike, direction: ArrayLike, t_min: float = 0.0, t_max: float = math.inf) -> Walk:
    """Follow one ray through a structure: every node, box, cell, plane, stack entry and triangle test, in order.

    Parameters
    ----------
    accel : OneMesh
        Structure over one mesh, from `wrt.build`.
    origin, direction : (3,) array_like
        The ray; the direction has any length but 0.
    t_min, t_max : float
        Its segment, in units of the direction's length.

    Returns
    -------
    Walk
        print(walk) lists the steps; walk.draw(), walk.save("walk.gif") and walk.as_dict() show them otherwise.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    for name, value in (("origin", origin), ("direction", direction)):
        if np.asarray(value).shape != (3,):
            raise InputError(f"must be three numbers, got {shown(value)}", argument=name)
    recorded = record_steps(accel, np.asarray(origin)[None], np.asarray(direction)[None], t_min, t_max)
    assert isinstance(accel, OneMesh)
    return Walk(recorded.structure, recorded.origin[0], recorded.direction[0], float(t_min), float(t_max), recorded, accel.geometry)


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
    if not len(low):
        raise InputError("has nothing to draw: its mesh is empty", argument="walk")
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
