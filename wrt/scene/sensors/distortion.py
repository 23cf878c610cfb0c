"""Lens distortion as OpenCV defines it, and its inverse.

Source: OpenCV's documentation, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model". A point (x, y) is on the plane
z = 1 of the camera's frame. The function `distort` moves it to where the lens shows it. A pixel's ray needs the inverse, which
has no closed form.
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


class Radial:
    """Radial (rational), tangential and thin-prism distortion. coefficients: see `pinhole`."""

    def __init__(self, coefficients: ArrayLike) -> None:
        given = as_array(coefficients, np.float64, "distortion").reshape(-1)
        if len(given) == 14 and not given[12:].any():
            given = given[:12]
        if len(given) not in LENGTHS or not np.isfinite(given).all():
            raise InputError("must be 4, 5, 8 or 12 finite numbers: k1 k2 p1 p2, then k3, then k4 k5 k6, then s1 s2 s3 s4, got"
                             f" {shown(coefficients)}", argument="distortion", hint="the tilted sensor of 14 numbers is not modelled")
        self.coefficients = np.pad(given, (0, 12 - len(given)))

    def distort(self, x: np.ndarray, y: np.ndarray) -> Points:
        """Return the distorted points."""
        return self.with_derivatives(x, y)[0]

    def with_derivatives(self, x: np.ndarray, y: np.ndarray) -> tuple[Points, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
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

    def undistort(self, x: np.ndarray, y: np.ndarray) -> tuple[Points, np.ndarray]:
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

    def undistort_picture(self, x: np.ndarray, y: np.ndarray) -> tuple[Points, np.ndarray]:
        """Return the same as `undistort` for the pixels of a picture, (rows, columns), from a grid of fewer points.

        If points of the grid have no inverse, only these are reported.
        """
        if x.size <= NODES * NODES or not self.coefficients.any():
            return self.undistort(x, y)
        rows, columns = (np.unique(np.linspace(0, n - 1, min(n, NODES)).round().astype(int)) for n in x.shape)
        exists, grid = np.ones(x.shape, bool), np.ix_(rows, columns)
        nodes, exists[grid] = self.undistort(x[grid], y[grid])
        if not exists.all():
            return (x, y), exists
        start = [_interpolated(each, rows, columns, x.shape) for each in nodes]
        cell = max(float(np.hypot(*(np.diff(each, axis=axis) for each in nodes)).max(initial=0.0)) for axis in (0, 1))
        with np.errstate(all="ignore"):
            found, good = self._polished((start[0], start[1]), (x, y), np.ones(x.shape, bool))
            return found, good & (_distance(found, (start[0], start[1])) <= cell)

    def _polished(self, start: Points, ends: Points, exists: np.ndarray) -> tuple[Points, np.ndarray]:
        found, good = self._newton(start, ends, 6)
        miss = _distance(self.distort(*found), ends)
        return found, exists & good & (miss <= EXACT * np.maximum(1.0, np.hypot(*ends)))

    def _newton(self, start: Points, ends: Points, steps: int) -> tuple[Points, np.ndarray]:
        """Take steps of Newton's method, and return whether the determinant was positive at each."""
        x, y = start
        good = np.ones(x.shape, bool)
        for _ in range(steps):
            (at_x, at_y), (a, b, c, d) = self.with_derivatives(x, y)
            determinant = a * d - b * c
            good &= (determinant > 0.0) & (a + d > 0.0)
            dx, dy = ends[0] - at_x, ends[1] - at_y
            x, y = x + (d * dx - b * dy) / determinant, y + (a * dy - c * dx) / determinant
        return (x, y), good & np.isfinite(x) & np.isfinite(y)


class Fisheye:
    """OpenCV's fisheye model: a direction at the angle theta from the axis is shown at theta (1 + k1 theta^2 + ... + k4 theta^8)."""

    def __init__(self, coefficients: ArrayLike) -> None:
        given = as_array(coefficients, np.float64, "distortion").reshape(-1)
        if len(given) not in (0, 4) or not np.isfinite(given).all():
            raise InputError(f"must be 4 finite numbers, k1 to k4, got {shown(coefficients)}", argument="distortion")
        self.powers = np.array([1.0, *given]) if len(given) else np.array([1.0])
        slope = self.powers * (2 * np.arange(len(self.powers)) + 1)  # of the shown radius, by theta^2
        turns = np.roots(np.trim_zeros(slope[::-1], "f"))
        folds = turns.real[(np.abs(turns.imag) <= 1e-9 * np.abs(turns)) & (turns.real > 0.0)]
        self.largest = min(float(np.sqrt(folds.min(initial=np.inf))), np.pi)  # angle up to which the radius grows

    def radius(self, theta: np.ndarray) -> np.ndarray:
        """Return the radius at which the lens shows an angle from the axis."""
        square, out = theta * theta, np.zeros_like(theta)
        for power in self.powers[::-1]:
            out = out * square + power
        return theta * out

    def angle(self, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the angle that the lens shows at a radius, and whether it exists. By bisection, as the radius grows."""
        exists = radius <= self.radius(np.array(self.largest))
        low, high = np.zeros_like(radius), np.full_like(radius, self.largest)
        for _ in range(54):
            middle = 0.5 * (low + high)
            less = self.radius(middle) < radius
            low, high = np.where(less, middle, low), np.where(less, high, middle)
        return 0.5 * (low + high), exists


def _distance(a: Points, b: Points) -> np.ndarray:
    return np.hypot(a[0] - b[0], a[1] - b[1])


def _interpolated(nodes: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return values at all pixels from values at the crossings of some rows and columns, bilinear."""
    along = np.stack([np.interp(np.arange(shape[1]), columns, each) for each in nodes])
    cell = np.clip(np.searchsorted(rows, np.arange(shape[0]), "right") - 1, 0, max(len(rows) - 2, 0))
    last = np.minimum(cell + 1, len(rows) - 1)
    share = ((np.arange(shape[0]) - rows[cell]) / np.maximum(rows[last] - rows[cell], 1))[:, None]
    return along[cell] * (1.0 - share) + along[last] * share
