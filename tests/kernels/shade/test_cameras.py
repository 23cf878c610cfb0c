"""Camera rays against closed forms in float64. For a lens, chief ray and parallel ray give the point S on every ray."""

from functools import cache
from importlib import import_module

import numpy as np
import pytest

from tests.kernel_tools import launch, unit, vec2s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.structs import Ray, kernel
from wrt.renderer.upload import camera_struct
from wrt.scene.cameras import Camera, FisheyeCamera, OrthographicCamera, PanoramaCamera


@cache
def camera_kernel(device, features):
    kind = import_module(device)
    camera_struct, camera_ray = kind.Camera, kind.make_camera_ray(features)

    @kernel
    def trace(camera: camera_struct, film: wp.array(dtype=wp.vec2), xi: wp.array(dtype=wp.vec2), out: wp.array(dtype=Ray)):
        i = wp.tid()
        out[i] = camera_ray(camera, film[i], xi[i])

    return trace


def rays(camera, size, film, xi=None):
    """Return origins and directions, (N, 3) float64, of a camera's rays at film points with lens samples xi."""
    film = np.asarray(film, float).reshape(-1, 2)
    xi = np.zeros_like(film) if xi is None else xi
    kernel = camera_kernel(camera.device, Features(**camera.switches()))
    out = zeros(len(film), Ray)
    launch(kernel, len(film), camera_struct(camera, size), vec2s(film), vec2s(xi), out)
    out = out.numpy()
    assert (out["t_min"] == 0.0).all() and np.isinf(out["t_max"]).all() and (out["exclude_plus_one"] == 0).all()
    origin, direction = out["origin"].astype(np.float64), out["direction"].astype(np.float64)
    assert np.abs(np.linalg.norm(direction, axis=1) - 1.0).max() < 1e-6
    return origin, direction


POSE = {"position": (3.0, -2.0, 5.0), "target": (-1.0, 0.5, 0.25), "up": (0.2, 1.0, -0.1)}


def frame(camera):
    m = camera.camera_to_world
    return m[:3, 0], m[:3, 1], -m[:3, 2], m[:3, 3]


@pytest.mark.parametrize("size", [(640, 360), (100, 300), (7, 7)])
def test_pinhole_corners(size):
    camera = Camera.look_at(**POSE, fov_y=1.1)
    right, up, forward, eye = frame(camera)
    height = np.tan(0.55)
    width = height * size[0] / size[1]
    for film, x, y in (((0.0, 0.0), -width, height), ((1.0, 0.0), width, height), ((0.0, 1.0), -width, -height),
                       ((1.0, 1.0), width, -height), ((0.5, 0.5), 0.0, 0.0), ((0.25, 0.5), -0.5 * width, 0.0)):
        origin, direction = rays(camera, size, [film])
        assert np.allclose(origin[0], eye, atol=1e-6)
        assert np.allclose(direction[0], unit(forward + x * right + y * up), atol=1e-6), film


def meeting_point(point_a, direction_a, point_b, direction_b):
    """Return the point where two lines in one plane cross, by least squares in float64, and their distance there."""
    a = np.stack([direction_a, -direction_b], axis=1)
    (s, t), *_ = np.linalg.lstsq(a, point_b - point_a, rcond=None)
    p, q = point_a + s * direction_a, point_b + t * direction_b
    return 0.5 * (p + q), np.linalg.norm(p - q)


@pytest.mark.parametrize(("blades", "f_number"), [(0, 1.4), (0, 8.0), (6, 2.0)])
@pytest.mark.parametrize("focus", [0.6, 3.0, 40.0])
def test_all_rays_of_a_film_point_cross_at_the_lectures_point(focus, blades, f_number):
    # Lens equation and construction in the camera's own frame: lens at z = 0, scene at z > 0, sensor at z = -s'.
    f, sensor = 0.05, 0.024
    lens = Camera.lens(f, focus, sensor, f_number=f_number)
    camera = Camera.look_at(**POSE, blades=blades, **lens)
    right, up, forward, eye = frame(camera)
    size = (36, 24)
    sensor_distance = 1.0 / (1.0 / f - 1.0 / focus)
    rng = np.random.default_rng(1)
    for film in [(0.0, 0.0), (0.9, 0.2), (0.5, 0.49), *rng.random((4, 2))]:
        # The picture on the sensor is upside down: a film point towards (x, y) lies at (-x, -y) behind the lens.
        x = (film[0] - 0.5) * sensor * size[0] / size[1]
        y = (0.5 - film[1]) * sensor
        on_sensor = np.array([-x, -y, -sensor_distance])
        chief = -on_sensor  # Through the lens' center, which does not deflect it.
        hits_lens = np.array([-x, -y, 0.0])  # This ray arrives parallel to the axis and leaves through the focal point.
        point, gap = meeting_point(np.zeros(3), chief, hits_lens, np.array([0.0, 0.0, f]) - hits_lens)
        assert gap < 1e-9 * focus and point[2] == pytest.approx(focus, rel=1e-9)
        s = eye + point[0] * right + point[1] * up + point[2] * forward

        xi = rng.random((200, 2))
        origin, direction = rays(camera, size, np.broadcast_to(film, (200, 2)), xi)
        along = ((s - origin) * direction).sum(axis=1)
        miss = np.linalg.norm(origin + along[:, None] * direction - s, axis=1)
        assert miss.max() < 2e-6 * (focus + np.abs(eye).max())
        # The rays start in the lens' plane, within its radius, and from different points.
        local = (origin - eye) @ np.stack([right, up, forward], axis=1)
        assert np.abs(local[:, 2]).max() < 1e-6
        radius = np.linalg.norm(local[:, :2], axis=1)
        assert radius.max() <= lens["aperture_radius"] + 2e-6
        if f_number < 4.0:
            assert radius.max() > 0.85 * lens["aperture_radius"]


