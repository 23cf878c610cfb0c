"""What is asked of the viewer, and what it puts before the eyes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wrt.scene.cameras import CameraKind
from wrt.scene.digest import camera_digest


@dataclass(frozen=True, eq=False)
class View:
    """What is asked for. size: (width, height) in pixels when it is fine; accel: a name in ACCELERATORS; cost: "" for the
    picture, or a counter of wrt.renderer.costs.COUNTERS, of which a heat map is made."""

    camera: CameraKind
    size: tuple[int, int]
    max_depth: int
    accel: str
    cost: str = ""

    def same(self, other: View) -> bool:
        """Whether the picture would be the same."""
        mine, others = ((v.size, v.max_depth, v.accel, v.cost, camera_digest(v.camera)) for v in (self, other))
        return mine == others


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture to put before the eyes. codes: (h, w, 3) uint8 as a display takes them; scale: pixels of the view a side to one of
    it; spp: samples of each pixel at least; speed: rays a second; done: it will get no finer. Of a heat map: its value with the
    last colour, the mean and the largest value."""

    codes: np.ndarray
    view: View
    scale: int
    spp: int
    speed: float = 0.0
    rays_per_sample: float = 0.0
    done: bool = False
    top: float = 0.0
    mean: float = 0.0
    largest: float = 0.0
