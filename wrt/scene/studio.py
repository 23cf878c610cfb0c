"""A photographer's studio as an environment: soft boxes in a grey room, by formula, for metals and glass to reflect."""

from typing import NamedTuple

import numpy as np

from wrt.scene.backgrounds import EnvironmentBackground

SIZE = (512, 256)  # pixels of the picture
EDGE = 0.03  # width of a soft box's blurred edge, as a tangent


class SoftBox(NamedTuple):
    """A rectangle of light. toward: its direction for a camera that looks along -z; width, height: half of each, as tangents."""

    toward: tuple[float, float, float]
    width: float
    height: float
    radiance: float


BOXES = (
    SoftBox((0.75, 0.95, 0.85), 0.42, 0.42, 2.2),  # key, above the camera's right shoulder
    SoftBox((-1.0, 0.30, 0.35), 0.24, 0.65, 1.2),  # fill, a strip on the left
    SoftBox((0.45, 0.75, -1.00), 0.60, 0.16, 2.2),  # rim, behind the subject and above the picture
    SoftBox((-0.25, 1.0, 0.0), 0.50, 0.35, 1.0),  # overhead
)
# Radiance of the room from straight below to straight above, by the sine of the elevation.
ELEVATIONS = (-1.0, -0.6, -0.05, 0.15, 1.0)
ROOM = (0.10, 0.20, 0.42, 0.40, 0.16)


def studio(rotation: float = 0.0) -> EnvironmentBackground:
    """Return the studio for a camera that looks along -z, turned by `rotation` (radians) about +y, counter-clockwise seen from above."""
    width, height = SIZE
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = 2.0 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    ray = np.stack(np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)), axis=-1)
    radiance = np.interp(ray[..., 1], ELEVATIONS, ROOM)
    for box in BOXES:
        back = np.array(box.toward) / np.linalg.norm(box.toward)
        side = np.cross((0.0, 1.0, 0.0) if abs(back[1]) < 0.9 else (0.0, 0.0, 1.0), back)
        side /= np.linalg.norm(side)
        along = np.maximum(ray @ back, 1e-9)
        inside = [np.clip((half - np.abs(ray @ axis) / along) / EDGE + 0.5, 0.0, 1.0)
                  for axis, half in ((side, box.width), (np.cross(back, side), box.height))]
        radiance = np.maximum(radiance, box.radiance * inside[0] * inside[1])
    return EnvironmentBackground(np.repeat(radiance[..., None], 3, axis=-1), rotation=rotation, name="studio")
