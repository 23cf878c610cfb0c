"""Cost of every pixel: run the render kernel over a structure that counts its steps and logs its rays."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import TypeVar

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
from wrt.renderer.prepare import prepare

T = TypeVar("T")
COUNTERS = tuple(fields_of(Counts))


class CostCounter:
    """A render that counts traversal steps."""

    def __init__(self, plan: Plan, device: Device) -> None:
        counting = plan.structure._replace(units=plan.structure.units._replace(observer="sum"))
        features = replace(plan.features, counting=True)
        self.prepared = prepare(replace(plan, structure=WrappedStructure(counting, ray_log), features=features), device)

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
