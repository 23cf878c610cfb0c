"""The viewer's renderers: one for each acceleration structure, made when a view first needs it."""

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
from wrt.scene.digest import digest
from wrt.scene.model import Scene

TILE_SIZE = 16  # pixels a side; small, because the next view waits until all running tiles end


class Counter(Protocol):
    """Counts the work of each pixel, such as visited nodes, for heat maps."""

    def aim(self, camera: CameraKind, angles_of: tuple[int, int] | None = None, **settings: Any) -> None:
        """Set another camera and other settings, as Prepared.aimed does."""

    def costs(self, go_on: Callable[[int], bool]) -> dict[str, np.ndarray] | None:
        """Return an array (H, W) int32 for each counter, by its name. Return None once go_on(number of counted pixels) returns False."""


CounterOf = Callable[[Prepared], Counter]


class Renderers:
    """The renderers of a scene and their counters, by name of the acceleration structure.

    progress: callback of all renderers. counter_of: makes the counter of a prepared scene; None: no heat maps."""

    def __init__(self, scene: Scene, options: Options, progress: Callable[[Progress], None], counter_of: CounterOf | None) -> None:
        self.scene, self.options, self.progress, self.counter_of = scene, options, progress, counter_of
        self.by_accel: dict[str, Renderer] = {}
        self.counters: dict[str, Counter] = {}

    def prepare(self, view: View) -> None:
        """Make the renderer and the counter that the view needs, if they are missing. Raises InputError if that fails."""
        if view.accel not in self.by_accel:
            options = replace(self.options, accel=view.accel, camera=view.camera.opened(), tile_size=TILE_SIZE,
                              progress=self.progress)
            self.by_accel[view.accel] = Renderer(self.scene, options)
        if view.cost and self.counter_of is not None and view.accel not in self.counters:
            self.counters[view.accel] = self.counter_of(self.by_accel[view.accel].prepared)

    def picture(self, view: View, scale: int, spp: int) -> Film:
        """Render the view with one pixel for each block of `scale` x `scale` pixels."""
        renderer = self.by_accel[view.accel]
        renderer.aim(view.camera, view.size, **_settings(view, scale, spp))
        return renderer.run()

    def costs(self, view: View, scale: int, go_on: Callable[[int], bool]) -> dict[str, np.ndarray] | None:
        """Return Counter.costs of the view, with one pixel for each block of `scale` x `scale` pixels."""
        counter = self.counters[view.accel]
        counter.aim(view.camera, view.size, **_settings(view, scale, 1))
        return counter.costs(go_on)

    def focus_at(self, view: View, x: float, y: float) -> float | None:
        """Return the distance along the camera's axis, in scene units, to the surface at a point of the picture.

        x, y: the point, 0 to 1 from the top left corner. None: the ray hits nothing, or the structure is not built yet."""
        if view.accel not in self.by_accel:
            return None
        origins, directions = film_rays(view.camera, view.size, np.array([[x, y]]))
        hits = self.by_accel[view.accel].accel.closest_hit(origins, directions)
        along = float(directions[0] @ -view.camera.camera_to_world[:3, 2])
        return float(hits.t[0]) * along if hits.prim_id[0] >= 0 else None

    def describe(self, accel: str) -> str:
        """Return a text with a structure's name, size and build time; before it is built, only the name."""
        if accel not in self.by_accel:
            return accel
        stats = self.by_accel[accel].accel.stats
        return f"{accel}: {stats.nodes:,} nodes, {stats.bytes / 2**20:.1f} MiB, {stats.build_seconds:.2f} s"


def _settings(view: View, scale: int, spp: int) -> dict[str, Any]:
    width, height = (max(1, -(-side // scale)) for side in view.size)
    return {"size": (width, height), "spp": spp, "max_depth": view.max_depth}


@dataclass(frozen=True, eq=False)
class View:
    """A picture or heat map that the user requests."""

    camera: CameraKind
    size: tuple[int, int]  # width, height in pixels at full resolution
    max_depth: int
    accel: str  # a name in ACCELERATORS
    cost: str = ""  # the counter of a heat map, one of wrt.viewer.refine.COSTS; "": the picture

    def same(self, other: View) -> bool:
        """Return True if both views have the same pixels."""
        fields, others = ((v.size, v.max_depth, v.accel, v.cost, digest(v.camera)) for v in (self, other))
        return fields == others


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture or heat map to show."""

    codes: np.ndarray  # (h, w, 3) uint8, display values
    view: View
    scale: int  # one pixel stands for scale x scale pixels of the view
    spp: int  # smallest number of samples of a pixel
    speed: float = 0.0  # rays per second
    rays_per_sample: float = 0.0  # mean
    done: bool = False  # True: the picture gets no finer
    # For a heat map, counts per pixel: the count shown in the last colour, the mean, and the largest count.
    top: float = 0.0
    mean: float = 0.0
    largest: float = 0.0
