"""Boxes around runs of primitives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.snapshot import Built
from wrt.core.device import records
from wrt.core.errors import InputError
from wrt.kernels.traverse import runs as kernels


@dataclass(frozen=True)
class RunsOptions:
    length: int = 64  # Primitives in a run.

    def __post_init__(self) -> None:
        if self.length < 1:
            raise InputError(f"must be at least 1, got {self.length}", argument="length")


class Runs(OneMesh):
    """Boxes around runs of primitives."""

    name = "runs"
    kernels = kernels
    options = RunsOptions

    def _build(self, options: RunsOptions) -> Built:
        length = options.length
        lo, hi = self.geometry.bounds()
        n = len(lo)
        if n == 0:
            return Built({"nodes": records(kernels.Run, 0)}, np.zeros(0, np.int32), sah_cost=0.0)
        axis = int(np.argmax(hi.max(axis=0) - lo.min(axis=0)))
        order = np.argsort(lo[:, axis], kind="stable").astype(np.int32)
        first = np.arange(0, n, length)
        nodes = records(kernels.Run, len(first))
        nodes["first"], nodes["count"] = first, np.minimum(length, n - first)
        nodes["lo"] = np.minimum.reduceat(lo[order], first)
        nodes["hi"] = np.maximum.reduceat(hi[order], first)
        return Built({"nodes": nodes}, order, len(nodes), len(nodes), 1)

    def _check(self, built: Built) -> None:
        first, count = (built.arrays["nodes"][name].astype(np.int64) for name in ("first", "count"))
        if (first < 0).any() or (count < 0).any() or (first + count > len(built.order)).any():
            raise InputError("is damaged: a run leaves the primitives")
