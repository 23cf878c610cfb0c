"""The renderers behind the viewer: one for each structure that was looked at, made when a view first needs it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from wrt.picture.film import Film
from wrt.renderer.costs import CostCounter
from wrt.renderer.options import Options, Progress
from wrt.renderer.pixel_rays import film_rays
from wrt.renderer.renderer import Renderer
from wrt.scene.model import Scene
from wrt.viewer.view import View

TILE_SIZE = 16  # a tile that runs is waited for before the next view


class Renderers:
    """progress: hears of all of them. Every method that makes a renderer raises InputError where that cannot be."""

    def __init__(self, scene: Scene, options: Options, progress: Callable[[Progress], None]) -> None:
        self.scene, self.options, self.progress = scene, options, progress
        self.by_accel: dict[str, Renderer] = {}
        self.counters: dict[str, CostCounter] = {}

    def prepare(self, view: View) -> None:
        """Make what the view needs, if it is not there."""
        if view.accel not in self.by_accel:
            options = replace(self.options, accel=view.accel, camera=view.camera.opened(), tile_size=TILE_SIZE,
                              progress=self.progress)
            self.by_accel[view.accel] = Renderer(self.scene, options)
        if view.cost and view.accel not in self.counters:
            prepared = self.by_accel[view.accel].prepared
            self.counters[view.accel] = CostCounter(prepared.plan, prepared.device, prepared)

    def picture(self, view: View, scale: int, spp: int) -> Film:
        """A picture of the view with so many of its pixels a side to one."""
        renderer = self.by_accel[view.accel]
        renderer.aim(view.camera, view.size, **_settings(view, scale, spp))
        return renderer.run()

    def costs(self, view: View, scale: int, go_on: Callable[[int], bool]) -> dict[str, np.ndarray] | None:
        """As CostCounter.costs."""
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
