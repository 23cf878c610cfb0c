"""Small pictures of rays are traced in tiles of pixels: each ray keeps its answer and its place."""

import numpy as np
import pytest
import warp as wp

import wrt
import wrt.sensors
from wrt.accel.queries import batches
from wrt.accel.queries.tiles import copy_from_tiles, copy_to_tiles, tiled_width
from wrt.scene.shapes import icosphere

SHAPES = [(3, 40, 36), (2, 3, 32, 20), (64, 256), (300, 4, 4), (2, 33, 64), (40, 34), (8, 260), (260, 8)]
FIELDS = "t", "u", "v", "prim_id"


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


def test_pictures_of_other_types_and_orders_are_traced_in_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """float64 rays are converted, and arrays with gaps copied, block by block; values beyond float32 become infinite."""
    ball, rng, shape = wrt.build(icosphere(3)), np.random.default_rng(1), (2, 64, 32)
    origins, directions = rng.normal(size=(*shape, 3)) * 0.5 + (0.0, 0.0, 4.0), rng.normal(size=(*shape, 3)) * 0.3 - (0.0, 0.0, 4.0)
    ends = np.where(rng.random(shape) < 0.5, 1e300, 3.5)
    rays = [np.float32(each).reshape(-1, 3) for each in (origins, directions)]
    expected = ball.closest_hit(*rays, t_max=np.where(ends > 4.0, np.inf, 3.5).astype(np.float32).reshape(-1))
    widths: list[int] = []
    monkeypatch.setattr(batches, "copy_to_tiles", lambda tiles, rows, width: widths.append(width) or copy_to_tiles(tiles, rows, width))
    gaps = np.repeat(np.float32(origins), 2, axis=-1)[..., ::2]
    for each in (origins, np.float32(origins), gaps):
        widths.clear()
        hits = ball.closest_hit(each, directions, t_max=ends)
        assert all(getattr(hits, name).tobytes() == getattr(expected, name).tobytes() for name in FIELDS)
        assert widths and set(widths) == {32}


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
