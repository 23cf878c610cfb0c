"""The way of a clicked pixel's ray through the structure, step by step, as text and drawings for the page."""

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
    """A step of a walk, as wrt.lab.walk.record.WalkStep."""

    @property
    def text(self) -> str: ...


class Walk(Protocol):
    """A walk, as wrt.lab.walk.walk.Walk."""

    @property
    def steps(self) -> Sequence[Step]: ...

    def draw(self, axes: Any, step: int) -> object: ...


WalkOf = Callable[[Any, np.ndarray, np.ndarray], Walk]  # (structure, origin, direction), such as wrt.walk


class Walks:
    """The walk of the ray that was clicked last. walk_of: None allows no walks."""

    def __init__(self, walk_of: WalkOf | None) -> None:
        self.walk_of = walk_of
        self._ray: tuple[Any, np.ndarray, np.ndarray] | None = None  # structure, origin, direction
        self._walk: Walk | None = None

    def aim(self, prepared: Prepared, view: View, x: float, y: float) -> None:
        """Choose the ray through a point of the picture, 0 to 1 from the top left corner."""
        origins, directions = film_rays(view.camera, view.size, np.array([[x, y]]))
        self._ray, self._walk = (prepared.accel, origins[0], directions[0]), None

    def step(self, step: int) -> tuple[JsonObject, bytes] | None:
        """Return a step, or the last one if there are fewer, as a message and as a PNG; None without a ray.

        Raises InputError without matplotlib, and for a structure over instances."""
        if self.walk_of is None or self._ray is None:
            return None
        with needed_by("a drawing"):
            from matplotlib.figure import Figure

        if self._walk is None:
            self._walk = self.walk_of(*self._ray)
        steps, out = self._walk.steps, io.BytesIO()
        step = max(0, min(step, len(steps) - 1))
        figure = Figure(figsize=INCHES, layout="constrained")
        if steps:
            axes = figure.subplots()
            self._walk.draw(axes, step)
            axes.set_title("", loc="left")  # the page has the text
        figure.savefig(out, format="png", dpi=DOTS)
        text = steps[step].text if steps else "the ray meets no node"
        return {"mime": "image/png", "step": step, "last": max(0, len(steps) - 1), "text": text}, out.getvalue()
