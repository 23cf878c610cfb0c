"""The records of a pixel: run the render kernel over a structure that records its rays (wrt.kernels.loops.record)."""

from dataclasses import replace
from typing import Unpack

import numpy as np
import warp as wp

from wrt.accel.structure import WrappedStructure
from wrt.core.device import on_host
from wrt.core.types import Device
from wrt.kernels.loops import record
from wrt.renderer.film_arrays import DeviceFilm
from wrt.renderer.plan import Plan
from wrt.renderer.prepare import prepare
from wrt.renderer.tiles import Work
from wrt.scene.cameras import CameraKind
from wrt.scene.settings import SettingChanges

# The arrays of a Record in the order of Record.used, with the number of entries of the first attempt.
ARRAYS = {"rays": (record.TracedRay, 256), "ends": (record.PathEnd, 128),
          "lights": (record.AskedLight, 256), "paths": (record.NewPath, 256)}


class Recorder:
    """A scene prepared for records. plan: the plan of the render."""

    def __init__(self, plan: Plan, device: Device) -> None:
        features = replace(plan.features, recording=True)
        self.prepared = prepare(replace(plan, structure=WrappedStructure(plan.structure, record), features=features), device)
        self.sizes = [size for _, size in ARRAYS.values()]

    def aim(self, camera: CameraKind, **settings: Unpack[SettingChanges]) -> Plan:
        """Set another camera and other settings, as Prepared.aimed does; return the plan with them."""
        self.prepared = self.prepared.aimed(camera, **settings)
        return self.prepared.plan

    def film(self, x: int, y: int) -> DeviceFilm:
        """Return an empty film of one pixel."""
        plan = self.prepared.plan
        return DeviceFilm(plan.scene.settings, (x, y, x + 1, y + 1), self.prepared.device, plan.options.seed)

    def sample(self, x: int, y: int, index: int) -> dict[str, np.ndarray]:
        """Trace one sample of a pixel; return a structured array for each array of Record, by name."""
        device = self.prepared.device
        while True:
            accel = self.prepared.plan.structure.struct()
            accel.accel = self.prepared.accel.data
            accel.record.used = wp.zeros(len(ARRAYS), dtype=wp.int32, device=device)
            for (name, (dtype, _)), size in zip(ARRAYS.items(), self.sizes, strict=True):
                setattr(accel.record, name, wp.zeros(size, dtype=dtype, device=device))
            self.prepared.launch(self.film(x, y), accel)(Work((x, y, 1, 1), index, 1))
            used = accel.record.used.numpy().tolist()
            if all(n <= size for n, size in zip(used, self.sizes, strict=True)):
                return {name: on_host(getattr(accel.record, name))[:n].copy() for name, n in zip(ARRAYS, used, strict=True)}
            self.sizes = [max(n, size) for n, size in zip(used, self.sizes, strict=True)]