@pytest.mark.parametrize("blades", [3, 5, 8])
@pytest.mark.parametrize("rotation", [0.0, 0.4])
def test_blades_bound_the_aperture(blades, rotation):
    camera = Camera(aperture_radius=2.0, focus_distance=10.0, blades=blades, blade_rotation=rotation)
    xi = np.random.default_rng(3).random((20_000, 2))
    origin, _ = rays(camera, (4, 4), np.full((20_000, 2), 0.5), xi)
    angle = rotation + np.pi / blades * (2.0 * np.arange(blades) + 1.0)
    across = origin[:, :2] @ np.array([np.cos(angle), np.sin(angle)])
    inner = 2.0 * np.cos(np.pi / blades)
    assert across.max() <= inner + 1e-5  # Inside every blade, and so inside the circle.
    assert (across.max(axis=0) > 0.98 * inner).all()  # The points reach every blade.
    corner = rotation + 2.0 * np.pi / blades * np.arange(blades)
    assert ((origin[:, :2] @ np.array([np.cos(corner), np.sin(corner)])).max(axis=0) > 1.9).all()


FILM = np.random.default_rng(5).random((200, 2))


@pytest.mark.parametrize("size", [(640, 360), (100, 300)])
def test_orthographic_rays_are_parallel_and_start_where_their_pixels_are(size):
    camera = OrthographicCamera.look_at(**POSE, height=3.0)
    right, up, forward, eye = frame(camera)
    origin, direction = rays(camera, size, FILM)
    x, y = (FILM[:, 0] - 0.5) * 3.0 * size[0] / size[1], (0.5 - FILM[:, 1]) * 3.0
    assert np.allclose(origin, eye + x[:, None] * right + y[:, None] * up, atol=2e-6)
    assert np.allclose(direction, forward, atol=1e-6)


@pytest.mark.parametrize("size", [(640, 360), (100, 300), (64, 64)])
@pytest.mark.parametrize("fov", [0.5, np.pi, 2.0 * np.pi])
def test_a_fisheyes_angles_are_proportional_to_the_radius(size, fov):
    camera = FisheyeCamera.look_at(**POSE, fov=fov)
    right, up, forward, eye = frame(camera)
    x, y = (2.0 * FILM - 1.0).T * (np.array(size) / min(size))[:, None] * [[1.0], [-1.0]]
    radius = np.hypot(x, y)
    inside = radius < 1.0 - 1e-6
    origin, direction = rays(camera, size, FILM[inside])
    angle = np.arccos(np.clip(direction @ forward, -1.0, 1.0))
    assert np.allclose(angle, 0.5 * fov * radius[inside], atol=2e-3)  # Near the axis, arccos loses half of the digits.
    assert np.allclose(np.sin(0.5 * fov * radius[inside])[:, None] * np.stack([x, y], axis=1)[inside] / radius[inside, None],
                       np.stack([direction @ right, direction @ up], axis=1), atol=2e-6)
    assert np.allclose(origin, eye, atol=1e-6)
    assert np.allclose(rays(camera, size, [(0.5, 0.5)])[1], forward, atol=1e-6)


def test_a_fisheye_has_no_ray_beyond_its_circle():
    camera, size = FisheyeCamera(), (64, 36)
    film = np.array([(0.5 + 0.5 * 36 / 64 + 1e-3, 0.5), (0.0, 0.0), (0.5, -0.01), (1.0, 0.5)])
    out = zeros(len(film), Ray)
    launch(camera_kernel(camera.device, Features()), len(film), camera_struct(camera, size), vec2s(film), vec2s(film), out)
    assert (out.numpy()["t_max"] < 0.0).all() and not out.numpy()["direction"].any()


def test_a_panoramas_columns_are_longitudes_and_its_rows_latitudes():
    camera = PanoramaCamera.look_at(**POSE)
    right, up, forward, eye = frame(camera)
    origin, direction = rays(camera, (64, 32), FILM)
    assert np.allclose(origin, eye, atol=1e-6)
    assert np.allclose(np.arctan2(direction @ right, direction @ forward), 2.0 * np.pi * (FILM[:, 0] - 0.5), atol=2e-5)
    assert np.allclose(np.arcsin(direction @ up), np.pi * (0.5 - FILM[:, 1]), atol=2e-3)
    corners = rays(camera, (64, 32), [(0.5, 0.5), (0.75, 0.5), (0.25, 0.5), (0.0, 0.5), (1.0, 0.5), (0.3, 0.0), (0.3, 1.0)])[1]
    assert np.allclose(corners, [forward, right, -right, -forward, -forward, up, -up], atol=1e-6)
