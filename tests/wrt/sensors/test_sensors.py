"""Sensors agree with closed forms: pixels from K, angles of LiDAR rings, moments of noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import DEVICE
from tests.refused import Refusal, refused
from wrt.scene import shapes
from wrt.sensors import LIDARS, fisheye, lidar, pinhole, raster_lidar, rotating_lidar, with_range_noise

K = np.array([[1100.0, 3.0, 511.2], [0.0, 1050.0, 390.7], [0.0, 0.0, 1.0]])


def a_pose(seed: int = 0) -> np.ndarray:
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = 3.0, -2.0, 5.0
    return pose


def in_frame(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return (points - pose[:3, 3]) @ pose[:3, :3]


def test_hit_points_are_seen_at_the_centres_of_their_pixels() -> None:
    pose = a_pose()
    sensor = pinhole(K, (512, 384), pose)
    assert sensor.shape == (384, 512) and sensor.origins.dtype == sensor.directions.dtype == np.float32
    ball = shapes.icosphere(3, 20.0)
    hits = wrt.build(ball).closest_hit(sensor.origins, sensor.directions)
    assert (hits.prim_id >= 0).all()
    points = sensor.origins + hits.t[:, None].astype(np.float64) * sensor.directions
    seen = in_frame(pose, points) @ K.T
    pixels = np.stack(np.meshgrid(np.arange(512), np.arange(384)), axis=-1).reshape(-1, 2)
    assert np.abs(seen[:, :2] / seen[:, 2:] - pixels).max() < 1e-3
    z, distance = in_frame(pose, points)[:, 2], np.linalg.norm(points - pose[:3, 3], axis=1)
    assert np.allclose(sensor.depth(hits).ravel(), z, rtol=1e-6) and np.allclose(sensor.range(hits).ravel(), distance, rtol=1e-6)
    assert np.allclose(hits.t, z, rtol=1e-6)
    assert sensor.depth(hits).shape == (384, 512) and sensor.picture(hits.normal).shape == (384, 512, 3)


def test_misses_are_infinitely_far() -> None:
    sensor = pinhole(np.diag([10.0, 10.0, 1.0]), (2, 2), np.diag([1.0, -1.0, -1.0, 1.0]))  # along -z; the first pixel hits
    quad = shapes.quad((-0.1, -0.1, -2.0), (0.2, 0.0, 0.0), (0.0, 0.2, 0.0))
    hits = wrt.build(quad).closest_hit(sensor.origins, sensor.directions)
    assert np.array_equal(sensor.depth(hits), np.float32([[2.0, np.inf], [np.inf, np.inf]]))
    assert np.array_equal(sensor.picture(hits.prim_id) >= 0, np.isfinite(sensor.range(hits)))


def test_a_rings_rays_are_on_its_cone() -> None:
    pose, elevations = a_pose(1), np.radians([-24.8, -10.0, 0.0, 2.0, 90.0])
    sensor = rotating_lidar(elevations, 360, pose, start=0.5)
    assert sensor.shape == (5, 360)
    local = sensor.directions.astype(np.float64) @ pose[:3, :3]
    assert np.allclose(np.linalg.norm(local, axis=1), 1.0, atol=1e-6)
    local = sensor.picture(local)
    level = np.hypot(local[..., 0], local[..., 1])
    assert np.allclose(np.arctan2(local[..., 2], level), elevations[:, None], atol=1e-6)
    azimuth = np.arctan2(local[:4, :, 1], local[:4, :, 0])
    expected = 0.5 + np.radians(np.arange(360.0))
    assert np.abs(np.exp(1j * azimuth) - np.exp(1j * expected)).max() < 1e-6
    part = rotating_lidar([0.0], 4, turn=-np.pi)  # clockwise: ahead, and to the right
    assert np.allclose(part.directions[[0, 2]], [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], atol=1e-6)


def test_a_lidar_in_a_ball_measures_its_radius() -> None:
    sensor = rotating_lidar(np.radians(np.linspace(-30.0, 30.0, 16)), 90)
    hits = wrt.build(shapes.icosphere(5, 10.0)).closest_hit(sensor.origins, sensor.directions)
    ranges = sensor.range(hits)
    assert ranges.shape == (16, 90) and np.array_equal(ranges.ravel(), hits.t) and ((ranges > 9.98) & (ranges <= 10.0001)).all()
    assert np.allclose(sensor.depth(hits), ranges * sensor.picture(sensor.directions)[..., 0], atol=1e-5)


def test_a_raster_begins_at_the_top_left() -> None:
    sensor = raster_lidar((np.radians(120.0), np.radians(25.0)), (7, 3))
    local = sensor.picture(sensor.directions).astype(np.float64)
    azimuth, elevation = np.arctan2(local[..., 1], local[..., 0]), np.arcsin(local[..., 2])
    assert np.allclose(azimuth, np.radians(np.linspace(60.0, -60.0, 7))[None, :], atol=1e-6)
    assert np.allclose(elevation, np.radians([12.5, 0.0, -12.5])[:, None], atol=1e-6)
    assert np.allclose(raster_lidar((1.0, 1.0), "1x1").directions, [[1.0, 0.0, 0.0]])


def poses(count: int) -> np.ndarray:
    return np.stack([a_pose(seed) for seed in range(count)])


SENSORS = {
    "pinhole": lambda pose, **options: pinhole(np.diag([8.0, 9.0, 1.0]), (7, 5), pose, **options),
    "distorted": lambda pose, **options: pinhole(np.diag([8.0, 9.0, 1.0]), (7, 5), pose, (0.05, 0.01, 0.002, 0.001), **options),
    "fisheye": lambda pose, **options: fisheye(np.diag([8.0, 9.0, 1.0]), (7, 5), pose, **options),
    "rotating": lambda pose, **options: rotating_lidar([-0.3, 0.0, 0.2, 0.4, 0.5], 7, pose, **options),
    "raster": lambda pose, **options: raster_lidar((1.0, 0.5), (7, 5), pose, **options),
    "vlp-16": lambda pose, **options: lidar("vlp-16", pose, 7, **options),
}


@pytest.mark.parametrize("kind", SENSORS)
def test_a_batch_of_poses_is_one_sensor_after_another(kind: str) -> None:
    make, many = SENSORS[kind], poses(4)
    together, alone = make(many), [make(pose) for pose in many]
    assert together.shape == (4, *alone[0].shape)
    hits = wrt.build(shapes.icosphere(3, 12.0)).closest_hit(together.origins, together.directions)
    for i, one in enumerate(alone):
        assert np.array_equal(together.picture(together.origins)[i].reshape(-1, 3), one.origins)
        assert np.array_equal(together.picture(together.directions)[i].reshape(-1, 3), one.directions)
        own = hits[i * len(one.origins):(i + 1) * len(one.origins)]
        np.testing.assert_allclose(together.depth(hits)[i], one.depth(own), rtol=1e-6)
        assert np.array_equal(together.range(hits)[i], one.range(own))


@pytest.mark.parametrize("kind", SENSORS)
def test_rows_or_columns_have_poses_of_their_own(kind: str) -> None:
    make = SENSORS[kind]
    still = make(None)
    axis = 1 if kind in ("rotating", "vlp-16") else 0
    each = poses(still.shape[axis])
    moving = make(each, rolling=True)
    assert moving.shape == still.shape
    for i, pose in enumerate(each):
        one = make(pose)
        for name in ("origins", "directions"):
            np.testing.assert_allclose(moving.picture(getattr(moving, name)).take(i, axis), one.picture(getattr(one, name)).take(i, axis),
                                       rtol=1e-6, atol=1e-6)
    hits = wrt.build(shapes.icosphere(3, 12.0)).closest_hit(moving.origins, moving.directions)
    alone = [make(pose) for pose in each]
    depths = [one.depth(wrt.build(shapes.icosphere(3, 12.0)).closest_hit(one.origins, one.directions)).take(i, axis)
              for i, one in enumerate(alone)]
    np.testing.assert_allclose(moving.depth(hits), np.stack(depths, axis), rtol=1e-4, atol=1e-5)
    assert np.array_equal(make(np.stack([each, each]), rolling=True).directions[:len(moving.directions)], moving.directions)


def test_points_are_of_hits_or_of_measured_ranges() -> None:
    sensor = lidar("os0-32", a_pose(2), columns=64)
    floor = shapes.quad((-50.0, -50.0, -4.0), (100.0, 0.0, 0.0), (0.0, 100.0, 0.0))
    hits = wrt.build(floor).closest_hit(sensor.origins, sensor.directions)
    assert 0.2 < hits.hit.mean() < 0.8
    points = sensor.points(hits)
    assert points.shape == (32, 64, 3)
    np.testing.assert_array_equal(points.reshape(-1, 3), hits.point)
    for ranges in (sensor.range(hits), sensor.range(hits).ravel()):
        np.testing.assert_allclose(sensor.points(ranges), points, atol=2e-5)
    assert np.isnan(sensor.points(with_range_noise(sensor.range(hits), 0, dropout=1.0))).all()


def test_named_lidars_have_the_angles_of_their_tables() -> None:
    for name, elevations in (("vlp-16", np.arange(15.0, -16.0, -2.0)), ("os1-64", np.linspace(22.5, -22.5, 64)),
                             ("hdl-32e", [10.67, 9.33, 8.0, 6.67, 5.33, 4.0, 2.67, 1.33, 0.0, -1.33, -2.67, -4.0, -5.33, -6.67, -8.0, -9.33,
                                          -10.67, -12.0, -13.33, -14.67, -16.0, -17.33, -18.67, -20.0, -21.33, -22.67, -24.0, -25.33,
                                          -26.67, -28.0, -29.33, -30.67])):
        sensor = lidar(name)
        rays = sensor.picture(sensor.directions)
        assert sensor.shape == (len(elevations), LIDARS[name].columns) and LIDARS[name].source
        np.testing.assert_allclose(np.degrees(np.arcsin(rays[:, 5, 2])), elevations, atol=0.006)
        assert rays[0, 0, 1] == 0.0 and rays[0, 1, 1] < 0.0  # from straight ahead to the right


class Library:
    """A stand-in for a library with DLPack: its tensors share NumPy's memory."""

    class Tensor:
        def __init__(self, array: Any) -> None:
            self.array = np.asarray(array)

        def __dlpack__(self, **options: Any) -> Any:
            return self.array.__dlpack__(**options)

        def __dlpack_device__(self) -> Any:
            return self.array.__dlpack_device__()

        def __array_namespace__(self) -> Any:
            return Library

        @property
        def shape(self) -> Any:
            return self.array.shape

    @staticmethod
    def from_dlpack(array: Any) -> Any:
        return Library.Tensor(np.from_dlpack(array))


