"""No structure: the yardstick that every other one is held to."""

from __future__ import annotations

import time
from typing import Any

from wrt.accel.base import Accelerator, AccelStats
from wrt.device import upload
from wrt.kernels import traverse_brute_force as kernels
from wrt.kernels.structs import Primitive


class BruteForce(Accelerator):
    name = "brute_force"
    kernels = kernels
    struct = kernels.BruteForce

    def _build(self, begin: float, **options: Any) -> tuple[Any, AccelStats]:
        if options:
            raise TypeError(f"brute_force takes no options, got {', '.join(options)}")
        data = kernels.BruteForce()
        primitives = self.geometry.primitives()
        data.primitives = upload(primitives, Primitive, self.device)
        stats = AccelStats(time.perf_counter() - begin, 0, 0, 0, primitives.nbytes, float(len(self.geometry)))
        return data, stats
