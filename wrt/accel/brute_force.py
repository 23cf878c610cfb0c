"""Test of all primitives: the reference for every structure."""

from __future__ import annotations

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.snapshot import Built
from wrt.accel.structures import NoOptions
from wrt.core.errors import InputError
from wrt.kernels.traverse import brute_force as kernels


class BruteForce(OneMesh):
    """Test of all primitives, one after another."""

    name = "brute_force"
    kernels = kernels
    options = NoOptions
    can_refit = True

    def _build(self, options: NoOptions) -> Built:
        n = len(self.geometry)
        return Built({}, np.arange(n, dtype=np.int32), sah_cost=float(n))

    def _check(self, built: Built) -> None:
        if not np.array_equal(built.order, np.arange(len(self.geometry))):
            raise InputError("is damaged: its primitives are not all there once, in order")

    def _refit(self, built: Built) -> Built:
        return built
