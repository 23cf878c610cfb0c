"""The steps of a walk, as values and in words."""

import math
from dataclasses import dataclass, fields
from typing import Any

from wrt.core.types import JsonObject
from wrt.kernels.traverse import steps as of


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
    """A step of a walk.

    Attributes
    ----------
    kind : str
        One of wrt.kernels.traverse.steps.KINDS.
    text : str
        The step in words.
    index, count : int
        Node, primitive or child; count is -1 for a node, else the number of primitives of a leaf.
    depth : int
        Number of links from the root to the present node or leaf.
    result : str
        Of a test: an entry of wrt.kernels.traverse.steps.RESULTS. Of other kinds "entered", "missed", "taken", "dropped", or "".
    t, t_end : float
        Box, part, cell: where the ray enters and leaves, also if it misses; plane: where the line crosses it; push, pop: where the ray
        enters the entry; test: of the hit on the whole line, inf on a miss.
    prim_id : int
        Of a test, else -1.
    u, v : float
        Of a test's hit.
    edges : tuple of float
        Of a test: the three edge values; a line through the triangle has no two of opposite signs. NaN if the test has no edge values.
    stack : tuple of Entry
        The stack after the step, the top last.
    best_t, best_prim : float, int
        The closest hit after the step; t_max and -1 before the first hit.
    """

    kind: str
    text: str
    index: int
    count: int
    depth: int
    result: str
    t: float
    t_end: float
    prim_id: int
    u: float
    v: float
    edges: tuple[float, float, float]
    stack: tuple[Entry, ...]
    best_t: float
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


def in_words(step: WalkStep, t_min: float, bits: int) -> str:
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
            return f"{what} of {name}: {entry_in_words(step, t_min)}"
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


def entry_in_words(step: WalkStep, t_min: float) -> str:
    """Return where the line enters and leaves a region, and why the ray does not enter it. Distances are rounded; the kernel decides."""
    if step.result == "entered":
        return f"entered at t = {step.t:.6g}, left at {step.t_end:.6g}"
    if step.count == 0:
        return "not visited"
    if not step.t <= step.t_end:
        if math.isfinite(step.t) and math.isfinite(step.t_end):
            return f"missed, the line leaves one slab at t = {step.t_end:.6g} before it enters another at {step.t:.6g}"
        return "missed, the line is outside"
    if step.t_end < t_min:
        return f"missed, left at t = {step.t_end:.6g}, before t_min"
    if step.t > step.best_t:
        behind = "the closest hit" if step.best_prim >= 0 else "t_max"
        return f"missed, entered at t = {step.t:.6g}, behind {behind} at {step.best_t:.6g}"
    return f"missed (t from {step.t:.6g} to {step.t_end:.6g}), by other bounds"


def plain(value: Any) -> Any:
    """Convert a value for JSON, which has no infinity and no NaN."""
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
