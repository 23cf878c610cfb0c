"""Gradients of hits agree with central differences, with NumPy and on a wp.Tape."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import warp as wp

import wrt
from tests.device import NAME as DEVICE
from tests.refused import Refusal, refused
from wrt.accel.geometry import Geometry
from wrt.accel.queries.gradients import Cotangents, adjoint
from wrt.scene import shapes

N = 10_000
vec3s = partial(wp.array, dtype=wp.vec3, device=DEVICE)


def soup(rng: np.random.Generator, n: int = 400) -> wrt.Mesh:
    """Return triangles of all shapes around the origin; a tenth are needles."""
    corners = rng.normal(size=(n, 3, 3)) * rng.uniform(0.05, 1.0, (n, 1, 1)) + rng.normal(size=(n, 1, 3))
    corners[::10, 2] = corners[::10, 1] + 0.02 * (corners[::10, 2] - corners[::10, 1])
    return wrt.Mesh(np.float32(corners.reshape(-1, 3)), np.arange(3 * n, dtype=np.int32).reshape(-1, 3))


def rays(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rays from outside towards the neighbourhood of the origin, with directions of all lengths."""
    origins = rng.normal(size=(n, 3)) * 3.0
    return np.float32(origins), np.float32((rng.normal(size=(n, 3)) - origins) * rng.uniform(0.1, 10.0, (n, 1)))


