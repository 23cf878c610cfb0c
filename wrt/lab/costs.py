"""Cost of every pixel: run the render kernel over a structure that counts its steps and logs its rays."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import warp as wp

from wrt.accel.queries.observed import copied
from wrt.accel.snapshot import WrappedStructure
from wrt.core.device import on_host
from wrt.core.threads import run_all
from wrt.core.types import Device, WarpArray, WarpType
from wrt.kernels.study import ray_log
from wrt.kernels.traverse.observer import Counts, Recorder
from wrt.kernels.warp_private import fields_of
from wrt.renderer.film import DeviceFilm, Rectangle, Work
from wrt.renderer.plan import Plan
from wrt.renderer.prepare import Prepared, prepare
from wrt.scene.cameras import CameraKind

T = TypeVar("T")
COUNTERS = tuple(fields_of(Counts))


class CostCounter:
    """A render that counts traversal steps. built: the scene prepared for pictures, whose structure and arrays the counter shares."""

    def __init__(self, plan: Plan, device: Device, built: Prepared | None = None) -> None:
        counting = plan.structure._replace(units=plan.structure.units._replace(observer="sum"))
        features = replace(plan.features, counting=True)
        self.prepared = prepare(replace(plan, structure=WrappedStructure(counting, ray_log), features=features), device, built)

    @classmethod
    def beside(cls, built: Prepared) -> "CostCounter":
        """Return a counter that shares the structure and arrays of `built`, a scene prepared for pictures."""
        return cls(built.plan, built.device, built)

    def aim(self, camera: CameraKind, angles_of: tuple[int, int] | None = None, **settings: Any) -> None:
        """Change camera and settings; arguments as for Prepared.aimed."""
        self.prepared = self.prepared.aimed(camera, angles_of, **settings)

    def film(self) -> DeviceFilm:
        plan = self.prepared.plan
        return DeviceFilm(plan.scene.settings, plan.crop, self.prepared.device, plan.options.seed)

    def each(self, work: Callable[[T], None], items: Iterable[T]) -> None:
        """Call `work` with each item, on all threads."""
        run_all([partial(work, item) for item in items], 1 if self.prepared.device.is_cuda else self.prepared.threads)

    def trace(self, rectangle: Rectangle, film: DeviceFilm, recorder: Recorder, log: ray_log.RayLog) -> None:
        """Trace all samples of a tile into the film; write counters to `recorder` and rays to `log`."""
        data = copied(self.prepared.accel.data)  # each tile has its own recorder
        data.recorder = recorder
        accel = self.prepared.plan.structure.struct()
        accel.accel, accel.log = data, log
        self.prepared.launch(film, accel)(Work(rectangle, 0, self.prepared.plan.scene.settings.spp))

    def zeros(self, n: int, dtype: WarpType) -> WarpArray:
        return wp.zeros(n, dtype=dtype, device=self.prepared.device)

    def totals(self, rectangle: Rectangle, film: DeviceFilm) -> tuple[np.ndarray, np.ndarray]:
        """Trace a tile; return each pixel's number of rays, and the sums of these rays' counters, row by row."""
        n = rectangle[2] * rectangle[3]
        recorder, log = Recorder(), ray_log.RayLog()
        recorder.counts, log.used = self.zeros(n, Counts), self.zeros(n, wp.int32)
        self.trace(rectangle, film, recorder, log)
        return log.used.numpy(), on_host(recorder.counts)

    def costs(self, go_on: Callable[[int], bool] = lambda done: True) -> dict[str, np.ndarray] | None:
        """Return a map (H, W) int32 for each of COUNTERS: the sum over a pixel's rays (for `stack` the largest value).
        After each tile, a thread calls `go_on` with the number of finished pixels. If it returns False, stop and return None."""
        film = self.film()
        x0, y0, x1, y1 = self.prepared.plan.crop
        out = {name: np.zeros((y1 - y0, x1 - x0), np.int32) for name in COUNTERS}
        done: list[int] = []
        stopped: list[bool] = []

        def work(rectangle: Rectangle) -> None:
            if stopped:
                return
            x, y, width, height = rectangle
            _, counts = self.totals(rectangle, film)
            for name, values in out.items():
                values[y - y0 : y - y0 + height, x - x0 : x - x0 + width] = counts[name].reshape(height, width)
            done.append(width * height)
            if not go_on(sum(done)):
                stopped.append(True)

        self.each(work, self.prepared.tiles(1))
        return None if stopped else out
