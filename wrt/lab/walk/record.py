"""The record of a walk: its steps with the stack and the closest hit, and their counts."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.recorded_steps import RecordedSteps
from wrt.core.types import JsonObject
from wrt.kernels.traverse import steps as of
from wrt.lab.walk.regions import Region, regions_of
from wrt.lab.walk.step import Entry, WalkStep, in_words, plain


@dataclass(frozen=True, eq=False)
class WalkRecord:
    """The steps of one ray that searches its closest hit. It prints as a list, and draws itself.

    Attributes
    ----------
    structure : str
        Name of the structure.
    origin, direction : (3,) float32
        The ray.
    t_min, t_max : float
        Its segment.
    steps : tuple of WalkStep
        All steps.
    """

    structure: str
    origin: np.ndarray
    direction: np.ndarray
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
        """All steps."""
        return tuple(steps_of(self))

    @property
    def counts(self) -> dict[str, int]:
        """The counters of the ray (`Hits.counters`), counted from the steps."""
        return {name: int(values[0]) for name, values in counted(self.recorded).items()}

    def __str__(self) -> str:
        width = len(str(len(self)))
        head = f"{self.structure}: ray from {listed(self.origin)} along {listed(self.direction)}, t from {self.t_min:g} to {self.t_max:g}"
        lines = [f"{i:{width}}  {'  ' * max(step.depth, 0)}{step.text}" for i, step in enumerate(self.steps)]
        last = self.steps[-1] if len(self) else None
        found = f"hits triangle {last.best_prim} at t = {last.best_t:.6g}" if last is not None and last.best_prim >= 0 else "hits nothing"
        sums = ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in self.counts.items() if value)
        return "\n".join([head, *lines, f"The ray {found}: {sums}."])

    def as_dict(self) -> JsonObject:
        """Return the walk for JSON."""
        return plain({"structure": self.structure, "origin": self.origin.tolist(), "direction": self.direction.tolist(),
                      "t_min": self.t_min, "t_max": self.t_max, "counts": self.counts, "steps": [step.as_dict() for step in self.steps]})


def counted(recorded: RecordedSteps) -> dict[str, np.ndarray]:
    """Return the counters of each ray, (N,) int64, counted from the steps."""
    steps, n = recorded.steps, len(recorded)
    kind, ray = steps["kind"], np.repeat(np.arange(n), np.diff(recorded.first))

    def number(mask: np.ndarray) -> np.ndarray:
        return np.bincount(ray[mask], minlength=n)

    nodes, primitives = kind == of.NODE, kind == of.TEST
    tested = (kind == of.BOX) | (kind == of.PLANE) | (kind == of.CELL)
    before = np.maximum.accumulate(np.where(nodes, np.arange(len(steps)), -1))  # the node of each test; a root's box has none
    owned = before >= recorded.first[ray] if len(steps) else np.zeros(0, bool)
    operations = np.zeros(len(steps), bool)
    operations[before[tested & owned]] = True
    leaves_stack = (kind == of.POP) & (steps["result"] & of.STAYS == 0)
    size = np.cumsum((kind == of.PUSH).astype(np.int64) - leaves_stack)
    stack = np.zeros(n, np.int64)
    np.maximum.at(stack, ray, size)  # every stack is empty at the end of its ray
    node_bytes, primitive_bytes = recorded.node_bytes, recorded.primitive_bytes
    return {"nodes": number(nodes), "boxes": number(kind == of.BOX), "box_operations": number(operations | ((kind == of.BOX) & ~owned)),
            "primitives": number(primitives), "leaves": number(kind == of.LEAF), "pushes": number(kind == of.PUSH),
            "pops": number(kind == of.POP), "stack": stack, "node_bytes": node_bytes * number(nodes),
            "primitive_bytes": primitive_bytes * number(primitives)}


def steps_of(walk: WalkRecord) -> list[WalkStep]:
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
        out.append(WalkStep(**{**vars(made), "text": in_words(made, walk.t_min, bits)}))
    return out


def listed(values: np.ndarray) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"
