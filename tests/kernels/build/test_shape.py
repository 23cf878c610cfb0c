"""Boxes and corners that a device computes have the bits of the host's boxes and corners."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from tests.kernel_tools import DEVICE  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.device import launch, launch_on
from wrt.kernels.build.shape import bounds, write_corners, write_rows
from wrt.kernels.structs import Primitive
from wrt.kernels.traverse.common import Units
from wrt.scene.clean import corners_have_area


def geometry_of(corners: np.ndarray) -> Geometry:
    """Return the triangles with these corners, (N, 3, 3), as a Geometry."""
    vertices = np.ascontiguousarray(corners, np.float32).reshape(-1, 3)
    spheres = np.array([[0.1, -2.0, 3.3, 0.7], [1e30, 0.0, -1e-40, 1e-3]], np.float32)
    return Geometry(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), spheres)


def hard_corners(n: int = 4000) -> np.ndarray:
    """Return corners of triangles of all sizes; the corners of most triangles are almost collinear."""
    rng = np.random.default_rng(3)
    a, b = (rng.integers(-(1 << 20), 1 << 20, size=(n, 3)).astype(np.float32) for _ in range(2))
    c = (a + rng.integers(-4, 5, size=(n, 1)).astype(np.float32) * (b - a)).astype(np.float32)  # Exactly collinear.
    near = rng.random(n) < 0.3
    c[near, 0] = np.nextafter(c[near, 0], np.float32(np.inf))
    grid = rng.integers(-3, 4, size=(n, 3, 3)).astype(np.float32) * np.float32(0.25)
    far = grid.copy()
    far[:, 1] *= np.float32(2.0**60)  # Their differences are not exact in float64.
    far[:, 2] = far[:, 1] * np.float32(2.0)
    scale = np.float32(2.0) ** rng.integers(-148, 120, size=(n, 1, 1)).astype(np.float32)
    return np.concatenate([np.stack([a, b, c], axis=1), grid, grid * scale, far])


def test_boxes_have_the_hosts_bits() -> None:
    geometry = geometry_of(hard_corners())
    low, high = (wp.zeros(len(geometry), dtype=wp.vec3, device=DEVICE) for _ in range(2))
    launch_on(DEVICE, bounds, len(geometry), geometry.on(DEVICE), low, high, None)
    for mine, theirs in zip((low, high), geometry.bounds(), strict=True):
        assert mine.numpy().tobytes() == theirs.tobytes()


def test_a_number_that_is_not_finite_makes_a_box_of_all_space() -> None:
    corners = np.zeros((2, 3, 3), np.float32)
    corners[0, 1, 2], corners[1, 2, 0] = np.nan, np.inf
    geometry = geometry_of(corners)
    low, high = (wp.zeros(len(geometry), dtype=wp.vec3, device=DEVICE) for _ in range(2))
    launch_on(DEVICE, bounds, len(geometry), geometry.on(DEVICE), low, high, None)
    assert (low.numpy()[:2] == -np.inf).all() and (high.numpy()[:2] == np.inf).all()


def test_corners_have_the_hosts_bits_and_the_same_have_no_area() -> None:
    geometry = geometry_of(hard_corners())
    corners = geometry.vertices.reshape(-1, 3, 3)
    share = corners_have_area(corners[:, 0], corners[:, 1], corners[:, 2]).mean()
    assert 0.2 < share < 0.9
    order = np.random.default_rng(0).permutation(len(geometry)).astype(np.int32)
    out = wp.empty(len(order), dtype=Primitive, device=DEVICE)
    launch_on(DEVICE, write_corners, len(order), geometry.on(DEVICE), wp.array(order, dtype=wp.int32, device=DEVICE), out, None)
    theirs, mine = geometry.primitives(Units(spheres=True), order), out.numpy()
    for name in ("v0", "v1", "v2", "prim_id"):
        np.testing.assert_array_equal(mine[name], theirs[name])


@pytest.mark.parametrize("width", [4, 8])
def test_rows_hold_the_hosts_records(width: int) -> None:
    """In each row, a lane without a primitive repeats the lane before it."""
    geometry, rng = geometry_of(hard_corners()), np.random.default_rng(1)
    order = rng.integers(0, len(geometry), 5000).astype(np.int32)
    starts = np.unique(np.append(np.arange(0, len(order) + 1, width), rng.integers(1, len(order), 2000))).astype(np.int32)
    rows = np.zeros((len(starts) - 1, 10, width), np.float32)
    launch(write_rows, len(rows), geometry.on(wp.get_device("cpu")), order, starts, width, rows.reshape(-1), None, step=700)
    lanes = np.array([[min(begin + lane, end - 1) for lane in range(width)] for begin, end in pairwise(starts)])
    records = geometry.primitives(Units(spheres=True), order).view(np.float32).reshape(-1, 10)
    np.testing.assert_array_equal(rows.view(np.int32)[:, 9], order[lanes])
    np.testing.assert_array_equal(rows[:, :9].transpose(0, 2, 1), records[lanes, :9])
