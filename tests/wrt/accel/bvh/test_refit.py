"""Refit: hits in a refitted tree are as exact as in a new tree, and Refit.growth is the growth of the SAH cost."""

from __future__ import annotations

import numpy as np
import pytest

from tests.refused import Refusal, refused
from wrt.accel.bvh.builders import BVH_BUILDERS
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.scene.shapes import icosphere

BALL = icosphere(3)


def twisted(vertices: np.ndarray, angle: float) -> np.ndarray:
    a = angle * vertices[:, 1]
    x, y, z = vertices.T
    return np.stack([np.cos(a) * x - np.sin(a) * z, y, np.sin(a) * x + np.cos(a) * z], axis=1).astype(np.float32)


def rays(n: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(n, 3)).astype(np.float32)
    return origins, (0.5 * rng.normal(size=(n, 3)) - origins).astype(np.float32)


@pytest.mark.parametrize("builder", BVH_BUILDERS)
def test_answers_are_those_of_brute_force_after_every_step(builder: str) -> None:
    accel = build(BALL, "bvh2", builder=builder)
    for angle in (0.3, 2.0, -1.0):
        vertices = twisted(BALL.vertices, angle)
        accel.refit(vertices)
        truth = build(Geometry(vertices, BALL.faces, np.zeros((0, 4), np.float32)), "brute_force").closest_hit(*rays())
        hits = accel.closest_hit(*rays())
        for field in ("t", "u", "v", "prim_id"):
            np.testing.assert_array_equal(getattr(hits, field), getattr(truth, field))
        np.testing.assert_array_equal(accel.any_hit(*rays()), truth.prim_id >= 0)


def test_cost_grows_as_the_motion_mixes_and_a_new_tree_is_built_past_the_threshold() -> None:
    accel = build(BALL, "bvh2")
    built_cost = accel.stats.sah_cost
    mixed = BALL.vertices[np.random.default_rng(0).permutation(len(BALL.vertices))]
    done = accel.refit(mixed)
    assert done.growth > 2.0 and not done.rebuilt and accel.stats.sah_cost == pytest.approx(done.growth * built_cost)
    assert accel.refit(BALL.vertices).growth == pytest.approx(1.0)  # relative to the last build
    for limit in ("x", np.nan, -1.0, None):
        with refused("rebuild_at", "must be"):
            accel.refit(mixed, rebuild_at=limit)  # type: ignore[arg-type]
    done = accel.refit(mixed, rebuild_at=1.5)
    assert done.rebuilt and done.growth > 2.0 and accel.stats.sah_cost < done.growth * built_cost
    assert accel.refit(mixed, rebuild_at=1.5).rebuilt is False


@pytest.mark.parametrize(("vertices", "message"), [
    (BALL.vertices[:-1], ("vertices",)), (np.full_like(BALL.vertices, np.nan), ("vertices", "finite")), ("x", ("vertices",)),
])
def test_wrong_vertices_are_refused_and_nothing_moves(vertices, message: Refusal) -> None:
    accel = build(BALL, "bvh2")
    with refused(*message):
        accel.refit(vertices)
    assert accel.geometry.vertices is BALL.vertices or np.array_equal(accel.geometry.vertices, BALL.vertices)


def test_empty_and_single_trees() -> None:
    for n in (0, 1, 2):
        accel = build(Geometry(BALL.vertices, BALL.faces[:n], np.zeros((0, 4), np.float32)), "bvh2")
        accel.refit(BALL.vertices + np.float32(1.0))
        middle = BALL.vertices[BALL.faces[0]].mean(axis=0) + 1.0
        assert (accel.closest_hit(np.zeros((1, 3)), middle[None]).prim_id[0] == 0) == (n > 0)