def hit_of(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return t, u, v and the point, (N, 6) float64, as solutions of o + t d = v0 + u (v1 - v0) + v (v2 - v0), without wrt."""
    matrix = np.stack([direction, corners[:, 0] - corners[:, 1], corners[:, 0] - corners[:, 2]], axis=2)
    tuv = np.linalg.solve(matrix, (corners[:, 0] - origin)[..., None])[..., 0]
    return np.concatenate([tuv, origin + tuv[:, :1] * direction], axis=1)


def by_differences(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the gradient of the weighted sum of each ray's t, u, v and point with respect to corners, origin and direction,
    (N, 5, 3). It comes from central differences in float64 with Richardson's extrapolation; steps scale with the triangle."""
    size = np.abs(corners - corners[:, [1, 2, 0]]).max(axis=(1, 2))
    slim = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / size
    length = np.linalg.norm(direction, axis=1)
    step = 1e-4 * np.minimum(slim, size) * np.abs(facing(corners, direction))
    steps = np.stack([step, step, step, step, step * length / np.linalg.norm(corners[:, 0] - origin, axis=1)], axis=1)
    out = np.zeros((len(corners), 5, 3))
    for part, axis in np.ndindex(5, 3):
        rise = []
        for scale in (1.0, 2.0):
            ends = []
            for sign in (1.0, -1.0):
                given = np.concatenate([corners, origin[:, None], direction[:, None]], axis=1)
                given[:, part, axis] += sign * scale * steps[:, part]
                ends.append((hit_of(given[:, :3], given[:, 3], given[:, 4]) * weights).sum(axis=1))
            rise.append((ends[0] - ends[1]) / (2.0 * scale * steps[:, part]))
        out[:, part, axis] = (4.0 * rise[0] - rise[1]) / 3.0
    return out


def facing(corners: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the cosine of the angle between each ray and its triangle's normal."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (normal * direction).sum(axis=1) / (np.linalg.norm(normal, axis=1) * np.linalg.norm(direction, axis=1))


def cotangents(rng: np.random.Generator, n: int) -> Cotangents:
    return Cotangents(*rng.normal(size=(3, n)), rng.normal(size=(n, 3)))


def test_against_central_differences_for_10_000_random_hits() -> None:
    """Each ray has its own triangle, so that the gradient at a vertex is of one ray. The error is relative to the norm of all 15
    derivatives of a ray."""
    rng = np.random.default_rng(0)
    mesh = soup(rng)
    accel = wrt.build(mesh)
    origins, directions = rays(rng, 40_000)
    hits = accel.closest_hit(origins, directions)
    chosen = np.nonzero(hits.prim_id >= 0)[0][:N]
    assert len(chosen) == N
    o, d, corners = origins[chosen], directions[chosen], mesh.vertices[mesh.faces[hits.prim_id[chosen]]]
    own = Geometry(corners.reshape(-1, 3), np.arange(3 * N, dtype=np.int32).reshape(-1, 3), np.zeros((0, 4)))
    given = cotangents(rng, N)
    found = adjoint(own, o, d, np.arange(N), given)
    ours = np.concatenate([found.vertices.reshape(N, 3, 3), found.origins[:, None], found.directions[:, None]], axis=1)
    weights = np.column_stack([given.t, given.u, given.v, given.point])
    expected = by_differences(*(array.astype(np.float64) for array in (corners, o, d)), weights)
    error = np.linalg.norm(ours - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    print(f"relative error of a ray's 15 derivatives: {error.max():.1e} at most, {np.median(error):.1e} median of {N} hits")
    assert error.max() < 1e-4
    assert np.median(error) < 1e-9
    # The same hits on a mesh with shared vertices.
    whole = adjoint(accel.geometry, o, d, hits.prim_id[chosen], given)
    added = np.zeros((len(mesh.vertices), 3))
    np.add.at(added, mesh.faces[hits.prim_id[chosen]], found.vertices.reshape(N, 3, 3))
    np.testing.assert_allclose(whole.vertices, added, rtol=1e-12, atol=1e-12 * np.abs(added).max())


def test_misses_have_no_part_and_no_derivatives_whatever_is_given_for_them() -> None:
    rng = np.random.default_rng(1)
    origins, directions = rays(rng, 2000)
    hits = wrt.build(shapes.icosphere(2)).closest_hit(origins, directions)
    miss, given = hits.prim_id < 0, cotangents(rng, 2000)
    zero, wild = (Cotangents(*(np.where(miss if each.ndim == 1 else miss[:, None], value, each) for each in given))
                  for value in (0.0, np.nan))
    assert 200 < miss.sum() < 1800
    for ours, expected in zip(hits.gradients(*wild), hits.gradients(*zero), strict=True):
        np.testing.assert_array_equal(ours, expected)
    assert (hits.gradients(*wild).origins[miss] == 0.0).all() and (hits.gradients(*wild).directions[miss] == 0.0).all()
    none = hits.gradients()
    assert not none.vertices.any() and not none.origins.any() and not none.directions.any()


def test_a_ray_along_a_plane_and_a_triangle_without_area_have_none() -> None:
    """In the plane the limit is infinite. Near the plane, derivatives are large and correct."""
    corners = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 2, 2], [2, 2, 2], [3, 3, 3]])
    geometry = Geometry(corners, np.int32([[0, 1, 2], [3, 4, 5]]), np.zeros((0, 4)))
    o = np.float32([[-1.0, 0.2, 0.0], [2.0, 2.0, 5.0], [-1.0, 0.2, 1e-6]])
    d = np.float32([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.25, 0.0, -1e-6]])
    given = Cotangents(np.ones(3), np.ones(3), np.ones(3), np.ones((3, 3)))
    found = adjoint(geometry, o, d, np.int32([0, 1, 0]), given)
    assert all(np.isfinite(array).all() for array in found)
    assert not found.origins[:2].any() and not found.directions[:2].any() and not found.vertices[3:].any()
    t = hit_of(corners[None, :3].astype(np.float64), o[2:].astype(np.float64), d[2:].astype(np.float64))[0, 0]
    by_height = adjoint(geometry, o[2:], d[2:], np.int32([0]), Cotangents(t=np.ones(1))).origins[0]
    np.testing.assert_allclose(by_height, [0.0, 0.0, -1.0 / np.float64(d[2, 2])], rtol=1e-12)
    assert t == pytest.approx(1.0)


