"""Where a picture is taken from, and how its points become rays: one class and one row of CAMERAS a kind."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from wrt.core.checks import at_thing
from wrt.core.errors import InputError
from wrt.scene.kinds import check_fields, forms, given
from wrt.scene.values import SMALLEST, as_number, as_transform, as_vector


@dataclass(frozen=True, eq=False)
class CameraKind:
    """What all cameras have: a pose, and a name.

    camera_to_world: (4, 4), rotation and translation; it looks along its own -z, +y is up. A kind adds its parameters as
    fields that are each `field(metadata=given(...))`, and says where its device function is.
    """

    kind: ClassVar[str]  # what scene files call it
    device: ClassVar[str]  # the module that wrt.kernels.shade.cameras describes

    camera_to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    name: str = field(default="", kw_only=True)

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
        check_fields(self, at)

    def as_in_files(self) -> dict[str, float]:
        """The parameters in the units of scene files."""
        values = {key: (getattr(self, key), each.metadata["form"]) for key, each in forms(type(self)).items()}
        return {key: math.degrees(value) if form == "angle" else value for key, (value, form) in values.items()}

    @classmethod
    def look_at(cls, position: Any, target: Any, up: Any = (0.0, 1.0, 0.0), **rest: Any) -> Self:
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
        return cls(camera_to_world=matrix, **rest)

    def record(self, size: tuple[int, int]) -> dict[str, Any]:
        """What the device's struct holds beside the pose, for a picture of so many pixels."""
        return {}

    def switches(self) -> dict[str, bool]:
        """The switches of wrt.renderer.features.Features that this camera decides: `lens`, where rays need a sample of a lens."""
        return {}

    def opened(self) -> Self:
        """This camera with every switch on: a renderer made for it can show all that a viewer may set."""
        return self


@dataclass(frozen=True, eq=False)
class Camera(CameraKind):
    """A pinhole, or a thin lens where it has an aperture.

    fov_y: full vertical angle of view (radians). focus_distance: along the axis, from the lens to the plane that is sharp. blades:
    0 for a round aperture, else the number of its straight sides (3 or more), turned by `blade_rotation` radians.
    `lens` gives fov_y, aperture_radius and focus_distance for a focal length, an f-number and a sensor height.
    """

    kind = "perspective"
    device = "wrt.kernels.shade.cameras.perspective"

    fov_y: float = field(default=math.pi / 4.0, metadata=given("angle", "full vertical angle of view", ge=0.0005, le=179.94))
    aperture_radius: float = field(default=0.0, metadata=given("number", "0 is a pinhole", "length", ge=0.0))
    focus_distance: float = field(default=1.0, metadata=given(
        "number", "along the axis to what is sharp (beside a target: by default as far as that)", "length", ge=SMALLEST))
    blades: int = field(default=0, metadata=given("whole", "0: a round aperture; from 3 on its number of sides", ge=0, le=64))
    blade_rotation: float = field(default=0.0, metadata=given("angle", "turns the aperture"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blades in (1, 2):
            raise InputError(at_thing("camera", self.name) + f"blades must be 0 (round) or 3 to 64, got {self.blades}")

    def record(self, size: tuple[int, int]) -> dict[str, Any]:
        """Tangents of half the angles of view, and the lens."""
        tan_y = float(np.tan(0.5 * self.fov_y))
        return {"tan_y": tan_y, "tan_x": tan_y * size[0] / size[1], "focus_distance": self.focus_distance,
                "aperture_radius": self.aperture_radius, "blades": self.blades, "blade_rotation": self.blade_rotation}

    def switches(self) -> dict[str, bool]:
        """A lens where there is an aperture, and blades where it has some."""
        lens = self.aperture_radius > 0.0
        return {"lens": lens, "blades": lens and self.blades > 0}

    def opened(self) -> Self:
        """With an aperture, where it has none."""
        return replace(self, aperture_radius=self.aperture_radius or 1.0)

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


@dataclass(frozen=True, eq=False)
class OrthographicCamera(CameraKind):
    """Parallel rays, from the plane through the camera on.

    height: of what the picture shows, from its lower to its upper edge (scene units); its width follows from the picture's size.
    """

    kind = "orthographic"
    device = "wrt.kernels.shade.cameras.orthographic"

    height: float = field(default=2.0, metadata=given(
        "number", "of what the picture shows, from its lower to its upper edge", "length", ge=SMALLEST))

    def record(self, size: tuple[int, int]) -> dict[str, Any]:
        """Half the sides of what the picture shows."""
        return {"half_width": 0.5 * self.height * size[0] / size[1], "half_height": 0.5 * self.height}


@dataclass(frozen=True, eq=False)
class FisheyeCamera(CameraKind):
    """An equidistant fisheye: angles to the axis are proportional to distances from the picture's middle; black beyond the circle.

    fov: full angle of view across the image circle (radians), whose diameter is the picture's shorter side.
    """

    kind = "fisheye"
    device = "wrt.kernels.shade.cameras.fisheye"

    fov: float = field(default=math.pi, metadata=given(
        "angle", "full angle of view across the image circle, which is as wide as the picture's shorter side", ge=0.0005, le=360.0))

    def record(self, size: tuple[int, int]) -> dict[str, Any]:
        """Half the angle of view, and half the picture's sides in radii of the image circle."""
        return {"half_angle": 0.5 * self.fov, "half_width": size[0] / min(size), "half_height": size[1] / min(size)}


@dataclass(frozen=True, eq=False)
class PanoramaCamera(CameraKind):
    """All directions around a point, equirectangular: the camera looks at its middle; its edges are behind, above and below.

    A picture twice as wide as high is an environment as backgrounds take it.
    """

    kind = "panorama"
    device = "wrt.kernels.shade.cameras.panorama"


# A kind of one's own is one more: CAMERAS[Mine.kind] = Mine.
CAMERAS: dict[str, type[CameraKind]] = {each.kind: each for each in (Camera, OrthographicCamera, FisheyeCamera, PanoramaCamera)}

