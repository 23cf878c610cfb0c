"""wrt.jax: the adjoint as a custom derivative, also under jit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import wrt
from tests.wrt.accel.queries.test_gradients import cotangents, rays
from wrt.core.errors import InputError
from wrt.scene import shapes

jax = pytest.importorskip("jax", reason="wrt does not need jax: the extra jax brings it")


def test_the_adjoint_as_it_is_and_compiled() -> None:
    rng = np.random.default_rng(0)
    ball, accel, given = shapes.icosphere(2), wrt.build(shapes.icosphere(2)), cotangents(rng, 300)
    leaves = (np.float32(1.3) * ball.vertices, *rays(rng, 300))

    def loss(*leaves: Any) -> Any:
        found = wrt.jax.closest_hit(accel, *leaves)
        hit = found.prim_id >= 0
        return sum(jax.numpy.where(hit if part.ndim == 1 else hit[:, None], weight * part, 0.0).sum()
                   for weight, part in zip(given, found, strict=False))

    hits = wrt.build((leaves[0], ball.faces)).closest_hit(*leaves[1:])
    expected = hits.gradients(*(np.float32(each) for each in given))
    assert 30 < (hits.prim_id >= 0).sum() < 270
    for derivative in (jax.grad(loss, (0, 1, 2)), jax.jit(jax.grad(loss, (0, 1, 2)))):
        for ours, true in zip(derivative(*leaves), expected, strict=True):
            np.testing.assert_allclose(ours, true, rtol=2e-6, atol=2e-6 * np.abs(true).max())


def test_the_ends_of_a_segment_have_derivatives_of_zero() -> None:
    accel, (o, d) = wrt.build(shapes.icosphere(2)), rays(np.random.default_rng(3), 20)
    by_end = jax.grad(lambda end: wrt.jax.closest_hit(accel, None, o, d, t_max=end).u.sum())(np.full(20, np.inf, np.float32))
    np.testing.assert_array_equal(by_end, np.zeros(20))


def test_values_and_batches() -> None:
    accel, (origins, directions) = wrt.build(shapes.icosphere(2)), rays(np.random.default_rng(1), 100)
    hits = accel.closest_hit(origins, directions, t_max=5.0)
    found = jax.jit(lambda o: wrt.jax.closest_hit(accel, None, o, directions, t_max=5.0))(origins)
    batch = jax.vmap(lambda o: wrt.jax.closest_hit(accel, None, o, directions, t_max=5.0))(np.stack([origins, origins]))
    for name in ("t", "u", "v", "prim_id", "point"):
        np.testing.assert_array_equal(getattr(found, name), getattr(hits, name))
        np.testing.assert_array_equal(getattr(batch, name)[1], getattr(hits, name))
    with pytest.raises(InputError, match=r"must both be \(N, 3\)"):
        wrt.jax.closest_hit(accel, None, origins, directions[:, :2])


def test_far_from_0_gradients_are_those_of_0() -> None:
    ball, place = shapes.icosphere(3), np.float32([4096.0, 8192.0, 0.0])
    vertices, origin, direction = (ball.vertices * 64).round() / 64, np.float32([[0.125, 0.25, 5.0]]), np.float32([[0.0, 0.125, -1.0]])
    found = []
    for at in (np.zeros(3, np.float32), place):  # all sums are exact
        accel = wrt.build((np.float64(vertices) + at, ball.faces))
        for corners in (None, vertices + at):

            def loss(o: Any, d: Any, accel: Any = accel, corners: Any = corners) -> Any:
                return wrt.jax.closest_hit(accel, corners, o, d).t.sum()

            found.append(jax.grad(loss, (0, 1))(origin + at, direction))
    for each in found[1:]:
        np.testing.assert_allclose(np.concatenate(each), np.concatenate(found[0]), rtol=1e-5)
