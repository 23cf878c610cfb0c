"""Cameras and LiDARs as arrays of rays, and images of their hits.

>>> sensor = wrt.sensors.pinhole(K, (640, 480), camera_to_world)
>>> hits = accel.closest_hit(sensor.origins, sensor.directions)
>>> depth, faces = sensor.depth(hits), sensor.picture(hits.prim_id)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.arrays import to_numpy
from wrt.core.checks import as_array, as_integer, as_size, shown
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike
from wrt.scene.values import as_number, as_transform

if TYPE_CHECKING:
    from wrt.accel.queries.answers import Hits

__all__ = ["Sensor", "pinhole", "raster_lidar", "rotating_lidar", "with_range_noise"]

TURN = 2.0 * np.pi
MAX_ROTATION_ERROR = 1e-5  # largest entry of |R R^T - I| for the rotation matrix R of a pose


@dataclass(frozen=True, eq=False)
class Sensor:
    """Rays of a sensor, one per pixel, and the shape of its images.

    Parameters
    ----------
    origins, directions
        (N, 3) float32 each, in world space: one image row after another.
    shape
        Number of rows and of columns of an image; N is their product.
    axis
        (3,) float64, unit vector in world space along which `depth` measures.
    """

    origins: np.ndarray
    directions: np.ndarray
    shape: tuple[int, int]
    axis: np.ndarray

    def picture(self, values: ArrayLike) -> np.ndarray:
        """Reshape one value per ray, (N, ...), such as hits.prim_id or hits.normal, to an image (rows, columns, ...).

        Raises InputError if there is not one value per ray.
        """
        values = to_numpy(values)
        if values.shape[:1] != (len(self.origins),):
            raise InputError(f"must have one row per ray, ({len(self.origins)}, ...), got {values.shape}", argument="values")
        return values.reshape(*self.shape, *values.shape[1:])

    def range(self, hits: Hits) -> np.ndarray:
        """Return the distance of each hit from the sensor, (rows, columns) float32 in scene units; inf on a miss."""
        return self._scaled(hits, np.linalg.norm(self.directions.astype(np.float64), axis=1))

    def depth(self, hits: Hits) -> np.ndarray:
        """Return the distance of each hit along the sensor's axis, (rows, columns) float32 in scene units.

        The depth is inf on a miss and negative behind the sensor. For a camera it is z in the camera's frame, as in depth images.
        """
        return self._scaled(hits, self.directions.astype(np.float64) @ self.axis)

    def _scaled(self, hits: Hits, factor: np.ndarray) -> np.ndarray:
        if not hasattr(hits, "t"):
            raise InputError(f"must be the Hits that closest_hit returned, got {shown(hits)}", argument="hits")
        t = self.picture(hits.t).astype(np.float64)
        scaled = np.where(np.isfinite(t), t, 0.0) * factor.reshape(self.shape)
        return np.where(np.isfinite(t), scaled, np.inf).astype(np.float32)


def pinhole(intrinsics: ArrayLike, size: tuple[int, int] | str, pose: ArrayLike | None = None) -> Sensor:
    """Make one ray through the centre of each pixel of a pinhole camera, without lens distortion.

    Parameters
    ----------
    intrinsics
        K, (3, 3) in pixels. The camera's frame is that of OpenCV: x right, y down, z forward. A point p in this frame projects to
        K p / z, with (0, 0) at the centre of the top left pixel.
    size
        Width and height in pixels, or text such as "640x480".
    pose
        (4, 4), camera to world: a rotation and a translation. None: the identity.

    Returns
    -------
    Sensor
        Directions have z = 1 in the camera's frame, so that t of a hit is its depth.

    Raises
    ------
    InputError
        If an argument does not have this form, or the rays exceed the range of float32.
    """
    k = as_array(intrinsics, np.float64, "intrinsics")
    if k.shape != (3, 3) or not np.isfinite(k).all() or not np.array_equal(k[2], [0.0, 0.0, 1.0]) or k[1, 0] != 0.0:
        raise InputError(f"must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}", argument="intrinsics")
    if not (k[0, 0] > 0.0 and k[1, 1] > 0.0):
        raise InputError(f"must have focal lengths above 0, got {k[0, 0]:g} and {k[1, 1]:g}", argument="intrinsics")
    width, height = as_size(size)
    y = (np.arange(height)[:, None] - k[1, 2]) / k[1, 1]
    x = (np.arange(width)[None, :] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    return _sensor(np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1), pose, axis=2)


def rotating_lidar(elevations: ArrayLike, steps: int, pose: ArrayLike | None = None, start: float = 0.0, turn: float = TURN) -> Sensor:
    """Make the rays of a rotating LiDAR: one ring of `steps` rays for each elevation.

    In the sensor's frame x is forward (azimuth 0), y left and z up.

    Parameters
    ----------
    elevations
        (rows,) angles above the plane of rotation, in radians.
    steps
        Number of columns.
    pose
        (4, 4), sensor to world: a rotation and a translation. None: the identity.
    start, turn
        Column i has the azimuth start + i turn / steps in radians, counter-clockwise seen from above.

    Returns
    -------
    Sensor
        Directions have unit length, so that t of a hit is its range.

    Raises
    ------
    InputError
        If an argument does not have this form, or the rays exceed the range of float32.
    """
    rows = as_array(elevations, np.float64, "elevations")
    if rows.ndim != 1 or not len(rows) or not (np.abs(rows) <= 0.5 * np.pi).all():
        raise InputError("must be one or more angles, -pi/2 to pi/2 radians", argument="elevations")
    steps = as_integer(steps, "steps", 1, 1 << 24)
    azimuths = as_number(start, "start") + as_number(turn, "turn") * np.arange(steps) / steps
    return _sensor(_spherical(azimuths[None, :], rows[:, None]), pose, axis=0)


def raster_lidar(fov: tuple[float, float], size: tuple[int, int] | str, pose: ArrayLike | None = None) -> Sensor:
    """Make the rays of a solid-state LiDAR: equal steps of azimuth and elevation, row by row from the top left.

    The sensor's frame, the pose, the length of directions and the errors are those of `rotating_lidar`.

    Parameters
    ----------
    fov
        Field of view in radians: the angle from the first column to the last, and from the first row to the last.
    size
        Columns and rows, or text such as "240x80".
    pose
        (4, 4), sensor to world.

    Returns
    -------
    Sensor

    Raises
    ------
    InputError
        Names the argument and what was expected.
    """
    width, height = as_size(size)
    angles = as_array(fov, np.float64, "fov")
    if angles.shape != (2,):
        raise InputError(f"must be two angles, got {shown(fov)}", argument="fov")
    across, up = (as_number(angle, "fov", low=0.0) for angle in angles.tolist())
    if across > TURN or up > np.pi:
        raise InputError(f"must be at most 2 pi across and pi up, got {across:g} and {up:g}", argument="fov")
    azimuths, elevations = (0.5 * angle * np.linspace(1.0, -1.0, n) if n > 1 else np.zeros(1)
                            for angle, n in ((across, width), (up, height)))
    return _sensor(_spherical(azimuths[None, :], elevations[:, None]), pose, axis=0)


def with_range_noise(ranges: ArrayLike, seed: int, constant: float = 0.0, proportional: float = 0.0, dropout: float = 0.0) -> np.ndarray:
    """Add the noise of a range sensor to ranges, independently for each element.

    The error of a range r is normally distributed with the standard deviation sqrt(constant^2 + (proportional r)^2). A result
    below 0 becomes 0.

    Parameters
    ----------
    ranges
        True ranges in scene units, 0 or more, of any shape; a miss is inf and stays inf.
    seed
        The same seed and shape give the same noise.
    constant, proportional
        Parts of the standard deviation: one in scene units, and one as a fraction of r.
    dropout
        Probability, 0 to 1, that a hit becomes a miss (inf).

    Returns
    -------
    float32 array of the shape of `ranges`

    Raises
    ------
    InputError
        If a range is NaN or negative, or an argument is out of range.
    """
    ranges, shape = as_array(ranges, np.float64, "ranges"), np.shape(ranges)
    if not (ranges >= 0.0).all():
        raise InputError(f"must be 0 or more, or inf for a miss, got {ranges[~(ranges >= 0.0)][0]:g}", argument="ranges")
    constant, proportional = (as_number(value, name, low=0.0) for value, name in ((constant, "constant"), (proportional, "proportional")))
    if not 0.0 <= as_number(dropout, "dropout") <= 1.0:
        raise InputError(f"must be 0 to 1, got {dropout:g}", argument="dropout")
    rng = np.random.default_rng(as_integer(seed, "seed", 0, (1 << 63) - 1))
    normal, lost = rng.standard_normal(ranges.shape), rng.random(ranges.shape) < dropout
    hit = np.isfinite(ranges) & ~lost
    r = np.where(hit, ranges, 0.0)
    noisy = np.where(hit, np.maximum(r + np.hypot(constant, proportional * r) * normal, 0.0), np.inf)
    return as_array(noisy, np.float32, "ranges").reshape(shape)


def _spherical(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Return unit vectors (rows, columns, 3) in a frame with x forward, y left, z up. Angles are in radians."""
    level = np.cos(elevation)
    return np.stack(np.broadcast_arrays(level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=-1)


def _sensor(directions: np.ndarray, pose: ArrayLike | None, axis: int) -> Sensor:
    """Make a sensor from directions (rows, columns, 3) in its own frame. axis: index of the frame's axis that measures depth."""
    matrix = as_transform(np.eye(4) if pose is None else pose, "pose")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0.0:
        raise InputError("must be a rotation and a translation", argument="pose")
    with np.errstate(over="ignore"):
        turned = (directions.reshape(-1, 3) @ rotation.T).astype(np.float32)
        origins = np.tile(matrix[:3, 3].astype(np.float32), (len(turned), 1))
    if not (np.isfinite(turned).all() and np.isfinite(origins).all()):
        raise InputError("rays of this sensor and pose exceed the range of float32")
    return Sensor(origins, turned, (directions.shape[0], directions.shape[1]), rotation[:, axis].copy())
