"""Pinhole and fisheye cameras, with lens distortion as OpenCV defines it, as arrays of rays.

Source: OpenCV's documentation, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model". A lens shows a direction at a
point (x, y) of the plane z = 1 of the camera's frame. A pixel's ray needs the inverse, which has no closed form.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from wrt.core.arrays import given_like
from wrt.core.checks import as_array, as_size, shown
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike
from wrt.sensors.sensor import Frame, Sensor, as_doubles, make_sensor

LENGTHS = 0, 4, 5, 8, 12  # Numbers of coefficients: k1 k2 p1 p2, k3, k4 k5 k6, s1 s2 s3 s4.
STEPS = 64  # Of the path from the centre to a point.
NODES = 65  # Of the grid of a picture, at most, along each side.
EXACT = 1e-13  # Largest error of an inverse on the plane z = 1; relative for a point farther than 1 from the centre.
Points = tuple[np.ndarray, np.ndarray]  # x and y
Rays = tuple[np.ndarray, np.ndarray]  # directions (..., 3), and whether each exists


class Radial:
    """Radial (rational), tangential and thin-prism distortion. coefficients: see `pinhole`."""

    no_ray = "it folds over before this pixel"

    def __init__(self, coefficients: ArrayLike) -> None:
        given = as_array(coefficients, np.float64, "distortion").reshape(-1)
        if len(given) == 14 and not given[12:].any():
            given = given[:12]
        if len(given) not in LENGTHS or not np.isfinite(given).all():
            raise InputError("must be 4, 5, 8 or 12 finite numbers: k1 k2 p1 p2, then k3, then k4 k5 k6, then s1 s2 s3 s4, got"
                             f" {shown(coefficients)}", argument="distortion", hint="the tilted sensor of 14 numbers is not modelled")
        self.coefficients = np.pad(given, (0, 12 - len(given)))

    def points(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Points:
        """Return where the lens shows directions; NaN where z <= 0."""
        ahead = np.where(z > 0.0, z, np.nan)
        return self._distort(x / ahead, y / ahead)[0]

    def rays(self, x: np.ndarray, y: np.ndarray) -> Rays:
        """Return the directions (..., 3), with z = 1, that the lens shows at (x, y), and whether each exists."""
        return _at_depth_1(*self._undistort(x, y))

    def rays_of_picture(self, x: np.ndarray, y: np.ndarray) -> Rays:
        """Return `rays` of the pixels of a picture, (rows, columns). The inverse of each pixel begins at the inverse of a near pixel.

        If some of the near pixels have no ray, only these are reported.
        """
        if x.size <= NODES * NODES or not self.coefficients.any():
            return self.rays(x, y)
        steps = [-(-n // NODES) for n in x.shape]
        near = np.ix_(*(np.arange(0, n, step) for n, step in zip(x.shape, steps, strict=True)))
        nodes, exists = self._undistort(x[near], y[near])
        if not exists.all():
            everywhere = np.ones(x.shape, bool)
            everywhere[near] = exists
            return _at_depth_1((x, y), everywhere)
        cell = max(float(np.hypot(*(np.diff(each, axis=axis) for each in nodes)).max(initial=0.0)) for axis in (0, 1))
        nearest = np.ix_(*(np.minimum((np.arange(n) + step // 2) // step, (n - 1) // step)
                           for n, step in zip(x.shape, steps, strict=True)))
        start = nodes[0][nearest], nodes[1][nearest]
        with np.errstate(all="ignore"):
            found, good = self._polished(start, (x, y), np.ones(x.shape, bool))
            return _at_depth_1(found, good & (_distance(found, start) <= 2.0 * cell))

    def _distort(self, x: np.ndarray, y: np.ndarray) -> tuple[Points, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Return the distorted points (X, Y), and dX/dx, dX/dy, dY/dx, dY/dy; the derivatives are NaN beyond a pole."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self.coefficients
        r2 = x * x + y * y
        above, below = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        scale = above / np.where(below > 0.0, below, np.nan)
        slope = ((k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)) - scale * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / below  # by r2
        prism_x, prism_y = 2.0 * (s1 + 2.0 * s2 * r2), 2.0 * (s3 + 2.0 * s4 * r2)
        cross = 2.0 * (x * y * slope + p1 * x + p2 * y)
        points = (x * scale + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + s2 * r2),
                  y * scale + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + s4 * r2))
        return points, (scale + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x, cross + prism_x * y,
                        cross + prism_y * x, scale + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y)

    def _undistort(self, x: np.ndarray, y: np.ndarray) -> tuple[Points, np.ndarray]:
        """Return the points that the lens shows at (x, y), and whether each exists.

        The inverse is followed from the centre to each point. It ends where the distortion folds over: where the determinant of its
        derivatives is no longer positive.
        """
        if not self.coefficients.any():
            return (x, y), np.ones(x.shape, bool)
        with np.errstate(all="ignore"):
            found, exists = (np.zeros_like(x), np.zeros_like(y)), np.ones(x.shape, bool)
            for i in range(1, STEPS + 1):
                ends = x * (i / STEPS), y * (i / STEPS)
                ahead, _ = self._newton(found, ends, 1)
                settled, good = self._newton(ahead, ends, 2)
                near = _distance(settled, ahead) <= _distance(ahead, found) + EXACT  # another branch is far
                exists &= good & near
                found = settled
            return self._polished(found, (x, y), exists)

    def _polished(self, start: Points, ends: Points, exists: np.ndarray) -> tuple[Points, np.ndarray]:
        found, good = self._newton(start, ends, 6)
        miss = _distance(self._distort(*found)[0], ends)
        return found, exists & good & (miss <= EXACT * np.maximum(1.0, np.hypot(*ends)))

    def _newton(self, start: Points, ends: Points, steps: int) -> tuple[Points, np.ndarray]:
        """Return the points after steps of Newton's method, and whether the distortion did not fold over at any of them."""
        x, y = start
        good = np.ones(x.shape, bool)
        for _ in range(steps):
            (at_x, at_y), (a, b, c, d) = self._distort(x, y)
            determinant = a * d - b * c
            good &= (determinant > 0.0) & (a + d > 0.0)
            dx, dy = ends[0] - at_x, ends[1] - at_y
            x, y = x + (d * dx - b * dy) / determinant, y + (a * dy - c * dx) / determinant
        return (x, y), good & np.isfinite(x) & np.isfinite(y)