def test_tensors_stay_tensors_without_a_copy() -> None:
    """By addresses: rays of the sensor, hits and pictures lie where the query and the sensor wrote them."""
    sensor = pinhole(np.diag([8.0, 9.0, 1.0]), (7, 5), Library.Tensor(poses(3)))
    assert isinstance(sensor.origins, Library.Tensor) and isinstance(sensor.directions, Library.Tensor)
    hits = wrt.build(shapes.icosphere(3, 12.0)).closest_hit(sensor.origins, sensor.directions)
    assert isinstance(hits.t, Library.Tensor)
    ids = sensor.picture(hits.prim_id)
    assert isinstance(ids, Library.Tensor) and ids.shape == (3, 5, 7) and ids.array.ctypes.data == hits.prim_id.array.ctypes.data
    assert hits.source[1].origins.ctypes.data == sensor.origins.array.ctypes.data  # type: ignore[index]  # read in place
    for picture in (sensor.depth(hits), sensor.range(hits), sensor.points(hits), with_range_noise(sensor.range(hits), 0)):
        assert isinstance(picture, Library.Tensor) and picture.shape[:3] == (3, 5, 7)
    on_warp = pinhole(np.diag([8.0, 9.0, 1.0]), (7, 5), poses(3), like=wp.zeros(1, dtype=float, device=DEVICE))
    assert on_warp.origins.dtype == wp.vec3 and on_warp.origins.device == DEVICE
    found = wrt.build(shapes.icosphere(3, 12.0)).closest_hit(on_warp.origins, on_warp.directions)
    depth = on_warp.depth(found)
    assert isinstance(depth, wp.array) and depth.shape == (3, 5, 7) and isinstance(on_warp.picture(found.t), wp.array)
    np.testing.assert_array_equal(depth.numpy(), sensor.depth(hits).array)


