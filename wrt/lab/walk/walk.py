"""One ray through a structure, step by step: `wrt.walk`. The steps come from the recorder that counts, as those of `wrt.trace`.

A step has values, words, the stack and the closest hit after it, and the region of space that it is about."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.observed import RecordedSteps, record_steps
from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.core.files import write_bytes
from wrt.core.types import ArrayLike, JsonObject, PathLike
from wrt.kernels.traverse import steps as of
from wrt.lab.walk.drawing import draw, write_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes


AXES = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True, eq=False)
class Region:
    """The points p with normals @ p + offsets <= 0 ((K, 3) and (K,) float64), or, if the radius is above 0, a sphere."""

    normals: np.ndarray
    offsets: np.ndarray
    center: np.ndarray
    radius: float = 0.0

    @classmethod
    def box(cls, lo: np.ndarray, hi: np.ndarray, radius: float = 0.0) -> Region:
        lo, hi = lo.astype(np.float64), hi.astype(np.float64)
        with np.errstate(invalid="ignore"):
            return cls(AXES, np.concatenate([-hi, lo]), 0.5 * (lo + hi), radius)

    def cut(self, normal: np.ndarray, offset: float) -> Region:
        """Return the part on the side of a plane where dot(normal, p) + offset <= 0."""
        return Region(np.append(self.normals, [normal.astype(np.float64)], axis=0), np.append(self.offsets, offset), self.center)

    def interval(self, origin: np.ndarray, direction: np.ndarray) -> tuple[float, float]:
        """Return t where the line enters and leaves; the first is greater if it misses."""
        o, d = origin.astype(np.float64), direction.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            if self.radius > 0.0:
                a, b = d @ d, d @ (self.center - o)
                root = b * b - a * (np.sum((self.center - o) ** 2) - self.radius**2)
                return (float((b - np.sqrt(root)) / a), float((b + np.sqrt(root)) / a)) if root >= 0.0 else (np.inf, -np.inf)
            height, slope = self.normals @ o + self.offsets, self.normals @ d
            t = -height / slope
        if (height[slope == 0.0] > 0.0).any() or self.radius < 0.0:
            return np.inf, -np.inf
        return float(t[slope < 0.0].max(initial=-np.inf)), float(t[slope > 0.0].min(initial=np.inf))


def regions_of(steps: np.ndarray) -> list[Region | None]:
    """Return the region of each step, None for pushes, pops, tests and what has no recorded bounds. steps: of one ray."""
    known: dict[tuple[int, int], Region] = {}
    node: tuple[int, int] | None = None
    out: list[Region | None] = []
    for step in steps:
        kind, key = step["kind"], (int(step["index"]), int(step["count"]))
        if kind == of.NODE:
            node = (key[0], int(of.INNER))
            key = node
        elif kind == of.BOX:
            known[key] = Region.box(step["lo"], step["hi"], float(step["edges"][0]))
        elif kind == of.CELL:
            known[key] = Region.box(step["lo"], step["hi"])
        elif kind == of.PART and node in known:
            known[key] = known[node].cut(step["lo"], float(step["hi"][0]))
        elif kind == of.PLANE and node is not None:
            key = node
        out.append(known.get(key) if kind in (of.NODE, of.BOX, of.CELL, of.PART, of.PLANE, of.LEAF) else None)
    return out


@dataclass(frozen=True)
class Entry:
    """A child of a node, on the stack or not. index: an inner node, or the first of `count` primitives. t: where the ray enters it."""

    index: int
    count: int  # of a leaf; -1: inner node
    t: float

    def __str__(self) -> str:
        return name_of(self.index, self.count)


@dataclass(frozen=True)
class WalkStep:
    """A step of a walk."""

    kind: str  # One of kernels.traverse.steps.KINDS.
    text: str  # The step in words.
    index: int  # Node, primitive or child.
    count: int  # -1 for a node, else the number of primitives of a leaf.
    depth: int  # Number of links from the root to the present node or leaf.
    result: str  # Of a test: an entry of kernels.traverse.steps.RESULTS. Else "entered", "missed", "taken", "dropped", or "".
    # Box, part, cell: where the ray enters and leaves, also if it misses; plane: where the line crosses it; push, pop: where the ray
    # enters the entry; test: of the hit on the whole line, inf on a miss.
    t: float
    t_end: float
    prim_id: int  # Of a test, else -1.
    u: float  # u, v: of a test's hit.
    v: float
    # Of a test: the three edge values; a line through the triangle has no two of opposite signs. NaN if the test has no edge values.
    edges: tuple[float, float, float]
    stack: tuple[Entry, ...]  # After the step, the top last.
    best_t: float  # best_t, best_prim: the closest hit after the step; t_max and -1 before the first hit.
    best_prim: int

    def as_dict(self) -> JsonObject:
        """Return the step for JSON; a number that is not finite becomes text."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return plain(own | {"stack": [vars(entry) for entry in self.stack]})


