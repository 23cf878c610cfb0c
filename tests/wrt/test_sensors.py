"""Sensors agree with closed forms: pixels from K, angles of LiDAR rings, moments of noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import wrt
from tests.refused import Refusal, refused
from wrt.scene import shapes
from wrt.sensors import pinhole, raster_lidar, rotating_lidar, with_range_noise

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


def test_it_is_the_camera_of_pictures() -> None:
    camera = wrt.Camera.look_at((0.0, 1.0, 5.0), (0.3, 0.0, 0.0), fov_y=0.7)
    focal = 0.5 * 36 / np.tan(0.35)
    k = [[focal, 0.0, (64 - 1) / 2], [0.0, focal, (36 - 1) / 2], [0.0, 0.0, 1.0]]
    sensor = pinhole(k, "64x36", camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
    origins, directions = wrt.camera_rays(camera, "64x36")
    assert np.allclose(sensor.directions / np.linalg.norm(sensor.directions, axis=1)[:, None], directions, atol=1e-6)
    assert np.array_equal(sensor.origins, origins)


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
    assert with_range_noise(5.0, 0).shape == () and with_range_noise(1e300, 0) == np.inf
    assert np.array_equal(with_range_noise(ranges, 0), ranges) and (with_range_noise(np.zeros(1000), 0, 1.0) >= 0.0).all()


@pytest.mark.parametrize("call, said", [
    (lambda: with_range_noise([1.0, np.nan], 0), ("ranges", "0 or more")),
    (lambda: with_range_noise(np.float32([[np.inf, -3.0]]), 0), ("ranges", "0 or more")),
    (lambda: with_range_noise(-np.inf, 0), ("ranges", "0 or more")),
    (lambda: with_range_noise([[1.0, 2.0], [3.0]], 0), ("ranges", "array of numbers")),
    (lambda: pinhole(np.eye(2), (4, 4)), ("intrinsics",)),
    (lambda: pinhole([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]], (4, 4)),
     ("intrinsics", "focal lengths above 0")),
    (lambda: pinhole("K", (4, 4)), ("intrinsics", "array of numbers")),
    (lambda: pinhole(K, (0, 4)), ("size", "1x1")),
    (lambda: pinhole(K, (4, 4), 2.0 * np.eye(4)), ("pose", "affine")),
    (lambda: pinhole(K, (4, 4), np.diag([1.0, 1.0, -1.0, 1.0])), ("pose", "rotation")),
    (lambda: rotating_lidar([], 4), ("elevations", "one or more angles")),
    (lambda: rotating_lidar([2.0], 4), ("elevations", "one or more angles")),
    (lambda: rotating_lidar([0.0], 0), ("steps", "1")),
    (lambda: raster_lidar((7.0, 1.0), (4, 4)), ("fov", "at most 2 pi")),
    (lambda: raster_lidar((1.0,), (4, 4)), ("fov", "two angles")),  # type: ignore[arg-type]
    (lambda: with_range_noise([1.0], 0, -1.0), ("constant",)),
    (lambda: with_range_noise([1.0], 0, dropout=1.5), ("dropout", "0 to 1")),
    (lambda: with_range_noise([1.0], -1), ("seed", "0")),
    (lambda: pinhole(np.diag([1e-40, 1.0, 1.0]), (4, 4)), (None, "range of float32")),
    (lambda: pinhole(K, (4, 4), [[1, 0, 0, 1e39], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), (None, "range of float32")),
    (lambda: pinhole(K, (4, 4)).depth(np.zeros(16)), ("hits", "closest_hit returned")),
    (lambda: pinhole(K, (4, 4)).picture(np.zeros(3)), ("values", "one row per ray, (16")),
])
def test_what_is_refused(call: Any, said: Refusal) -> None:
    with refused(*said):
        call()
