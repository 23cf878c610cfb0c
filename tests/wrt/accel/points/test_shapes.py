"""Points of any leading shape: results have this shape, and the bits of rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.device import NAME as DEVICE
from wrt.scene import shapes

QUERIES: dict[str, Callable[..., Any]] = {
    "contains": wrt.contains, "winding_number": wrt.winding_number, "signed_distance": wrt.signed_distance,
    "distance": lambda *args, **more: wrt.closest_points(*args, **more).distance,
    "point": lambda *args, **more: wrt.closest_points(*args, **more).point}


@pytest.mark.parametrize("name", QUERIES)
def test_points_of_any_shape(name: str) -> None:
    query, ball = QUERIES[name], shapes.icosphere(2)
    accel, worlds, points = wrt.build(ball), wrt.build([ball, shapes.box()]), np.float32(np.random.default_rng(0).normal(size=(4, 6, 3)))
    rows, world = query(accel, points.reshape(-1, 3)), np.arange(6) % 2
    own = rows.shape[1:]
    for given, shape in ((points, (4, 6)), (points.tolist(), (4, 6)), (wp.array(points, dtype=wp.vec3, device=DEVICE), (4, 6)),
                         (points.reshape(2, 2, 6, 3), (2, 2, 6)), (points[:0], (0, 6))):
        found = query(accel, given)
        assert found.shape == (*shape, *own) and found.tobytes() == rows[:found.size // max(1, int(np.prod(own)))].tobytes()
    assert query(accel, points[1, 2]).shape == own and np.array_equal(query(accel, points[1, 2]), rows[8])
    expected = query(worlds, points.reshape(-1, 3), world=np.tile(world, 4))
    assert np.array_equal(query(worlds, points, world=world), expected.reshape(4, 6, *own))


@pytest.mark.parametrize("name", QUERIES)
def test_tensors_of_any_shape(name: str) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: wrt does not need it")
    query, accel = QUERIES[name], wrt.build(shapes.icosphere(2))
    points = torch.linspace(-1.0, 1.0, 24).reshape(2, 4, 3)
    expected = query(accel, points.numpy())
    assert np.array_equal(np.asarray(query(accel, points)), expected)
    assert np.array_equal(np.asarray(query(accel, points[1, 2])), expected[1, 2])
