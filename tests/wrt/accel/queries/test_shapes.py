"""Rays of any leading shape have the hits of the same rays as rows, in the shape that was asked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
import wrt.sensors
from tests.kernel_tools import DEVICE
from tests.refused import refused
from wrt.accel.queries.batches import copy_from_tiles, copy_to_tiles, tiled_width
from wrt.core.arrays import to_numpy
from wrt.scene.shapes import icosphere

SHAPE = 3, 5
PROPERTIES = "hit", "distance", "point", "points", "point_error", "normal", "normals", "shading_normal"
FIELDS = "t", "u", "v", "prim_id"


@pytest.fixture(scope="module")
def ball() -> Any:
    return wrt.build(icosphere(2))


def some_rays(*shape: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    origins = (2.0 * rng.normal(size=(*shape, 3))).astype(np.float32)
    return origins, (1.2 * rng.normal(size=(*shape, 3)) - origins).astype(np.float32)


def assert_same(found: Any, rows: Any, shape: tuple[int, ...]) -> None:
    """The hits have the shape and the bits of the hits of the same rays as rows."""
    for name in FIELDS + PROPERTIES:
        array, expected = to_numpy(getattr(found, name)), to_numpy(getattr(rows, name))
        assert array.shape == shape + expected.shape[1:]
        np.testing.assert_array_equal(array.reshape(expected.shape), expected)


CASES = {
    "picture": lambda o, d: ((o, d), (o, d)),
    "one array": lambda o, d: ((np.concatenate([o, d], axis=-1),), (o, d)),
    "lists": lambda o, d: ((o.tolist(), d.tolist()), (o, d)),
    "one origin": lambda o, d: ((o[0, 0], d), (np.broadcast_to(o[0, 0], d.shape), d)),
    "one direction": lambda o, d: ((o, d[1, 2].tolist()), (o, np.broadcast_to(d[1, 2], o.shape))),
    "rows and columns": lambda o, d: ((o[:, :1], d[0]), (np.broadcast_to(o[:, :1], o.shape), np.broadcast_to(d[0], o.shape))),
}


@pytest.mark.parametrize("as_warp", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_any_shape_has_the_bits_of_rows(ball: Any, case: str, as_warp: bool) -> None:
    given, (o, d) = CASES[case](*some_rays(*SHAPE))
    rows = ball.closest_hit(o.reshape(-1, 3), d.reshape(-1, 3))
    assert 0 < rows.hit.sum() < rows.t.size
    if as_warp:
        given = tuple(wp.array(np.float32(each), device=DEVICE) for each in given)
    hits = ball.closest_hit(*given)
    assert isinstance(hits.t, wp.array) == as_warp
    assert_same(hits, rows, SHAPE)
    np.testing.assert_array_equal(to_numpy(ball.any_hit(*given)), rows.hit.reshape(SHAPE))
    if not as_warp:
        counts, lists, nearest = wrt.count_hits(ball, *given), wrt.all_hits(ball, *given), wrt.first_hits(ball, 2, *given)
        np.testing.assert_array_equal(counts.reshape(-1), lists.counts)
        assert counts.shape == SHAPE and nearest.t.shape == (*SHAPE, 2)
        np.testing.assert_array_equal(nearest.t[..., 0], hits.t)


def test_one_ray_is_one_ray(ball: Any) -> None:
    hits = ball.closest_hit((0.0, 0.0, 5.0), (0.0, 0.0, -2.0))
    assert hits.t.shape == () and hits.point.shape == (3,) and hits.t == 2.0 and hits.distance == 4.0 and hits.hit
    np.testing.assert_array_equal(hits.points, [0.0, 0.0, 1.0])
    assert ball.any_hit((0.0, 0.0, 5.0, 0.0, 0.0, -2.0)) and not ball.any_hit((0.0, 0.0, 5.0), (0.0, 0.0, 1.0))
    on_warp = ball.closest_hit(*(wp.array([0.0, 0.0, z], dtype=float, device=DEVICE) for z in (5.0, -2.0)))
    assert on_warp.t.shape == (1,) and on_warp.t.numpy() == 2.0


def test_segments_worlds_counters_and_out_have_the_rays_shape(ball: Any) -> None:
    o, d = some_rays(*SHAPE)
    ends = np.float32(np.linspace(0.1, 1.2, 15).reshape(SHAPE))
    rows = ball.closest_hit(o.reshape(-1, 3), d.reshape(-1, 3), t_max=ends.reshape(-1), trace=True)
    hits = ball.closest_hit(o, d, t_max=ends, trace=True)
    assert_same(hits, rows, SHAPE)
    np.testing.assert_array_equal(hits.counters.nodes.reshape(-1), rows.counters.nodes)
    np.testing.assert_array_equal(hits.counters.address, rows.counters.address)
    out = wrt.build(icosphere(1)).closest_hit(o, d)
    assert np.shares_memory(ball.closest_hit(o, d, t_max=ends, out=out).t, out.t)
    np.testing.assert_array_equal(out.t, hits.t)
    worlds = wrt.build([icosphere(2), icosphere(1)])
    which = np.arange(15).reshape(SHAPE) % 2
    found = worlds.closest_hit(o, d, world=which)
    flat = worlds.closest_hit(o.reshape(-1, 3), d.reshape(-1, 3), world=which.reshape(-1))
    assert_same(found, flat, SHAPE)
    np.testing.assert_array_equal(found[which == 1].instance, flat.instance[which.reshape(-1) == 1])


@pytest.mark.parametrize("as_warp", [False, True])
def test_some_hits_are_the_hits_of_these_rays(ball: Any, as_warp: bool) -> None:
    rays = some_rays(*SHAPE)
    expected = ball.closest_hit(*rays)
    hits = ball.closest_hit(*(wp.array(each, dtype=wp.vec3, device=DEVICE) for each in rays)) if as_warp else expected
    mask = expected.prim_id % 3 == 0
    for index in (mask, np.s_[1:, ::2], np.s_[:, 1], np.s_[3:], np.s_[:0], [2, 0], np.s_[:, [1, 3]], np.s_[2]):
        some = hits[index]
        assert isinstance(some.t, wp.array) == as_warp
        for name in FIELDS + PROPERTIES:
            np.testing.assert_array_equal(to_numpy(getattr(some, name)), to_numpy(getattr(expected, name))[index])
    assert hits[hits.hit].t.shape == (expected.hit.sum(),) and to_numpy(hits[1, 2].prim_id) == expected.prim_id[1, 2]
    assert [each.t.shape for each in expected] == [(5,)] * 3


@pytest.mark.parametrize("form", [lambda a: a, np.float64, lambda a: wp.array(a, dtype=wp.vec3, device=DEVICE)], ids=["f4", "f8", "warp"])
def test_rays_that_are_not_valid_miss_if_the_caller_asks(ball: Any, form: Any) -> None:
    o, d = some_rays(50)
    expected = ball.closest_hit(o, d)
    wrong = np.zeros(50, bool)
    for i, (array, value) in enumerate(((o, np.nan), (o, np.inf), (o, 2e37), (d, np.nan), (d, -np.inf), (d, 0.0))):
        array[3 * i] = value
        wrong[3 * i] = True
    t_max = np.full(50, np.inf)
    t_max[20], wrong[20] = np.nan, True
    ends = wp.array(t_max, dtype=float, device=DEVICE) if isinstance(form(o), wp.array) else t_max
    hits = ball.closest_hit(form(o), form(d), t_max=ends, invalid="miss")
    for name in FIELDS:
        np.testing.assert_array_equal(to_numpy(getattr(hits, name))[~wrong], getattr(expected, name)[~wrong])
    assert (to_numpy(hits.prim_id)[wrong] == -1).all() and np.isinf(to_numpy(hits.distance)[wrong]).all()
    np.testing.assert_array_equal(to_numpy(ball.any_hit(form(o), form(d), t_max=ends, invalid="miss")), to_numpy(hits.hit))


def test_gradients_have_the_rays_shape(ball: Any) -> None:
    o, d = some_rays(*SHAPE)
    weight = np.random.default_rng(1).normal(size=SHAPE)
    rows = ball.closest_hit(o.reshape(-1, 3), d.reshape(-1, 3)).gradients(t=weight.reshape(-1))
    found = ball.closest_hit(o, d).gradients(t=weight)
    np.testing.assert_array_equal(found.vertices, rows.vertices)
    np.testing.assert_array_equal(found.origins.reshape(-1, 3), rows.origins)
    leaves = [wp.array(each, dtype=wp.vec3, requires_grad=True, device=DEVICE) for each in (o, d)]
    with wp.Tape() as tape:
        hits = ball.closest_hit(*leaves)
        points = hits.point
    assert hits.t.shape == SHAPE and points.shape == SHAPE
    tape.backward(grads={hits.t: wp.array(weight, dtype=float, device=DEVICE)})
    np.testing.assert_allclose(leaves[1].grad.numpy(), found.directions, rtol=1e-6, atol=1e-6)
    with wp.Tape(), refused("origins", "requires gradients"):
        ball.closest_hit(leaves[0][:1], leaves[1])


def test_unknown_names_are_named(ball: Any) -> None:
    hits = ball.closest_hit(*some_rays(4), counters=True)
    for thing, name in ((hits, "normls"), (hits.counters, "node"), (wrt, "buildd")):
        with pytest.raises(AttributeError) as caught:
            getattr(thing, name)
        assert (caught.value.name, caught.value.obj) == (name, thing)  # from which Python suggests the most similar name
    with pytest.raises(TypeError, match=r"write hits\.t in place of"):
        _ = hits["t"]


def test_a_mesh_of_warp_is_a_mesh(ball: Any) -> None:
    mesh = icosphere(3)
    warps = wp.Mesh(wp.array(mesh.vertices, dtype=wp.vec3, device=DEVICE), wp.array(mesh.faces.reshape(-1), dtype=int, device=DEVICE))
    assert np.array_equal(wrt.build(warps).closest_hit(*some_rays(50)).t, wrt.build(mesh).closest_hit(*some_rays(50)).t)


def test_what_is_refused(ball: Any) -> None:
    o, d = some_rays(*SHAPE)
    for call, said in (
            (lambda: ball.closest_hit(o), ("origins", "(..., 6)", "holds both")),
            (lambda: ball.closest_hit(np.concatenate([o, d], axis=-1), d), ("origins", "(..., 3)", "alone")),
            (lambda: ball.closest_hit(o[0].T, d[0].T), ("origins", "(..., 3)")),
            (lambda: ball.closest_hit(o, d[:2]), ("directions", "broadcasts")),
            (lambda: ball.closest_hit(o, d, t_max=np.ones(3)), ("t_max", "(3, 5)")),
            (lambda: ball.closest_hit(o, d, out=wrt.first_hits(ball, 5, o[:, 0], d[:, 0])[:2]), ("out.t", "(3, 5)")),
            (lambda: ball.any_hit(o, d, out=np.zeros(15, bool)), ("out", "(3, 5)")),
            (lambda: ball.any_hit(o, d, invalid="skip"), ("invalid", "raise, miss")),
            (lambda: ball.closest_hit(o, 0.0 * d), ("directions", "row 0", 'invalid="miss"')),
            (lambda: ball.closest_hit(o, d).gradients(t=np.ones(15)), ("t", "(3, 5)")),
            (lambda: ball.closest_hit(wp.array(o, device=DEVICE)), ("origins", "(..., 6)")),
            (lambda: ball.closest_hit(wp.array(o, dtype=wp.vec3, device=DEVICE), d), ("origins", "both be Warp")),
            (lambda: wrt.build([icosphere(1)] * 2).closest_hit(o, d), ("world", "each entry of a list", "Scene.of"))):
        with refused(said[0], said[1], hint=said[2] if len(said) > 2 else ""):
            call()


def test_a_scene_of_meshes_is_one_world() -> None:
    near, far = icosphere(1), wrt.Mesh(icosphere(1).vertices + np.float32([0.0, 0.0, 5.0]), icosphere(1).faces)
    accel = wrt.build(wrt.Scene.of([near, (far.vertices, far.faces)]))
    hits = accel.closest_hit([[0.0, 0.0, 3.0]] * 2, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(hits.object, [0, 1])


# --- small pictures, which are traced in tiles of pixels --------------------------------------------------------------


SHAPES = [(3, 40, 36), (2, 3, 32, 20), (64, 256), (300, 4, 4), (2, 33, 64), (40, 34), (8, 260), (260, 8)]


@pytest.fixture(scope="module")
def worlds():
    return wrt.build([icosphere(3), icosphere(2)])


@pytest.mark.parametrize("shape", SHAPES)
def test_pictures_have_the_bits_of_rows(worlds, shape) -> None:
    """Also with segments and a world of each ray, on one thread and on two."""
    ball, rng = wrt.build(icosphere(3)), np.random.default_rng(len(shape))
    origins = (rng.normal(size=(*shape, 3)) * 0.5 + (0.0, 0.0, 4.0)).astype(np.float32)
    directions = (rng.normal(size=(*shape, 3)) * 0.3 - (0.0, 0.0, 4.0)).astype(np.float32)
    t_min, world = rng.uniform(0.0, 1.0, shape).astype(np.float32), rng.integers(0, 2, shape).astype(np.int32)
    rows = origins.reshape(-1, 3), directions.reshape(-1, 3)
    for accel, options, flat in ((ball, {}, {}), (ball, {"t_min": t_min}, {"t_min": t_min.reshape(-1)}),
                                 (worlds, {"world": world}, {"world": world.reshape(-1)})):
        expected, occluded = accel.closest_hit(*rows, **flat), accel.any_hit(*rows, **flat)
        assert 0 < occluded.sum() < occluded.size
        for threads in (1, 2):
            hits = accel.closest_hit(origins, directions, threads=threads, **options)
            assert all(getattr(hits, name).tobytes() == getattr(expected, name).tobytes() for name in FIELDS)
            assert np.array_equal(accel.any_hit(origins, directions, threads=threads, **options).reshape(-1), occluded)


def test_pictures_of_other_types_and_orders_have_the_bits_of_rows() -> None:
    """float64 rays are converted, and arrays with gaps copied, block by block; values beyond float32 become infinite."""
    ball, rng, shape = wrt.build(icosphere(3)), np.random.default_rng(1), (2, 64, 32)
    origins, directions = rng.normal(size=(*shape, 3)) * 0.5 + (0.0, 0.0, 4.0), rng.normal(size=(*shape, 3)) * 0.3 - (0.0, 0.0, 4.0)
    ends = np.where(rng.random(shape) < 0.5, 1e300, 3.5)
    rays = [np.float32(each).reshape(-1, 3) for each in (origins, directions)]
    expected = ball.closest_hit(*rays, t_max=np.where(ends > 4.0, np.inf, 3.5).astype(np.float32).reshape(-1))
    for each in (origins, np.float32(origins), np.repeat(np.float32(origins), 2, axis=-1)[..., ::2]):
        hits = ball.closest_hit(each, directions, t_max=ends)
        assert all(getattr(hits, name).tobytes() == getattr(expected, name).tobytes() for name in FIELDS)


def test_a_bad_ray_of_a_picture_is_named_by_its_place_among_the_rays() -> None:
    directions = np.full((32, 64, 3), 1.0, np.float32)
    directions[5, 7] = 0.0
    with pytest.raises(wrt.InputError, match=str(5 * 64 + 7)):
        wrt.build(icosphere(1)).closest_hit(np.zeros((32, 64, 3), np.float32), directions)


def test_tiles_are_squares_of_a_picture() -> None:
    places = np.indices((8, 12), np.float32).reshape(2, -1).T.copy()
    tiles, back = np.empty_like(places), np.empty_like(places)
    copy_to_tiles(tiles, places, tiled_width((8, 12)))
    assert (np.ptp(tiles.reshape(-1, 16, 2), axis=1) == 3.0).all()
    copy_from_tiles(back, tiles, 12)
    assert np.array_equal(back, places)


@pytest.mark.parametrize("library", ["numpy", "warp"])
def test_a_sensors_rays_are_pictures_in_the_same_memory(library: str) -> None:
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    poses[:, 2, 3] = -4.0, -5.0, -6.0
    sensor = wrt.sensors.pinhole(np.diag([64.0, 64.0, 1.0]), (64, 32), poses, like=wp.zeros(1, device="cpu") if library == "warp" else None)
    ball, lists = wrt.build(icosphere(3)), (sensor.origins, sensor.directions)
    pictures, rows = ball.closest_hit(*sensor.rays), ball.closest_hit(*lists)
    assert pictures.t.shape == sensor.shape
    assert np.array_equal(np.asarray(sensor.depth(pictures)), np.asarray(sensor.depth(rows)))
    assert all(np.shares_memory(np.asarray(a), np.asarray(b)) for a, b in zip(sensor.rays, lists, strict=True))
