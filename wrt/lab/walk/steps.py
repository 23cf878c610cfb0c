"""The steps of one ray: their values and words, the stack and the closest hit after them, and the regions that they are about."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from wrt.accel.queries.observed import RecordedSteps
from wrt.core.types import JsonObject
from wrt.kernels.traverse import steps as of

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
    # Box, part, cell: where the ray enters and leaves, also if it misses. Plane: where the line crosses it. Push, pop: where the ray
    # enters the entry. Test: of the hit on the whole line, inf on a miss.
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


def steps_of(recorded: RecordedSteps, regions: list[Region | None], t_max: float) -> list[WalkStep]:
    """Convert the recorded steps of one ray, and keep the stack and the closest hit."""
    stack: list[Entry] = []
    best_t, best_prim = t_max, -1
    out = []
    depths = recorded.depths()
    for i, step in enumerate(recorded.steps):
        kind, index, count = of.KINDS[step["kind"]], int(step["index"]), int(step["count"])
        bits, t, t_end = int(step["result"]), float(step["t"]), float(step["t_end"])
        region, result = regions[i], ""
        if region is not None and kind in ("box", "part"):
            result = "entered" if bits & of.ENTERED else "missed"
            t, t_end = region.interval(recorded.origin[0], recorded.direction[0])
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