def test_noise_has_the_deviation_that_is_asked_for() -> None:
    n = 100_000
    for r, constant, proportional in ((10.0, 0.02, 0.0), (10.0, 0.0, 0.003), (50.0, 0.03, 0.001)):
        noisy = with_range_noise(np.full(n, r, np.float32), 7, constant, proportional)
        sigma = np.hypot(constant, proportional * r)
        assert noisy.dtype == np.float32
        # Within five standard errors of a mean and of a standard deviation.
        assert abs(noisy.mean(dtype=np.float64) - r) < 5.0 * sigma / np.sqrt(n)
        assert abs(noisy.std(dtype=np.float64) / sigma - 1.0) < 5.0 / np.sqrt(2.0 * n)
    lost = np.isinf(with_range_noise(np.ones(n), 1, dropout=0.1)).mean()
    assert abs(lost - 0.1) < 5.0 * np.sqrt(0.09 / n)


def test_noise_repeats_and_is_each_elements_own() -> None:
    ranges = np.full((4, 6), 5.0, np.float32)
    ranges[1, 2] = np.inf
    noisy = with_range_noise(ranges, 3, 0.1, dropout=0.2)
    assert np.array_equal(noisy, with_range_noise(ranges, 3, 0.1, dropout=0.2)) and np.isinf(noisy[1, 2])
    assert not np.array_equal(noisy, with_range_noise(ranges, 4, 0.1, dropout=0.2))
    other = ranges.copy()
    other[0, 0], other[1, 2] = np.inf, 1.0
    same = with_range_noise(other, 3, 0.1, dropout=0.2) == noisy
    assert same.sum() >= 22 and same[2:].all()
    assert with_range_noise(5.0, 0).shape == ()
    assert np.array_equal(with_range_noise(ranges, 0), ranges) and (with_range_noise(np.zeros(1000), 0, 1.0) >= 0.0).all()


