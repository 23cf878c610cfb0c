"""Refits in place of wide BVHs: arrays have the bits of a refit on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.refused import refused

from tests.kernel_tools import DEVICE, cpu_only  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.core.device import on_host
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

BALL, WIDE = icosphere(2), ("bvh4", "bvh8", "bvh8c")
SPHERES = np.float32([[0.0, 0.0, 3.0, 0.5], [2.0, 0.0, 0.0, 1.0]])
CASES = {
    "moved": lambda rng: BALL.vertices + 0.3 * rng.normal(size=BALL.vertices.shape),
    "flat": lambda rng: BALL.vertices * [1.0, 0.0, 1.0],
    "a point": lambda rng: 0.0 * BALL.vertices,
    "all scales": lambda rng: BALL.vertices * 10.0 ** rng.uniform(-45.0, 38.5, (len(BALL.vertices), 1)),
    "huge": lambda rng: 3e38 * np.sign(BALL.vertices),
    "tiny": lambda rng: 1e-44 * BALL.vertices,
    "far": lambda rng: BALL.vertices + [1e6, -3e4, 0.0],
    "nan": lambda rng: np.where(rng.random(BALL.vertices.shape) < 0.02, np.nan, BALL.vertices),
    "inf": lambda rng: np.where(rng.random(BALL.vertices.shape) < 0.02, -np.inf, BALL.vertices),
    "all nan": lambda rng: np.nan * BALL.vertices,
}


def points_of(vertices: np.ndarray) -> Any:
    with np.errstate(over="ignore"):
        return wp.array(np.asarray(vertices, np.float32), dtype=wp.vec3, device=DEVICE)


def assert_refitted(accel: Any, vertices: np.ndarray) -> None:
    """Compare the arrays with those of the host's refit."""
    host = accel._over(Geometry(np.asarray(vertices, np.float32), accel.geometry.faces, accel.geometry.spheres))
    built = host._refit(accel.snapshot.arrays)
    for found, expected in ((accel.data.nodes, built.arrays["nodes"]), (accel.data.primitives, host._primitives(built))):
        np.testing.assert_array_equal(on_host(found).view(np.uint32), expected.view(np.uint32))


@pytest.mark.parametrize("name", WIDE)
def test_arrays_of_a_refit_in_place_have_the_bits_of_one_on_the_host(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    structures = [build(Geometry(BALL.vertices, BALL.faces, spheres), name, **options) for spheres, options in (
        (SPHERES[:0], {}), (SPHERES, {"max_leaf": 1}), (SPHERES, {"max_leaf": 40, "cost_traversal": 5.0}), (SPHERES, {"builder": "sbvh"}))]
    for accel in structures:
        accel.refit(points_of(BALL.vertices), in_place=True)
    monkeypatch.setattr("wrt.accel.bvh.in_place.vectors", lambda *_: None)  # a graph reads points unchecked, too
    monkeypatch.setattr("wrt.accel.bvh.wide.SLOTS_PER_JOB", 64)
    data = [accel.data for accel in structures]
    for case in CASES.values():
        with np.errstate(over="ignore"):
            vertices = np.float32(case(rng))
        for accel in structures:
            accel.refit(points_of(vertices), in_place=True)
            assert_refitted(accel, vertices)
    assert all(accel.data is each for accel, each in zip(structures, data, strict=True))


@pytest.mark.parametrize("name", WIDE)
def test_small_trees(name: str) -> None:
    for count in (0, 1, 2, 9):
        mesh = Mesh(BALL.vertices, BALL.faces[:count])
        accel = build(mesh, name)
        accel.refit(points_of(2.0 * BALL.vertices), in_place=True)
        assert_refitted(accel, 2.0 * BALL.vertices)
    spheres = build(Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), SPHERES), name)
    spheres.refit(points_of(np.zeros((0, 3))), in_place=True)
    assert_refitted(spheres, np.zeros((0, 3)))


@cpu_only
def test_a_graph_of_the_cpu_captures_a_refit_in_place() -> None:
    accel, points = build(BALL, "bvh8"), points_of(BALL.vertices)
    with refused(None, "the first refit in place"), wp.ScopedCapture("cpu"):
        accel.refit(points, in_place=True)
    accel.refit(points, in_place=True)
    with wp.ScopedCapture("cpu") as capture:
        accel.refit(points, in_place=True)
    for case in ("moved", "nan"):
        points.assign(np.float32(vertices := CASES[case](np.random.default_rng(1))))
        wp.capture_launch(capture.graph)
        assert_refitted(accel, vertices)
