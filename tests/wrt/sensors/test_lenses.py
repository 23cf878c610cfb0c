"""Lens distortion agrees with OpenCV and with the published formulas, and is refused where it folds over."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import numpy as np
import pytest

from tests.refused import Refusal, refused
from wrt.sensors import fisheye, pinhole, project, unproject

SIZE = 24, 18
K = np.array([[19.0, 0.0, 11.4], [0.0, 19.5, 9.3], [0.0, 0.0, 1.0]])
KINDS = {"radial-tangential 4": 4, "radial-tangential": 5, "rational": 8, "thin prism": 12}
PIXELS = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(np.float64)


def lenses(length: int, count: int = 25) -> list[np.ndarray]:
    """Return coefficients of lenses that do not fold over in the picture: their images of a grid, by the formula alone, keep its
    orientation, and cover the picture."""
    rng, found = np.random.default_rng(length), []
    scale = np.array([0.25, 0.1, 0.02, 0.02, 0.05, 0.2, 0.05, 0.02, 0.02, 0.01, 0.02, 0.01])[:length]
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 61), np.linspace(-1.2, 1.2, 61))
    while len(found) < count:
        lens = scale * rng.uniform(-1.0, 1.0, length)
        at_x, at_y = published(x, y, lens)
        along, down = [np.diff(each[:-1], axis=1) for each in (at_x, at_y)], [np.diff(each[:, :-1], axis=0) for each in (at_x, at_y)]
        if (along[0] * down[1] - along[1] * down[0]).min() > 1e-4 and -at_x[:, 0].max() > 0.68 < at_x[:, -1].min() \
                and -at_y[0].max() > 0.5 < at_y[-1].min():
            found.append(lens)
    return found


def published(x: Any, y: Any, lens: Any) -> tuple[Any, Any]:
    """The formula of OpenCV's documentation, written as it stands there."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = [*lens, *[0 * lens[0]] * (12 - len(lens))]
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2,
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2)


@pytest.mark.parametrize("kind", KINDS)
def test_rays_project_to_their_pixels_by_the_published_formula(kind: str) -> None:
    worst = 0.0
    for lens in lenses(KINDS[kind]):
        ways = unproject(PIXELS, K, lens)
        x, y = published(ways[..., 0], ways[..., 1], lens)
        shown = np.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)
        worst = max(worst, np.abs(shown - PIXELS).max(), np.abs(project(ways, K, lens) - PIXELS).max())
        local = pinhole(K, SIZE, distortion=lens).directions.reshape(ways.shape)
        np.testing.assert_allclose(local, ways, rtol=3e-7, atol=1e-7)
    assert worst < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_rays_project_to_their_pixels_by_opencv(kind: str) -> None:
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed: wrt does not need it")
    worst = 0.0
    for lens in lenses(KINDS[kind]):
        for ways, most in ((unproject(PIXELS, K, lens), 1e-6), (pinhole(K, SIZE, distortion=lens).directions, 1e-4)):
            shown = cv2.projectPoints(np.float64(ways).reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, lens)[0]
            error = np.abs(shown.reshape(-1, 2) - PIXELS.reshape(-1, 2)).max()  # the second: of rays in float32
            worst = max(worst, error if most == 1e-6 else 0.0)
            assert error < most
    print(f"largest error against OpenCV: {worst:.1e} pixels")


