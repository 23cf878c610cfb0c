"""The viewer's renderers: one for each acceleration structure and kind of camera, made when a view first needs it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias

import numpy as np

from wrt.picture.film import Film
from wrt.renderer.options import Options, Progress
from wrt.renderer.prepare import Prepared
from wrt.renderer.render import Renderer
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
Kind: TypeAlias = tuple[str, str, tuple[tuple[str, bool], ...]]  # name of the structure, kind of camera and its switches


class Renderers:
    """The renderers of a scene and their counters, by `kind_of` their views.

    progress: callback of all renderers. counter_of: makes the counter of a prepared scene; None: no heat maps."""

    def __init__(self, scene: Scene, options: Options, progress: Callable[[Progress], None], counter_of: CounterOf | None) -> None:
        self.scene, self.options, self.progress, self.counter_of = scene, options, progress, counter_of
        self.by_kind: dict[Kind, Renderer] = {}
        self.counters: dict[Kind, Counter] = {}

    def prepare(self, view: View) -> None:
        """Make the renderer and the counter that the view needs, if they are missing. Raises InputError if that fails."""
        kind = kind_of(view)
        if kind not in self.by_kind:
            options = replace(self.options, accel=view.accel, camera=view.camera.opened(), tile_size=TILE_SIZE,
                              progress=self.progress)
            self.by_kind[kind] = Renderer(self.scene, options)
        if view.cost and self.counter_of is not None and kind not in self.counters:
            self.counters[kind] = self.counter_of(self.by_kind[kind].prepared)

    def prepared(self, view: View) -> Prepared | None:
        """Return the scene as prepared for the view; None before its structure is built."""
        renderer = self.by_kind.get(kind_of(view))
        return None if renderer is None else renderer.prepared

    def picture(self, view: View, scale: int, spp: int) -> Film:
        """Render the view with one pixel for each block of `scale` x `scale` pixels."""
        renderer = self.by_kind[kind_of(view)]
        renderer.aim(view.camera, view.size, **_settings(view, scale, spp))
        return renderer.run()

    def costs(self, view: View, scale: int, go_on: Callable[[int], bool]) -> dict[str, np.ndarray] | None:
        """Return Counter.costs of the view, with one pixel for each block of `scale` x `scale` pixels."""
        counter = self.counters[kind_of(view)]
        counter.aim(view.camera, view.size, **_settings(view, scale, 1))
        return counter.costs(go_on)


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


def kind_of(view: View) -> Kind:
    """Return what two views must have in common to share a renderer. A lens is open in all of them (CameraKind.opened)."""
    return view.accel, view.camera.kind, tuple(sorted(view.camera.opened().switches().items()))


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture or heat map to show."""

    codes: np.ndarray  # (h, w, 3) uint8, display values.
    view: View
    scale: int  # One pixel stands for scale x scale pixels of the view.
    spp: int  # Smallest number of samples of a pixel.
    speed: float = 0.0  # Rays per second.
    rays_per_sample: float = 0.0  # Mean.
    done: bool = False  # True: the picture gets no finer.
    seconds_left: float = 0.0  # Until it is done, estimated.
    error: float = np.inf  # Estimated root mean square, over pixels and channels, of the standard error; inf: unknown.
    visibly_cut: float = 0.0  # As in Film.stats, of a finished picture.
    # For a heat map, counts per pixel: the count shown in the last colour, the mean, and the largest count.
    top: float = 0.0
    mean: float = 0.0
    largest: float = 0.0
