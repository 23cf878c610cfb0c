"""Where a picture is taken from, and with which lens."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wrt.core.checks import as_integer, at_thing
from wrt.core.errors import InputError
from wrt.scene.values import SMALLEST, as_number, as_transform, as_vector


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole, or a thin lens where `aperture_radius` > 0.

    camera_to_world: (4, 4), rotation and translation; it looks along its own -z, +y is up. fov_y: full vertical angle of
    view (radians). focus_distance: along the axis, from the lens to the plane that is sharp. blades: 0 for a round
    aperture, else the number of its straight sides (3 or more), turned by `blade_rotation` radians.
    `lens` gives fov_y, aperture_radius and focus_distance for a focal length, an f-number and a sensor height.
    """

    camera_to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    fov_y: float = math.radians(45.0)
    aperture_radius: float = 0.0
    focus_distance: float = 1.0
    blades: int = 0
    blade_rotation: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("camera", self.name)
        matrix = as_transform(self.camera_to_world, at + "camera_to_world").copy()
        # Only the pose counts: scale and shear would bend the picture, and glTF says that a camera ignores them.
        z = matrix[:3, 2]
        x = np.cross(matrix[:3, 1], z)
        if not np.linalg.norm(x) > 0.0:
            raise InputError(at + "camera_to_world is singular")
        z = z / np.linalg.norm(z)
        x = x / np.linalg.norm(x)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = x, np.cross(z, x), z
        object.__setattr__(self, "camera_to_world", matrix)
        object.__setattr__(self, "fov_y", as_number(self.fov_y, at + "fov_y", low=1e-5, high=math.pi - 1e-3))
        object.__setattr__(self, "aperture_radius", as_number(self.aperture_radius, at + "aperture_radius", low=0.0))
        object.__setattr__(self, "focus_distance", as_number(self.focus_distance, at + "focus_distance", low=SMALLEST))
        object.__setattr__(self, "blade_rotation", as_number(self.blade_rotation, at + "blade_rotation"))
        as_integer(self.blades, at + "blades", 0, 64)
        if self.blades in (1, 2):
            raise InputError(at + f"blades must be 0 (round) or 3 to 64, got {self.blades}")

    @staticmethod
    def look_at(position: Any, target: Any, up: Any = (0.0, 1.0, 0.0), **rest: Any) -> Camera:
        """A camera at `position` that looks at `target`; `rest` are the other fields."""
        origin, aim, upward = (np.array(as_vector(v, n)) for v, n in ((position, "position"), (target, "target"), (up, "up")))
        z = origin - aim
        if not np.linalg.norm(z) > 0.0:
            raise InputError("camera: position and target are the same point")
        z /= np.linalg.norm(z)
        x = np.cross(upward, z)
        if np.linalg.norm(x) < 1e-9 * max(float(np.linalg.norm(upward)), 1e-300):
            raise InputError("camera: up is parallel to the direction of view")
        x /= np.linalg.norm(x)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = x, np.cross(z, x), z, origin
        return Camera(camera_to_world=matrix, **rest)

    @staticmethod
    def lens(focal_length: float, focus_distance: float, sensor_height: float, *, f_number: float | None = None,
             aperture_radius: float | None = None) -> dict[str, float]:
        """fov_y, aperture_radius and focus_distance of a real thin lens, all lengths in scene units.

        The sensor stands where the lens makes `focus_distance` sharp, s' = f s / (s - f), so that focusing near narrows
        the view a little, as in a real camera. f_number N gives the radius f / (2 N).
        """
        f = as_number(focal_length, "focal_length", low=SMALLEST)
        s = as_number(focus_distance, "focus_distance", low=SMALLEST)
        h = as_number(sensor_height, "sensor_height", low=SMALLEST)
        if s <= f:
            raise InputError(f"focus_distance ({s:g}) must be longer than focal_length ({f:g})")
        if (f_number is None) == (aperture_radius is None):
            raise InputError("give either f_number or aperture_radius")
        radius = aperture_radius if f_number is None else f / (2.0 * as_number(f_number, "f_number", low=1e-3))
        image_distance = f * s / (s - f)
        return {"fov_y": 2.0 * math.atan(0.5 * h / image_distance), "focus_distance": s,
                "aperture_radius": as_number(radius, "aperture_radius", low=0.0)}
