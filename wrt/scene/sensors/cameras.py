"""Pinhole and fisheye cameras, with lens distortion, as arrays of rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from wrt.core.arrays import given_like
from wrt.core.checks import as_size, shown
from wrt.core.errors import InputError
from wrt.core.suggestions import suggest_keywords
from wrt.core.types import ArrayLike
from wrt.scene.sensors.distortion import Fisheye, Radial
from wrt.scene.sensors.sensor import Sensor, as_doubles, make_sensor

FOLDS = "it folds over before this pixel"
FOLDS_OR_TURNS = FOLDS + ", or the angle from the axis would exceed pi"


@suggest_keywords
def pinhole(intrinsics: ArrayLike, size: tuple[int, int] | str, pose: ArrayLike | None = None, distortion: ArrayLike = (),
            rolling: bool = False, like: object = None) -> Sensor[Any]:
    """Make one ray through the centre of each pixel of a pinhole camera.

    Parameters
    ----------
    intrinsics
        K, (3, 3) in pixels, or (B, 3, 3) for B cameras; broadcasts with `pose`. The camera's frame is that of OpenCV: x right, y down,
        z forward. A point p in this frame projects to K p / z, with (0, 0) at the centre of the top left pixel.
    size
        Width and height in pixels, or text such as "640x480".
    pose
        (4, 4), camera to world: a rotation and a translation. (B, 4, 4): B cameras. None: the identity. A pair (R, t) is OpenCV's,
        world to camera: R (3, 3) or (B, 3, 3), or a rotation vector (3,).
    distortion
        OpenCV's coefficients in its order: k1 k2 p1 p2 (radial and tangential), k3, k4 k5 k6 (rational), s1 s2 s3 s4 (thin prism):
        4, 5, 8 or 12 numbers.
    rolling
        Rolling shutter: `pose` is (rows, 4, 4) or (B, rows, 4, 4), the pose of each image row at the time of its exposure.
    like
        Warp array or tensor of PyTorch or JAX: the rays get its library and device. None: those of `pose`.

    Returns
    -------
    Sensor
        Directions have z = 1 in the camera's frame, so that t of a hit is its depth.

    Raises
    ------
    InputError
        If an argument does not have this form, the distortion folds over within the picture, or the rays exceed the range of float32.
    """
    lens = Radial(distortion)

    def directions(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        (x, y), exists = lens.undistort_picture(x, y)
        _require_rays(exists, FOLDS)
        return _at_depth_1(x, y)

    return make_sensor(_picture(intrinsics, size, directions), pose, 2, 0 if rolling else None, like)


def fisheye(intrinsics: ArrayLike, size: tuple[int, int] | str, pose: ArrayLike | None = None, distortion: ArrayLike = (),
            rolling: bool = False, like: object = None) -> Sensor[Any]:
    """Make one ray through the centre of each pixel of a fisheye camera, by OpenCV's fisheye model.

    Parameters
    ----------
    intrinsics, size, pose, rolling, like
        See `pinhole`.
    distortion
        k1 k2 k3 k4. Without, the distance from the image's centre is proportional to the angle from the axis (equidistant).

    Returns
    -------
    Sensor
        Directions have unit length, so that t of a hit is its range.

    Raises
    ------
    InputError
        If an argument does not have this form, the distortion folds over within the picture, or a corner would show an angle above pi.
    """
    lens = Fisheye(distortion)

    def directions(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        out, exists = _fisheye_directions(lens, x, y)
        _require_rays(exists, FOLDS_OR_TURNS)
        return out

    return make_sensor(_picture(intrinsics, size, directions), pose, 2, 0 if rolling else None, like)


def project(points: ArrayLike, intrinsics: ArrayLike, distortion: ArrayLike = (), fisheye: bool = False) -> Any:
    """Return the pixels at which a camera shows points.

    Parameters
    ----------
    points
        (..., 3) in the camera's frame.
    intrinsics, distortion
        See `pinhole`, or `fisheye` if that is True.

    Returns
    -------
    (..., 2) float64
        Column and row, also outside the picture; NaN for points that a pinhole camera does not see, with z <= 0, and for those that a
        fisheye camera shows at no pixel: the camera itself and points exactly behind it.

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    k, place = _intrinsics(intrinsics), _rows_of(points, "points", 3)
    x, y, z = np.moveaxis(place, -1, 0)
    with np.errstate(all="ignore"):
        if fisheye:
            across = np.hypot(x, y)
            scale = np.where(across > 0.0, Fisheye(distortion).radius(np.arctan2(across, z)) / across, np.where(z > 0.0, 0.0, np.nan))
            x, y = x * scale, y * scale
        else:
            ahead = np.where(z > 0.0, z, np.nan)
            x, y = Radial(distortion).distort(x / ahead, y / ahead)
        pixels = np.stack([k[0, 0] * x + k[0, 1] * y + k[0, 2], k[1, 1] * y + k[1, 2]], axis=-1)
    return given_like(points, pixels)


