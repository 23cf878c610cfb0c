"""No structure: the yardstick that every other one is held to."""

from __future__ import annotations

import time
from typing import Any

from wrt.accel.base import Accelerator, AccelStats
from wrt.device import upload
from wrt.kernels import traverse_brute_force as kernels


class BruteForce(Accelerator):
    name = "brute_force"
    kernels = kernels

    def _build(self, begin: float, **options: Any) -> tuple[Any, AccelStats]:
        if options:
            raise TypeError(f"brute_force takes no options, got {', '.join(options)}")
        data = self.structure.struct()
        primitives = self.geometry.primitives(self.structure.units)
        data.primitives = upload(primitives, self.structure.units.triangle_test.record, self.device)
        stats = AccelStats(time.perf_counter() - begin, 0, 0, 0, primitives.nbytes, float(len(self.geometry)))
        return data, stats
