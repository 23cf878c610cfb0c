"""The kinds of ray: what each promises, on closed forms; and a mesh in a stadium, which a uniform grid has in one cell."""

from __future__ import annotations

import numpy as np
import pytest

from wrt.accel.scenes.build import build
from wrt.lab.bench.rays import RAY_KINDS, in_stadium, ray_sets
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere


@pytest.fixture(scope="module")
def ball():
    return build(icosphere(4), "bvh2")


def test_all_kinds_have_the_same_number_of_rays_and_come_again(ball) -> None:
    first, again, other = ray_sets(ball, 1000, 3), ray_sets(ball, 1000, 3), ray_sets(ball, 1000, 4)
    assert list(first) == list(RAY_KINDS) and {len(rays) for rays in first.values()} == {31 * 31}
    for kind in RAY_KINDS:
        np.testing.assert_array_equal(first[kind].directions, again[kind].directions)
        assert np.isfinite(first[kind].origins).all() and np.isfinite(first[kind].directions).all()
        assert first[kind].any_hit == (kind == "shadow")
    assert (first["random"].origins != other["random"].origins).any()


def test_primary_rays_see_the_ball_and_neighbours_are_near(ball) -> None:
    rays = ray_sets(ball, 10_000)["primary"]
    hit = ball.closest_hit(rays.origins, rays.directions).prim_id >= 0
    # A ball of radius 1 in a box of half diagonal sqrt(3), seen from 1.5 sqrt(3) off.
    sine = 1.0 / (1.5 * np.sqrt(3.0))
    share = np.pi * np.tan(np.arcsin(sine)) ** 2 / (2.0 * 0.55) ** 2
    assert hit.mean() == pytest.approx(share, rel=0.03)
    step = np.linalg.norm(np.diff(rays.directions.reshape(100, 100, 3), axis=1), axis=-1)
    assert step.max() < 2.5 * 0.55 / 100 * 1.01


def test_diffuse_rays_leave_a_convex_body(ball) -> None:
    rays = ray_sets(ball, 4000)["diffuse"]
    assert (np.linalg.norm(rays.origins, axis=1) < 1.001).all()
    assert (ball.closest_hit(rays.origins, rays.directions).prim_id < 0).all()
    cosine = (rays.origins / np.linalg.norm(rays.origins, axis=1, keepdims=True) * rays.directions).sum(axis=1)
    assert cosine.mean() == pytest.approx(2.0 / 3.0, abs=0.02)  # the mean cosine of a cosine distribution


def test_shadow_rays_end_at_one_light_and_are_dark_where_the_ball_is_in_the_way(ball) -> None:
    rays = ray_sets(ball, 4000)["shadow"]
    ends = rays.origins.astype(np.float64) + rays.directions
    assert np.ptp(ends, axis=0).max() < 1e-5 and (rays.t_max == 1.0).all()
    light = ends.mean(axis=0)
    dark = ball.any_hit(rays.origins, rays.directions, 0.0, rays.t_max)
    behind = (rays.origins / np.linalg.norm(rays.origins, axis=1, keepdims=True)) @ light < 1.0  # beyond the light's horizon
    assert (dark != behind).mean() < 0.03 and 0.01 < dark.mean() < 0.9


def test_random_rays_cross_the_ball_as_often_as_its_surface_says(ball) -> None:
    rays = ray_sets(ball, 40_000)["random"]
    hit = ball.closest_hit(rays.origins, rays.directions).prim_id >= 0
    assert hit.mean() == pytest.approx(1.0 / 3.0, abs=0.01)  # uniform lines: ratio of the surfaces, 1 to sqrt(3)^2


def test_a_mesh_that_is_not_seen_has_rays_all_the_same() -> None:
    thin = Mesh(np.array([[0.0, 0.0, 0.0], [1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0], [50.0, 50.0, 50.0], [50.0, 50.0, 50.0001],
                          [50.0, 50.0001, 50.0]], np.float32), np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    for rays in ray_sets(build(thin, "bvh2"), 16).values():
        assert len(rays) == 16 and np.isfinite(rays.origins).all() and np.isfinite(rays.directions).all()
        assert (np.abs(rays.directions).max(axis=1) > 0.0).all()


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