def unproject(pixels: ArrayLike, intrinsics: ArrayLike, distortion: ArrayLike = (), fisheye: bool = False) -> Any:
    """Return the directions in which a camera sees pixels: the inverse of `project`.

    Parameters
    ----------
    pixels
        (..., 2), column and row.
    intrinsics, distortion, fisheye
        See `project`.

    Returns
    -------
    (..., 3) float64
        Directions in the camera's frame: z = 1 for a pinhole camera, unit length for a fisheye camera.

    Raises
    ------
    InputError
        Names the argument and what was expected, or the first pixel that no ray reaches, because the distortion folds over.
    """
    k, place = _intrinsics(intrinsics), _rows_of(pixels, "pixels", 2)
    x, y = _on_plane(k, place[..., 0], place[..., 1])
    if fisheye:
        directions, exists = _fisheye_directions(Fisheye(distortion), x, y)
    else:
        (x, y), exists = Radial(distortion).undistort(x, y)
        directions = _at_depth_1(x, y)
    _require_rays(exists, FOLDS_OR_TURNS if fisheye else FOLDS, place)
    return given_like(pixels, directions)


def _picture(intrinsics: ArrayLike, size: tuple[int, int] | str, directions: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the directions of all pixels: (rows, columns, 3), or (B, rows, columns, 3) for B intrinsics.

    directions: makes them from the pixels' points on the plane z = 1, which are still distorted.
    """
    ks, (width, height) = as_doubles(intrinsics, "intrinsics"), as_size(size)
    columns, rows = np.arange(float(width))[None, :], np.arange(float(height))[:, None]
    if ks.ndim != 3 or not len(ks):
        return directions(*np.broadcast_arrays(*_on_plane(_intrinsics(ks), columns, rows)))
    return np.stack([directions(*np.broadcast_arrays(*_on_plane(_intrinsics(k, i), columns, rows))) for i, k in enumerate(ks)])


def _intrinsics(value: ArrayLike, index: int | None = None) -> np.ndarray:
    k = as_doubles(value, "intrinsics")
    name = "intrinsics" if index is None else f"intrinsics[{index}]"
    if k.shape != (3, 3) or not np.isfinite(k).all() or not np.array_equal(k[2], [0.0, 0.0, 1.0]) or k[1, 0] != 0.0:
        given = k.tolist() if k.shape == (3, 3) else shown(k)
        raise InputError(f"must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], got {given}", argument=name)
    if not (k[0, 0] > 0.0 and k[1, 1] > 0.0):
        raise InputError(f"must have focal lengths above 0, got {k[0, 0]:g} and {k[1, 1]:g}", argument=name)
    return k


def _on_plane(k: np.ndarray, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of pixels on the plane z = 1, still distorted."""
    y = (row - k[1, 2]) / k[1, 1]
    return (column - k[0, 2] - k[0, 1] * y) / k[0, 0], y


def _at_depth_1(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the directions (..., 3) to points on the plane z = 1."""
    out = np.empty((*x.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y, 1.0
    return out


def _fisheye_directions(lens: Fisheye, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit directions that a fisheye lens shows at (x, y), and whether each exists."""
    radius = np.hypot(x, y)
    angle, exists = lens.angle(radius)
    scale = np.divide(np.sin(angle), radius, out=np.ones_like(radius), where=radius > 0.0)
    return np.stack([x * scale, y * scale, np.cos(angle)], axis=-1), exists


def _rows_of(value: ArrayLike, name: str, columns: int) -> np.ndarray:
    array = as_doubles(value, name)
    if array.shape[-1:] != (columns,):
        raise InputError(f"must be (..., {columns}), got {array.shape}", argument=name)
    return array


def _require_rays(exists: np.ndarray, why: str, pixels: np.ndarray | None = None) -> None:
    """Raise InputError that names the first pixel without a ray. pixels: (..., 2), or None for the pixels of a picture."""
    if not exists.all():
        first = int(np.argmin(exists))
        column, row = np.unravel_index(first, exists.shape)[::-1] if pixels is None else pixels.reshape(-1, 2)[first]
        raise InputError(f"leaves pixel ({column:g}, {row:g}) without a ray: {why}", argument="distortion",
                         hint="check the order of the coefficients, or fit fewer of them, or crop the picture")