def test_fisheye_rays_project_to_their_pixels() -> None:
    """The shown radius is theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""
    rng = np.random.default_rng(3)
    for _ in range(30):
        lens = np.array([0.1, 0.03, 0.01, 0.003]) * rng.uniform(-0.5, 1.0, 4)
        ways = unproject(PIXELS, K, lens, fisheye=True)
        np.testing.assert_allclose(np.linalg.norm(ways, axis=-1), 1.0, atol=1e-12)
        theta = np.arccos(np.clip(ways[..., 2], -1.0, 1.0))
        shown = theta * (1 + lens[0] * theta**2 + lens[1] * theta**4 + lens[2] * theta**6 + lens[3] * theta**8)
        where = (PIXELS - K[:2, 2]) / np.diag(K)[:2]
        np.testing.assert_allclose(shown, np.hypot(*np.moveaxis(where, -1, 0)), atol=1e-7)  # arccos is inexact near the axis
        assert np.abs(project(ways, K, lens, fisheye=True) - PIXELS).max() < 1e-9
        local = fisheye(K, SIZE, distortion=lens).directions.reshape(ways.shape)
        np.testing.assert_allclose(local, ways, atol=1e-7)


def test_a_large_picture_has_the_rays_of_its_pixels() -> None:
    """Its inverse begins from a grid of fewer points."""
    k, lens = np.array([[300.0, 2.0, 170.0], [0.0, 290.0, 130.0], [0.0, 0.0, 1.0]]), (-0.3, 0.12, 0.002, -0.001, -0.02)
    local = pinhole(k, (320, 240), distortion=lens).directions.reshape(240, 320, 3)
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)
    np.testing.assert_allclose(local, unproject(pixels, k, lens), rtol=3e-7, atol=1e-7)


def test_points_are_projected_in_decimal_arithmetic() -> None:
    lens, point = (0.1, -0.05, 0.003, -0.002, 0.01, 0.02, 0.01, -0.001, 0.004, 0.001, -0.003, 0.002), (0.3, -0.4, 2.0)
    x, y = published(*(Decimal(value) / 2 for value in point[:2]), [Decimal(value) for value in lens])
    found = project(point, K, lens)
    np.testing.assert_allclose(found, [19.0 * float(x) + 11.4, 19.5 * float(y) + 9.3], rtol=1e-15)
    assert np.isnan(project((0.0, 0.0, -1.0), K, lens)).all()
    np.testing.assert_allclose(unproject(found, K, lens), (0.15, -0.2, 1.0), atol=1e-14)


def test_a_fisheye_camera_shows_neither_itself_nor_the_point_behind_it() -> None:
    """At the angle pi every direction in the picture is as good. Beside that, the angle is arctan2."""
    centre, around = K[:2, 2], [[0.0, 0.0, 1.0], [0.0, 0.0, 1e-300], [1e-12, 0.0, -1.0], [0.0, -1e-12, -1.0], [1.0, 0.0, 0.0]]
    for lens in ((), (0.01, 0.0, 0.0, 0.0)):
        assert np.isnan(project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, -0.0, -1e300], [0.0, 0.0, -0.0]], K, lens, fisheye=True)).all()
        shown, radius = project(around, K, lens, fisheye=True), np.array([0.0, 0.0, np.pi, np.pi, np.pi / 2])
        radius += 0.01 * radius**3 if lens else 0.0
        where = np.array([[0, 0], [0, 0], [1, 0], [0, -1], [1, 0]]) * radius[:, None]
        np.testing.assert_allclose(shown, centre + where @ np.array(K)[:2, :2].T, rtol=1e-9)


@pytest.mark.parametrize("call, said", [
    (lambda: pinhole(K, SIZE, distortion=(-0.6, 0.0, 0.0, 0.0)), ("distortion", "leaves pixel (0, 0) without a ray: it folds over")),
    (lambda: pinhole(K, (640, 480), distortion=(-0.3, 0.0, 0.0, 0.0)), ("distortion", "folds over")),
    (lambda: pinhole(K, SIZE, distortion=(0.0, 0.0, 0.0, 0.0, 0.0, 1.5, 0.0, 0.0)), ("distortion", "folds over")),
    (lambda: pinhole(K, SIZE, distortion=(0.0, 0.0, 0.8, 0.0)), ("distortion", "folds over")),
    (lambda: fisheye(K, SIZE, distortion=(-0.5, 0.0, 0.0, 0.0)), ("distortion", "folds over")),
    (lambda: fisheye(K, (640, 480)), ("distortion", "exceed pi")),
    (lambda: unproject([[12.0, 9.0], [1e4, 0.0]], K, (-0.2, 0.0, 0.0, 0.0)), ("distortion", "pixel (10000, 0)")),
    (lambda: pinhole(K, SIZE, distortion=(0.1, 0.1)), ("distortion", "4, 5, 8 or 12")),
    (lambda: pinhole(K, SIZE, distortion=(0.1, np.nan, 0.0, 0.0)), ("distortion", "finite")),
    (lambda: pinhole(K, SIZE, distortion=(0.1,) * 14), ("distortion", "4, 5, 8 or 12")),
    (lambda: fisheye(K, SIZE, distortion=(0.1,) * 5), ("distortion", "k1 to k4")),
    (lambda: project([1.0, 2.0], K), ("points", "(..., 3)")),
    (lambda: unproject([1.0, 2.0, 3.0], K), ("pixels", "(..., 2)")),
])
def test_what_is_refused(call: Any, said: Refusal) -> None:
    with refused(*said):
        call()
