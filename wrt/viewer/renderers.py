"""The renderers behind the viewer: one for each structure that was looked at, made when a view first needs it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from wrt.picture.film import Film
from wrt.renderer.options import Options, Progress
from wrt.renderer.pixel_rays import film_rays
from wrt.renderer.prepare import Prepared
from wrt.renderer.renderer import Renderer
from wrt.scene.cameras import CameraKind
from wrt.scene.digest import camera_digest
from wrt.scene.model import Scene

TILE_SIZE = 16  # a tile that runs is waited for before the next view


class Counter(Protocol):
    """Counts the work of every pixel, for heat maps."""

    def aim(self, camera: CameraKind, angles_of: tuple[int, int] | None = None, **settings: Any) -> None:
        """Turn to another view, as Prepared.aimed does."""

    def costs(self, go_on: Callable[[int], bool]) -> dict[str, np.ndarray] | None:
        """Return the counters by name, (H, W) int32 each; None where `go_on`, asked with the number of pixels done, said no."""


CounterOf = Callable[[Prepared], Counter]


class Renderers:
    """progress: called by all of them. counter_of: makes the counter of a structure from what its renderer prepared; None: there
    are no heat maps. Every method that makes a renderer raises InputError where that cannot be."""

    def __init__(self, scene: Scene, options: Options, progress: Callable[[Progress], None], counter_of: CounterOf | None) -> None:
        self.scene, self.options, self.progress, self.counter_of = scene, options, progress, counter_of
        self.by_accel: dict[str, Renderer] = {}
        self.counters: dict[str, Counter] = {}

    def prepare(self, view: View) -> None:
        """Make what the view needs, if it is not there."""
        if view.accel not in self.by_accel:
            options = replace(self.options, accel=view.accel, camera=view.camera.opened(), tile_size=TILE_SIZE,
                              progress=self.progress)
            self.by_accel[view.accel] = Renderer(self.scene, options)
        if view.cost and self.counter_of is not None and view.accel not in self.counters:
            self.counters[view.accel] = self.counter_of(self.by_accel[view.accel].prepared)

    def picture(self, view: View, scale: int, spp: int) -> Film:
        """A picture of the view with so many of its pixels a side to one."""
        renderer = self.by_accel[view.accel]
        renderer.aim(view.camera, view.size, **_settings(view, scale, spp))
        return renderer.run()

    def costs(self, view: View, scale: int, go_on: Callable[[int], bool]) -> dict[str, np.ndarray] | None:
        """Return the counters of the view's pixels, as Counter.costs."""
        counter = self.counters[view.accel]
        counter.aim(view.camera, view.size, **_settings(view, scale, 1))
        return counter.costs(go_on)

    def focus_at(self, view: View, x: float, y: float) -> float | None:
        """The distance, along the axis, of what stands at a place of the picture (0 to 1 from its top left corner); None where
        there is nothing, or nothing was built yet."""
        if view.accel not in self.by_accel:
            return None
        origins, directions = film_rays(view.camera, view.size, np.array([[x, y]]))
        hits = self.by_accel[view.accel].accel.closest_hit(origins, directions)
        along = float(directions[0] @ -view.camera.camera_to_world[:3, 2])
        return float(hits.t[0]) * along if hits.prim_id[0] >= 0 else None

    def describe(self, accel: str) -> str:
        """A structure in a few words."""
        if accel not in self.by_accel:
            return accel
        stats = self.by_accel[accel].accel.stats
        return f"{accel}: {stats.nodes:,} nodes, {stats.bytes / 2**20:.1f} MiB, {stats.build_seconds:.2f} s"


def _settings(view: View, scale: int, spp: int) -> dict[str, Any]:
    width, height = (max(1, -(-side // scale)) for side in view.size)
    return {"size": (width, height), "spp": spp, "max_depth": view.max_depth}


@dataclass(frozen=True, eq=False)
class View:
    """What is asked for. size: (width, height) in pixels when it is fine; accel: a name in ACCELERATORS; cost: "" for the
    picture, or one of wrt.viewer.refine.COSTS, a counter of which a heat map is made."""

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