def test_opencvs_pairs_of_rotation_and_translation_are_poses() -> None:
    """A point X is seen at the pixel K (R X + t)."""
    poses = np.stack([a_pose(seed) for seed in range(4)])
    inverse = np.linalg.inv(poses)
    for pair in ((inverse[:, :3, :3], inverse[:, :3, 3]), (inverse[:, :3, :3], inverse[:, :3, 3:])):
        same, expected = pinhole(K, (8, 6), pair), pinhole(K, (8, 6), poses)
        assert same.shape == (4, 6, 8)
        np.testing.assert_allclose(same.origins, expected.origins, rtol=1e-6)
        np.testing.assert_allclose(same.directions, expected.directions, atol=1e-6)
    for angle in (0.0, 1e-9, 0.7, np.pi):
        axis, shift = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([1.0, 2.0, 3.0])
        sensor = pinhole(K, (8, 6), ((angle * axis)[:, None], shift[:, None]))
        # Rotating by the angle about the axis: the part along the axis stays, the rest turns.
        v = sensor.origins + 7.0 * sensor.directions.astype(np.float64)
        along = (v @ axis)[:, None] * axis
        seen = along + np.cos(angle) * (v - along) + np.sin(angle) * np.cross(axis, v) + shift
        pixels = (seen / seen[:, 2:]) @ K.T
        np.testing.assert_allclose(pixels[:, :2].reshape(6, 8, 2), np.indices((6, 8))[::-1].transpose(1, 2, 0), atol=2e-3)


