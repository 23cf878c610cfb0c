"""Pinhole and fisheye cameras, with lens distortion, as arrays of rays."""

from __future__ import annotations

from typing import Any

import numpy as np

from wrt.core.arrays import given_like
from wrt.core.checks import as_size, shown
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike
from wrt.sensors.lenses import Fisheye, Radial
from wrt.sensors.sensor import Sensor, as_doubles, make_sensor

Lens = Radial | Fisheye


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
    return make_sensor(_picture(Radial(distortion), intrinsics, size), pose, 2, 0 if rolling else None, like)


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
    return make_sensor(_picture(Fisheye(distortion), intrinsics, size), pose, 2, 0 if rolling else None, like)


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
    """
    k, place, lens = _intrinsics(intrinsics), _rows_of(points, "points", 3), _lens(distortion, fisheye)
    with np.errstate(all="ignore"):
        x, y = lens.points(*np.moveaxis(place, -1, 0))
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
    place, lens = _rows_of(pixels, "pixels", 2), _lens(distortion, fisheye)
    directions, exists = lens.rays(*_on_plane(_intrinsics(intrinsics), place[..., 0], place[..., 1]))
    if not exists.all():
        raise _no_ray(lens, *place[~exists][0])
    return given_like(pixels, directions)


def _lens(distortion: ArrayLike, fisheye: bool) -> Lens:
    return Fisheye(distortion) if fisheye else Radial(distortion)


def _no_ray(lens: Lens, column: float, row: float) -> InputError:
    return InputError(f"leaves pixel ({column:g}, {row:g}) without a ray: {lens.no_ray}", argument="distortion",
                      hint="check the order of the coefficients, or fit fewer of them, or crop the picture")


def _picture(lens: Lens, intrinsics: ArrayLike, size: tuple[int, int] | str) -> np.ndarray:
    """Return the directions of all pixels: (rows, columns, 3), or (B, rows, columns, 3) for B intrinsics."""
    ks, (width, height) = as_doubles(intrinsics, "intrinsics"), as_size(size)
    columns, rows = np.meshgrid(np.arange(float(width)), np.arange(float(height)))

    def of_one(k: np.ndarray) -> np.ndarray:
        directions, exists = lens.rays_of_picture(*_on_plane(k, columns, rows))
        if not exists.all():
            raise _no_ray(lens, *np.argwhere(~exists)[0][::-1])
        return directions

    if ks.ndim != 3 or not len(ks):
        return of_one(_intrinsics(ks))
    return np.stack([of_one(_intrinsics(k, i)) for i, k in enumerate(ks)])


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


def _rows_of(value: ArrayLike, name: str, columns: int) -> np.ndarray:
    array = as_doubles(value, name)
    if array.shape[-1:] != (columns,):
        raise InputError(f"must be (..., {columns}), got {array.shape}", argument=name)
    return array