class Fisheye:
    """OpenCV's fisheye model: a direction at the angle theta from the axis is shown at theta (1 + k1 theta^2 + ... + k4 theta^8)."""

    no_ray = f"{Radial.no_ray}, or the angle from the axis would exceed pi"

    def __init__(self, coefficients: ArrayLike) -> None:
        given = as_array(coefficients, np.float64, "distortion").reshape(-1)
        if len(given) not in (0, 4) or not np.isfinite(given).all():
            raise InputError(f"must be 4 finite numbers, k1 to k4, got {shown(coefficients)}", argument="distortion")
        self.powers = np.array([1.0, *given])
        slope = self.powers * (2 * np.arange(len(self.powers)) + 1)  # of the shown radius, by theta^2
        turns = np.roots(np.trim_zeros(slope[::-1], "f"))
        folds = turns.real[(np.abs(turns.imag) <= 1e-9 * np.abs(turns)) & (turns.real > 0.0)]
        self.largest = min(float(np.sqrt(folds.min(initial=np.inf))), np.pi)  # angle up to which the radius grows

    def points(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Points:
        """Return where the lens shows directions; NaN for 0 and for the direction straight back."""
        across = np.hypot(x, y)
        scale = np.where(across > 0.0, self._radius(np.arctan2(across, z)) / across, np.where(z > 0.0, 0.0, np.nan))
        return x * scale, y * scale

    def rays(self, x: np.ndarray, y: np.ndarray) -> Rays:
        """Return the unit directions (..., 3) that the lens shows at (x, y), and whether each exists."""
        radius = np.hypot(x, y)
        low, high = np.zeros_like(radius), np.full_like(radius, self.largest)
        for _ in range(54):  # by bisection, as the radius grows with the angle
            middle = 0.5 * (low + high)
            less = self._radius(middle) < radius
            low, high = np.where(less, middle, low), np.where(less, high, middle)
        angle = 0.5 * (low + high)
        scale = np.divide(np.sin(angle), radius, out=np.ones_like(radius), where=radius > 0.0)
        return np.stack([x * scale, y * scale, np.cos(angle)], axis=-1), radius <= self._radius(np.array(self.largest))

    rays_of_picture = rays

    def _radius(self, theta: np.ndarray) -> np.ndarray:
        """Return the radius at which the lens shows an angle from the axis."""
        return theta * np.polyval(self.powers[::-1], theta * theta)


def _distance(a: Points, b: Points) -> np.ndarray:
    return np.hypot(a[0] - b[0], a[1] - b[1])


def _at_depth_1(points: Points, exists: np.ndarray) -> Rays:
    out = np.empty((*exists.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = *points, 1.0
    return out, exists


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
    return make_sensor(_picture(Radial(distortion), intrinsics, size), pose, 0 if rolling else None, like)


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
    return make_sensor(_picture(Fisheye(distortion), intrinsics, size), pose, 0 if rolling else None, like)


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


def _picture(lens: Lens, intrinsics: ArrayLike, size: tuple[int, int] | str) -> Frame:
    """Make the frame of all pixels: (rows, columns), or (B, rows, columns) for B intrinsics."""
    ks, (width, height) = as_doubles(intrinsics, "intrinsics"), as_size(size)
    many = ks.ndim == 3 and len(ks) > 0
    each = [_intrinsics(k, i) for i, k in enumerate(ks)] if many else [_intrinsics(ks)]
    if isinstance(lens, Radial) and not lens.coefficients.any():
        across, down = np.zeros((len(each), width, 2)), np.ones((len(each), height, 4))
        for i, k in enumerate(each):
            y = (np.arange(height) - k[1, 2]) / k[1, 1]
            across[i, :, 0], down[i, :, 2], down[i, :, 3] = (np.arange(width) - k[0, 2]) / k[0, 0], -k[0, 1] * y / k[0, 0], y
        return Frame(2, across=across if many else across[0], down=down if many else down[0])
    columns, rows = np.meshgrid(np.arange(float(width)), np.arange(float(height)))

    def of_one(k: np.ndarray) -> np.ndarray:
        directions, exists = lens.rays_of_picture(*_on_plane(k, columns, rows))
        if not exists.all():
            raise _no_ray(lens, *np.argwhere(~exists)[0][::-1])
        return directions

    return Frame(2, np.stack([of_one(k) for k in each]) if many else of_one(each[0]))


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