def name_of(index: int, count: int) -> str:
    if count < 0:
        return f"node {index}"
    if count == 0:
        return "an empty leaf"
    return f"leaf {index}" if count <= 1 else f"leaf {index} to {index + count - 1}"


def in_words(step: WalkStep, bits: int) -> str:
    """Return the step in words. bits: the recorded result."""
    name, t = name_of(step.index, step.count), f"{step.t:.6g}"
    stack = ", ".join(map(str, step.stack)) or "empty"
    match step.kind:
        case "node":
            return name
        case "cell":
            return f"cell {step.index if step.index >= 0 else '(whole structure)'}: t from {t} to {step.t_end:.6g}"
        case "plane":
            return f"plane of node {step.index}: the line crosses it at t = {t}"
        case "box" | "part":
            what = "box" if step.kind == "box" else "side"
            return f"{what} of {name}: {entry_in_words(step)}"
        case "leaf":
            return f"{name}: {step.count} primitive{'' if step.count == 1 else 's'}"
        case "skip":
            return f"primitive {step.index}: tested before (mailbox)"
        case "push":
            return f"push {name} (t = {t}); stack: {stack}"
        case "pop":
            left = " (further octants stay)" if bits & of.STAYS else ""
            why = "" if step.result == "taken" else f", because t = {t} is behind the closest hit"
            return f"pop {name}: {step.result}{why}{left}; stack: {stack}"
    edges = "" if math.isnan(step.edges[0]) else f", edges {', '.join(f'{edge:.3g}' for edge in step.edges)}"
    hit = f", t = {t}, u = {step.u:.4g}, v = {step.v:.4g}" if math.isfinite(step.t) else ""
    return f"triangle {step.prim_id} (primitive {step.index}){edges}{hit}: {step.result}"


def entry_in_words(step: WalkStep) -> str:
    """Return where the line enters and leaves a region, and why the ray does not enter it. Distances are rounded; the kernel decides."""
    if step.result == "entered":
        return f"entered at t = {step.t:.6g}, left at {step.t_end:.6g}"
    if step.count == 0:
        return "not visited"
    if not step.t <= step.t_end:
        return "missed, the line is outside"
    if step.t > step.best_t:
        behind = "the closest hit" if step.best_prim >= 0 else "t_max"
        return f"missed, entered at t = {step.t:.6g}, behind {behind} at {step.best_t:.6g}"
    return f"missed (t from {step.t:.6g} to {step.t_end:.6g})"


def plain(value: Any) -> Any:
    """Convert a value for JSON, which has no infinity and no NaN."""
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


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
        return tuple(steps_of(self))

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
        """Draw the walk up to a step, in the plane through the ray, as wrt.lab.walk.drawing.draw describes.

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


def steps_of(walk: Walk) -> list[WalkStep]:
    """Convert the recorded steps, and keep the stack and the closest hit."""
    stack: list[Entry] = []
    best_t, best_prim = walk.t_max, -1
    out = []
    depths = walk.recorded.depths()
    for i, step in enumerate(walk.recorded.steps):
        kind, index, count = of.KINDS[step["kind"]], int(step["index"]), int(step["count"])
        bits, t, t_end = int(step["result"]), float(step["t"]), float(step["t_end"])
        region, result = walk.regions[i], ""
        if region is not None and kind in ("box", "part"):
            result = "entered" if bits & of.ENTERED else "missed"
            t, t_end = region.interval(walk.origin, walk.direction)
        elif kind == "test":
            result = of.RESULTS[bits]
            if bits == of.CLOSEST:
                best_t, best_prim = t, int(step["prim_id"])
        elif kind == "push":
            stack.insert(int(step["prim_id"]), Entry(index, count, t))
        elif kind == "pop":
            result = "taken" if bits & of.ENTERED else "dropped"
            if not bits & of.STAYS:
                stack.pop()
        is_test, (edge_0, edge_1, edge_2) = kind == "test", map(float, step["edges"])
        made = WalkStep(kind, "", index, -1 if kind in ("node", "plane", "cell") else count, int(depths[i]), result, t, t_end,
                        int(step["prim_id"]) if is_test else -1, float(step["u"]), float(step["v"]), (edge_0, edge_1, edge_2),
                        tuple(stack), best_t, best_prim)
        out.append(WalkStep(**{**vars(made), "text": in_words(made, bits)}))
    return out


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
