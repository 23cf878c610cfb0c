"""The rays of a picture as arrays, for asking a structure directly instead of rendering."""

from __future__ import annotations

import math

import numpy as np

from wrt.core.checks import as_one, as_size
from wrt.scene.cameras import Camera


def camera_rays(camera: Camera, size: tuple[int, int] | str) -> tuple[np.ndarray, np.ndarray]:
    """One ray a pixel, through the middle of the lens and the pixel's centre: those of a Film's AOVs, but for rounding.

    size: width and height, or "640x360". Returns origins and directions, (width * height, 3) float32 each, in world space, row
    by row from the top left; directions have unit length, so that a hit's t is the AOV "depth". Raises InputError.
    """
    width, height = as_size(size)
    pose = as_one(camera, Camera, "camera").camera_to_world
    tan_y = math.tan(0.5 * camera.fov_y)
    x = (2.0 * (np.arange(width) + 0.5) / width - 1.0) * tan_y * width / height
    y = (1.0 - 2.0 * (np.arange(height) + 0.5) / height) * tan_y
    directions = x[None, :, None] * pose[:3, 0] + y[:, None, None] * pose[:3, 1] - pose[:3, 2]
    directions = (directions / np.linalg.norm(directions, axis=2, keepdims=True)).reshape(-1, 3).astype(np.float32)
    return np.tile(pose[:3, 3].astype(np.float32), (len(directions), 1)), directions
