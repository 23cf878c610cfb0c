"""LiDARs as arrays of rays, by their angles or by the name of a device, and the noise of range sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from wrt.core.arrays import given_like
from wrt.core.checks import as_array, as_integer, as_size, require_known, shown
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike
from wrt.scene.values import as_number
from wrt.sensors.sensor import Frame, Sensor, as_doubles, make_sensor

TURN = 2.0 * np.pi


@dataclass(frozen=True, eq=False)
class LidarModel:
    """Pattern of a rotating LiDAR by its maker's table. It keeps the arrays that it is given.

    Parameters
    ----------
    elevations
        (rows,) degrees above the plane of rotation, from the top.
    columns
        Columns of a turn at 10 turns a second.
    source
        Document that has the numbers. Only the HDL-32E's angles were compared with it; check the others before you rely on them.
    """

    elevations: np.ndarray
    columns: int
    source: str


def _ouster(family: str, fov: float, channels: int) -> LidarModel:
    """Return a model of Ouster with uniform channels: nominal angles, without the calibration of one device."""
    return LidarModel(np.linspace(0.5 * fov, -0.5 * fov, channels), 1024, f"Ouster {family} data sheet: {fov:g} degrees high")


# A turn of Velodyne's devices has 1 / (10 Hz x firing cycle) columns; the cycles are 55.296 and 46.080 microseconds.
LIDARS = {
    "vlp-16": LidarModel(np.linspace(15.0, -15.0, 16), 1808, "Velodyne VLP-16 user manual 63-9243: channels 2 degrees apart"),
    "hdl-32e": LidarModel(np.linspace(32.0, -92.0, 32) / 3.0, 2170, "Velodyne HDL-32E user manual: 10.67 to -30.67 degrees, by 4/3"),
    **{f"{family}-{channels}": _ouster(family.upper(), fov, channels)
       for family, fov in (("os0", 90.0), ("os1", 45.0), ("os2", 22.5)) for channels in (32, 64, 128)},
}


def lidar(name: str, pose: ArrayLike | None = None, columns: int | None = None, rolling: bool = False, like: object = None) -> Sensor[Any]:
    """Make the rays of one turn of a named LiDAR: rows from the top, columns clockwise seen from above, from straight ahead.

    Parameters
    ----------
    name
        Name in `LIDARS`, such as "vlp-16"; each entry names its source. The angles are nominal: devices differ in calibration.
    columns
        Columns of a turn; None: at 10 turns a second.
    pose, rolling, like
        See `rotating_lidar`.

    Returns
    -------
    Sensor
        Directions have unit length, so that t of a hit is its range.
    """
    require_known(name, LIDARS, "LiDAR", "name")
    model = LIDARS[name]
    return rotating_lidar(np.radians(model.elevations), model.columns if columns is None else columns, pose, 0.0, -TURN, rolling, like)


def rotating_lidar(elevations: ArrayLike, steps: int, pose: ArrayLike | None = None, start: float = 0.0, turn: float = TURN,
                   rolling: bool = False, like: object = None) -> Sensor[Any]:
    """Make the rays of a rotating LiDAR: one ring of `steps` rays for each elevation.

    In the sensor's frame x is forward (azimuth 0), y left and z up.

    Parameters
    ----------
    elevations
        (rows,) angles above the plane of rotation, in radians.
    steps
        Number of columns.
    pose
        (4, 4), sensor to world: a rotation and a translation. (B, 4, 4): B sensors. None: the identity.
    start, turn
        Column i has the azimuth start + i turn / steps in radians, counter-clockwise seen from above.
    rolling
        Motion during a turn: `pose` is (steps, 4, 4) or (B, steps, 4, 4), the pose of each column.
    like
        See `pinhole`.

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
        raise InputError(f"must be one or more angles, -pi/2 to pi/2 radians, got {shown(elevations)}", argument="elevations",
                         hint="np.radians converts degrees")
    steps = as_integer(steps, "steps", 1, 1 << 24)
    azimuths = as_number(start, "start") + as_number(turn, "turn") * np.arange(steps) / steps
    return make_sensor(_spherical(azimuths, rows), pose, 1 if rolling else None, like)


def raster_lidar(fov: tuple[float, float], size: tuple[int, int] | str, pose: ArrayLike | None = None, rolling: bool = False,
                 like: object = None) -> Sensor[Any]:
    """Make the rays of a solid-state LiDAR: equal steps of azimuth and elevation, row by row from the top left.

    The sensor's frame, the pose, the length of directions and the errors are those of `rotating_lidar`.

    Parameters
    ----------
    fov
        Field of view in radians: the angle from the first column to the last, and from the first row to the last.
    size
        Columns and rows, or text such as "240x80".
    pose, like
        See `rotating_lidar`.
    rolling
        `pose` is (rows, 4, 4) or (B, rows, 4, 4), the pose of each row.

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
    return make_sensor(_spherical(azimuths, elevations), pose, 0 if rolling else None, like)


def _spherical(azimuths: np.ndarray, elevations: np.ndarray) -> Frame:
    """Make the frame of unit vectors with x forward, y left, z up. Angles are in radians, of columns and rows."""
    none = np.full(len(elevations), -0.0)  # x - 0.0 has the sign of x, also for 0
    return Frame(0, across=np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1),
                 down=np.stack([np.cos(elevations), np.sin(elevations), none, none], axis=-1))


def with_range_noise(ranges: ArrayLike, seed: int, constant: float = 0.0, proportional: float = 0.0, dropout: float = 0.0) -> Any:
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
    float32 array of the shape and the library of `ranges`

    Raises
    ------
    InputError
        If a range is NaN, negative or, with its noise, beyond float32, or an argument is out of range.
    """
    given, ranges = ranges, as_doubles(ranges, "ranges")
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
    out = as_array(noisy, np.float32, "ranges").reshape(ranges.shape)
    if (hit & np.isinf(out)).any():
        raise InputError("must be within the range of float32, with their noise, or inf for a miss", argument="ranges")
    return given_like(given, out)
