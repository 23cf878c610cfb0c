"""Rays at the largest coordinates that queries accept."""

import numpy as np
import pytest

import wrt
from wrt.kernels.query import FARTHEST, LARGEST
from wrt.scene.shapes import box


@pytest.mark.parametrize("n", [1, 64])  # one ray, and packets
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_limits_themselves_are_accepted(n: int, sign: float) -> None:
    accel = wrt.build(box())
    far, near = np.zeros((n, 3), np.float32), np.full((n, 3), (0.1, 0.2, 5.0), np.float32)
    far[:, 1] = sign * float(FARTHEST)
    down, fast = np.full((n, 3), (0.0, 0.0, -1.0), np.float32), np.full((n, 3), (0.0, 0.0, -float(LARGEST)), np.float32)
    assert (accel.closest_hit(far, down).prim_id == -1).all()
    hits = accel.closest_hit(near, fast)
    assert (hits.prim_id >= 0).all() and (hits.t <= np.float32(5.0) / np.float32(LARGEST)).all()
    with pytest.raises(wrt.InputError):
        accel.closest_hit(np.nextafter(far, np.float32(sign * np.inf)), down)
