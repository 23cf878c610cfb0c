"""Lens distortion as OpenCV defines it, and its inverse.

Source: OpenCV's documentation, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model". A lens shows a direction at a
point (x, y) of the plane z = 1 of the camera's frame. A pixel's ray needs the inverse, which has no closed form.
"""

import numpy as np

from wrt.core.checks import as_array, shown
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike

LENGTHS = 0, 4, 5, 8, 12  # Numbers of coefficients: k1 k2 p1 p2, k3, k4 k5 k6, s1 s2 s3 s4.
STEPS = 64  # Of the path from the centre to a point.
NODES = 65  # Of the grid of a picture, at most, along each side.
EXACT = 1e-13  # Largest error of an inverse, on the plane z = 1 and relative to a point there that is farther than 1.
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
        """Return `rays` of the pixels of a picture, (rows, columns). The inverse of each pixel begins at that of a near pixel.

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