def test_sums_at_vertices_have_the_same_bits_on_any_number_of_threads() -> None:
    rng = np.random.default_rng(2)
    origins, directions = rays(rng, 30_000)
    accel = wrt.build(shapes.icosphere(1))
    hits, given = accel.closest_hit(origins, directions), cotangents(rng, 30_000)
    found = [adjoint(accel.geometry, origins, directions, hits.prim_id, given, threads) for threads in (1, 3, 3)]
    for other in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_gradients_are_of_the_shape_that_was_asked() -> None:
    rng = np.random.default_rng(3)
    ball = shapes.icosphere(2)
    accel, (origins, directions) = wrt.build(ball), rays(rng, 500)
    hits, given = accel.closest_hit(origins, directions), cotangents(rng, 500)
    before = hits.gradients(*given)
    accel.refit(1.5 * ball.vertices)
    for a, b in zip(before, hits.gradients(*given), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(before.vertices, accel.closest_hit(origins, directions).gradients(*given).vertices)


def test_what_is_refused() -> None:
    rng = np.random.default_rng(4)
    origins, directions = rays(rng, 5)
    hits = wrt.build(shapes.icosphere(1)).closest_hit(origins, directions)
    for given, said in (({"t": np.ones(4)}, ("t", "(5,)")), ({"point": np.ones(5)}, ("point", "(5, 3)")),
                        ({"u": np.full(5, "a")}, ("u", "(5,)"))):
        with refused(*said):
            hits.gradients(**given)
    with refused(what="have no rays"):
        pickle.loads(pickle.dumps(hits)).gradients(t=np.ones(5))
    ball = Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.float32([[0, 0, 0, 1]]))
    with refused("accel", "structure over one mesh"):
        wrt.build(ball).closest_hit(origins, directions).gradients(t=np.ones(5))


# --- wp.Tape ----------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=True)
def weighted(t: wp.array(dtype=float), point: wp.array(dtype=wp.vec3), by_t: wp.array(dtype=float),
             by_point: wp.array(dtype=wp.vec3), loss: wp.array(dtype=float)):
    i = wp.tid()
    if t[i] < 1.0e30:
        wp.atomic_add(loss, 0, by_t[i] * t[i] + wp.dot(by_point[i], point[i]))


@pytest.mark.parametrize("accel", ["bvh2", "bvh"])
def test_a_tape_goes_through_a_refit_and_hits(accel: str) -> None:
    rng = np.random.default_rng(5)
    ball, (origins, directions), given = shapes.icosphere(2), rays(rng, 300), cotangents(rng, 300)
    structure = wrt.build(ball, accel)
    points, o, d = (vec3s(each, requires_grad=True) for each in (1.2 * ball.vertices, origins, directions))
    by_t, by_point = wp.array(given.t, dtype=float, device=DEVICE), vec3s(given.point)
    loss = wp.zeros(1, dtype=float, device=DEVICE, requires_grad=True)
    with wp.Tape() as tape:
        structure.refit(points)
        hits = structure.closest_hit(o, d)
        wp.launch(weighted, 300, [hits.t, hits.point, by_t, by_point], [loss], device=DEVICE)
    tape.backward(loss)
    expected = hits.gradients(t=np.float32(given.t), point=np.float32(given.point))
    assert np.abs(expected.vertices).max() > 1.0
    for array, values in zip((points, o, d), expected, strict=True):
        np.testing.assert_allclose(array.grad.numpy(), values, rtol=2e-6, atol=2e-6 * np.abs(values).max())
    tape.zero()
    assert not points.grad.numpy().any() and not hits.t.grad.numpy().any()


def test_what_a_tape_would_wait_for_in_vain_is_refused() -> None:
    rng = np.random.default_rng(6)
    ball, (origins, directions) = shapes.icosphere(1), map(vec3s, rays(rng, 20))
    structure, points = wrt.build(ball, "bvh2"), vec3s(ball.vertices, requires_grad=True)
    calls: list[tuple[Refusal, Callable[[], object]]] = [
        (("vertices", "normal has none"), lambda: structure.closest_hit(origins, directions).normal),
        ((None, "pass rays as Warp arrays"), lambda: structure.closest_hit(origins.numpy(), directions.numpy())),
        (("vertices", "refit in place"), lambda: structure.refit(points, in_place=True))]
    structure.refit(points)
    for said, ask in calls:
        with refused(*said), wp.Tape():
            ask()
