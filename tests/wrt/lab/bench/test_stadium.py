"""The stadium: steps that leave no gap, and a mesh in it that a uniform grid has in one cell."""

from __future__ import annotations

import numpy as np
import pytest

from wrt.accel.scenes.build import build
from wrt.lab.bench.meshes import in_stadium, stands
from wrt.lab.bench.rays import ray_sets
from wrt.scene.shapes import icosphere


def test_the_stands_are_steps_all_around() -> None:
    mesh = stands(tiers=5, seats=24)
    assert len(mesh.faces) == 2 + 4 * 5 * 24
    ends = np.sort(mesh.faces[:-2][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, times = np.unique(ends, axis=0, return_counts=True)
    assert set(times) == {1, 2} and (times == 1).sum() == 2 * 24  # open only at the first and the last ring
    corner = mesh.vertices[mesh.faces[:-2]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    flat = np.abs(normal[:, 1]) > 0.99 * np.linalg.norm(normal, axis=1)
    assert flat.sum() == (~flat).sum() and (np.abs(normal[~flat, 1]) < 1e-6).all()


def test_a_uniform_grid_is_not_enough_and_an_adaptive_one_is() -> None:
    ball = icosphere(4)
    scene = in_stadium(ball)
    assert np.array_equal(scene.faces[: len(ball.faces)], ball.faces) and np.ptp(scene.vertices[:, 0]) > 500.0 * 2.0
    rays = ray_sets(build(ball, "bvh2"), 400)["primary"]
    tests = {}
    for name in ("grid", "octree", "bvh2"):
        for mesh, where in ((ball, "alone"), (scene, "stadium")):
            hits = build(mesh, name).closest_hit(rays.origins, rays.directions, counters=True)
            assert (hits.prim_id[hits.prim_id >= 0] < len(ball.faces)).mean() > 0.3
            tests[name, where] = hits.counters.primitives.mean()
    assert tests["grid", "stadium"] > 0.4 * len(ball.faces) > 30.0 * tests["grid", "alone"]
    for name in ("octree", "bvh2"):
        assert tests[name, "stadium"] < 5.0 * tests[name, "alone"] + 5.0


@pytest.mark.parametrize("times", [10.0, 1e4])
def test_the_mesh_stands_on_the_pitch(times: float) -> None:
    ball = icosphere(1)
    scene = in_stadium(ball, times)
    around = scene.vertices[len(ball.vertices):]
    assert around[:, 1].min() == ball.vertices[:, 1].min() and np.abs(around).max() == pytest.approx(times * np.sqrt(3.0), rel=1e-3)
