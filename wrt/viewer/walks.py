"""The way of a clicked pixel's ray through the structure, step by step, as text and drawings for the page."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from wrt.core.packages import needed_by
from wrt.core.types import JsonObject
from wrt.renderer.pixel_rays import film_rays
from wrt.renderer.prepare import Prepared
from wrt.viewer.renderers import View

INCHES, DOTS = (4.4, 3.5), 150  # size of a drawing, and its pixels per inch


class Step(Protocol):
    """A step of a walk, as wrt.lab.walk.step.WalkStep."""

    text: str


class Walk(Protocol):
    """A walk, as wrt.lab.walk.walk.Walk."""

    steps: Sequence[Step]

    def draw(self, axes: Any, step: int) -> object: ...


WalkOf = Callable[[Any, np.ndarray, np.ndarray], Walk]  # (structure, origin, direction), such as wrt.walk


def walk_at(walk_of: WalkOf, prepared: Prepared, view: View, x: float, y: float) -> Walk:
    """Follow the ray through a point of the picture, 0 to 1 from the top left corner. Raises InputError for instances."""
    origins, directions = film_rays(view.camera, view.size, np.array([[x, y]]))
    return walk_of(prepared.accel, origins[0], directions[0])


def drawing(walk: Walk, step: int) -> tuple[JsonObject, bytes]:
    """Return a step, or the last one if there are fewer, as a message and as a PNG. Raises InputError without matplotlib."""
    with needed_by("a drawing"):
        from matplotlib.figure import Figure

    step, out = max(0, min(step, len(walk.steps) - 1)), io.BytesIO()
    figure = Figure(figsize=INCHES, layout="constrained")
    if walk.steps:
        axes = figure.subplots()
        walk.draw(axes, step)
        axes.set_title("", loc="left")  # the page has the text
    figure.savefig(out, format="png", dpi=DOTS)
    text = walk.steps[step].text if walk.steps else "the ray meets no node"
    return {"mime": "image/png", "step": step, "last": max(0, len(walk.steps) - 1), "text": text}, out.getvalue()