@pytest.mark.parametrize("make", [pinhole, fisheye])
@pytest.mark.parametrize("rolling", [False, True])
def test_several_intrinsics_are_several_cameras(make: Any, rolling: bool) -> None:
    ks = np.stack([K, K * 2.0 - np.diag([0.0, 0.0, 1.0]), K + np.diag([9.0, 5.0, 0.0])])
    poses = np.stack([a_pose(seed) for seed in range(3)])
    poses = np.repeat(poses[:, None], 4, axis=1) if rolling else poses
    many, lens = make(ks, (6, 4), poses, (0.01, -0.002, 0.001, 0.0), rolling=rolling), (0.01, -0.002, 0.001, 0.0)
    shared = make(ks, (6, 4), poses[0], lens, rolling=rolling)
    assert many.shape == shared.shape == (3, 4, 6)
    for i in range(3):
        for sensor, pose in ((many, poses[i]), (shared, poses[0])):
            one = make(ks[i], (6, 4), pose, lens, rolling=rolling)
            assert all(np.array_equal(rays[i], own) for rays, own in zip(sensor.rays, one.rays, strict=True))


@pytest.mark.parametrize("call, said", [
    (lambda: with_range_noise([1.0, np.nan], 0), ("ranges", "0 or more")),
    (lambda: with_range_noise([1.0], 0, -1.0), ("constant",)),
    (lambda: with_range_noise([1.0], 0, dropout=1.5), ("dropout", "0 to 1")),
    (lambda: with_range_noise([1e300], 0), ("ranges", "range of float32")),
    (lambda: pinhole(K, (4, 4), ([1e200, 0.0, 0.0], np.zeros(3))), ("pose[0]", "finite, and within")),
    (lambda: pinhole(np.eye(2), (4, 4)), ("intrinsics",)),
    (lambda: pinhole([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]], (4, 4)), ("intrinsics", "focal lengths above 0")),
    (lambda: pinhole(K, (0, 4)), ("size", "1x1")),
    (lambda: pinhole(K, (4, 4), 2.0 * np.eye(4)), ("pose", "affine")),
    (lambda: pinhole(np.diag([1e-40, 1.0, 1.0]), (4, 4)), (None, "range of float32")),
    (lambda: pinhole(K, (4, 4), np.zeros((2, 3, 4, 4)) + np.eye(4)), ("pose", "(4, 4) or (B, 4, 4)")),
    (lambda: pinhole(K, (4, 5), np.zeros((4, 4, 4)) + np.eye(4), rolling=True), ("pose", "(5, 4, 4) or (B, 5, 4, 4)")),
    (lambda: pinhole(K, (4, 4), np.stack([np.eye(4), np.diag([1.0, 1.0, 2.0, 1.0])])), ("pose", "translation; pose 1 is not")),
    (lambda: pinhole(K, (4, 4), (np.eye(3), np.zeros(2))), ("pose", "(R, t), of (3, 3) and (3,)")),
    (lambda: pinhole([K, -K], (4, 4)), ("intrinsics[1]", "[[fx, s, cx]")),
    (lambda: pinhole([K, K], (4, 4), np.stack([np.eye(4)] * 3)), ("intrinsics", "2 intrinsics and 3 poses")),
    (lambda: rotating_lidar([2.0], 4), ("elevations", "got [2.0]", None, None, "np.radians")),
    (lambda: raster_lidar((7.0, 1.0), (4, 4)), ("fov", "at most 2 pi")),
    (lambda: lidar("vlp16"), ("name", "no LiDAR 'vlp16'", None, None, "'vlp-16'")),
    (lambda: pinhole(K, (4, 4)).depth(np.zeros(16)), ("hits", "closest_hit returned")),
    (lambda: pinhole(K, (4, 4)).picture(np.zeros(3)), ("values", "one row per ray, (16")),
])
def test_what_is_refused(call: Any, said: Refusal) -> None:
    with refused(*said):
        call()
