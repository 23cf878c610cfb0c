"""One ray through a structure, step by step: `wrt.walk`. The steps come from the recorder that counts, as those of `wrt.trace`."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.observed import record_steps
from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.core.files import write_bytes
from wrt.core.types import ArrayLike, PathLike
from wrt.lab.walk.drawing import draw, write_frames
from wrt.lab.walk.record import WalkRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Walk(WalkRecord):
    __doc__ = WalkRecord.__doc__

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
        """Write the walk to a file.

        Parameters
        ----------
        path : str or path
            .gif, .mp4 (needs ffmpeg): an animation with a frame per step. .png: the last step; with {} in the name, a file per step.
            .json, .txt: all steps.
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
            return
        write_frames(self, path, fps)


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
