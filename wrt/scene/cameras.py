"""Cameras: one class and one entry of CAMERAS for each kind."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypedDict, Unpack

import numpy as np

from wrt.core.checks import at_thing
from wrt.core.errors import InputError, wrong
from wrt.core.types import ArrayLike
from wrt.scene.kinds import Record, check_fields, forms, given
from wrt.scene.values import SMALLEST, as_number, as_transform, as_vector


@dataclass(frozen=True, eq=False)
class CameraKind:
    """Base class of cameras: a pose and a name.

    camera_to_world: (4, 4) rotation and translation; a camera looks along its own -z, +y is up. A subclass adds its parameters as
    fields, each with `field(metadata=given(...))` (wrt.scene.kinds.given)."""

    kind: ClassVar[str]  # name in scene files
    device: ClassVar[str]  # module of the kind's device functions; wrt.kernels.shade.cameras says which it needs

    camera_to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    name: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        at = at_thing("camera", self.name)
        matrix = as_transform(self.camera_to_world, at + "camera_to_world").copy()
        # Scale and shear are dropped: they would distort the picture, and glTF says that a camera ignores them.
        z = matrix[:3, 2]
        x = np.cross(matrix[:3, 1], z)
        if not np.linalg.norm(x) > 0.0:
            raise wrong(at + "camera_to_world", "must be invertible")
        z = z / np.linalg.norm(z)
        x = x / np.linalg.norm(x)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = x, np.cross(z, x), z
        object.__setattr__(self, "camera_to_world", matrix)
        check_fields(self, at)

    def as_in_files(self) -> dict[str, float]:
        """Return the camera's parameters by name, in the units of scene files: angles in degrees."""
        values = {key: (getattr(self, key), each.metadata["form"]) for key, each in forms(type(self)).items()}
        return {key: math.degrees(value) if form == "angle" else value for key, (value, form) in values.items()}

    @classmethod
    def posed(cls, matrix: np.ndarray, **fields: Any) -> Self:
        """Return a camera with the pose `matrix`, (4, 4). If it is a rotation to within 1e-14, it keeps its bits, as `Scene.save` needs.

        Raises InputError as the constructor."""
        camera = cls(matrix, **fields)
        if np.abs(camera.camera_to_world - matrix).max() <= 1e-14:
            object.__setattr__(camera, "camera_to_world", np.array(matrix, np.float64))
        return camera

    @classmethod
    def look_at(cls, position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 1.0, 0.0), **fields: Any) -> Self:
        """Return a camera at `position` that looks at `target`.

        Parameters
        ----------
        position, target, up
            (3,) each, in world space; `up` is any vector that appears upright in the picture.
        **fields
            The other fields of the class, such as fov_y.

        Raises
        ------
        InputError
            If position and target are equal, or `up` is zero or parallel to the viewing direction.

        Examples
        --------
        >>> camera = wrt.Camera.look_at((0, 1, 5), (0, 0, 0), fov_y=math.radians(40))
        """
        origin, aim, upward = (np.array(as_vector(v, n)) for v, n in ((position, "position"), (target, "target"), (up, "up")))
        z = origin - aim
        if not np.linalg.norm(z) > 0.0:
            raise InputError("must differ from position, but is the same point", argument="target", place="camera")
        z /= np.linalg.norm(z)
        x = np.cross(upward, z)
        if np.linalg.norm(x) < 1e-9 * max(float(np.linalg.norm(upward)), 1e-300):
            raise InputError("must not be zero or parallel to the viewing direction", argument="up", place="camera")
        x /= np.linalg.norm(x)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = x, np.cross(z, x), z, origin
        return cls(camera_to_world=matrix, **fields)

    def record(self, size: tuple[int, int]) -> Record:
        """Return the fields of the camera's device struct, except the pose. size: width and height of the picture in pixels."""
        return {}

    def switches(self) -> dict[str, bool]:
        """Return the kernel features that depend on the camera, by name. For example "lens": True if rays start at points of a lens."""
        return {}

    def opened(self) -> Self:
        """Return a copy that has a lens, if the kind can have one. A viewer then opens and closes the aperture without compiling."""
        return self


class CameraFields(TypedDict, total=False):
    """Keywords of `Camera.look_at`: the fields of Camera."""

    fov_y: float
    aperture_radius: float
    focus_distance: float
    blades: int
    blade_rotation: float
    least_fov_x: float
    name: str


@dataclass(frozen=True, eq=False)
class Camera(CameraKind):
    """A pinhole camera, or a thin lens if the aperture is larger than 0.

    `Camera.look_at` places one; `Camera.lens` computes fov_y, aperture_radius and focus_distance from the data of a real lens.

    camera_to_world is a (4, 4) rotation and translation: the camera looks along its own -z, +y is up; scale and shear are dropped.
    Angles are in radians, lengths in scene units."""

    kind = "perspective"
    device = "wrt.kernels.shade.cameras.perspective"

    fov_y: float = field(default=math.pi / 4.0, metadata=given("angle", "full vertical angle of view", ge=0.0005, le=179.94))
    aperture_radius: float = field(default=0.0, metadata=given("number", "radius of the aperture; 0: a pinhole", "length", ge=0.0))
    focus_distance: float = field(default=1.0, metadata=given(
        "number", "distance along the axis to the plane in focus (default: the target's distance, else 1)", "length", ge=SMALLEST))
    blades: int = field(default=0, metadata=given("whole", "sides of the aperture, 3 or more; 0: round", ge=0, le=64))
    blade_rotation: float = field(default=0.0, metadata=given("angle", "rotation of the aperture"))
    least_fov_x: float = field(default=0.0, metadata=given(
        "angle", "least horizontal angle of view: a picture too narrow for it widens fov_y", ge=0.0, le=179.94))

    if TYPE_CHECKING:  # editors complete the keywords

        @classmethod
        def look_at(cls, position: ArrayLike, target: ArrayLike, up: ArrayLike = ...,  # type: ignore[override]
                    **fields: Unpack[CameraFields]) -> Self: ...

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blades in (1, 2):
            raise wrong(at_thing("camera", self.name) + "blades", f"must be 0 (round) or 3 to 64, got {self.blades}")

    def record(self, size: tuple[int, int]) -> Record:
        tan_y = max(float(np.tan(0.5 * self.fov_y)), float(np.tan(0.5 * self.least_fov_x)) * size[1] / size[0])
        return {"tan_y": tan_y, "tan_x": tan_y * size[0] / size[1], "focus_distance": self.focus_distance,
                "aperture_radius": self.aperture_radius, "blades": self.blades, "blade_rotation": self.blade_rotation}

    def switches(self) -> dict[str, bool]:
        lens = self.aperture_radius > 0.0
        return {"lens": lens, "blades": lens and self.blades > 0}

    def opened(self) -> Self:
        return replace(self, aperture_radius=self.aperture_radius or 1.0)

    @staticmethod
    def lens(focal_length: float, focus_distance: float, sensor_height: float, *, f_number: float | None = None,
             aperture_radius: float | None = None) -> dict[str, float]:
        """Return fov_y, aperture_radius and focus_distance of a real thin lens, all lengths in scene units.

        With f = focal_length and s = focus_distance, the sensor is f s / (s - f) behind the lens. Focusing near therefore narrows the
        view, as in a real camera. The aperture's radius is f / (2 f_number). Raises InputError unless focus_distance exceeds
        focal_length, and unless exactly one of f_number and aperture_radius is given."""
        f = as_number(focal_length, "focal_length", low=SMALLEST)
        s = as_number(focus_distance, "focus_distance", low=SMALLEST)
        h = as_number(sensor_height, "sensor_height", low=SMALLEST)
        if s <= f:
            raise InputError(f"must be longer than focal_length ({f:g}), got {s:g}", argument="focus_distance")
        if (f_number is None) == (aperture_radius is None):
            raise InputError("give exactly one of f_number and aperture_radius", argument="f_number")
        radius = aperture_radius if f_number is None else f / (2.0 * as_number(f_number, "f_number", low=1e-3))
        image_distance = f * s / (s - f)
        return {"fov_y": 2.0 * math.atan(0.5 * h / image_distance), "focus_distance": s,
                "aperture_radius": as_number(radius, "aperture_radius", low=0.0)}


@dataclass(frozen=True, eq=False)
class OrthographicCamera(CameraKind):
    """Parallel rays that start at the plane through the camera.

    height: extent of the view from the lower to the upper edge of the picture, in scene units; the width follows from the aspect ratio."""

    kind = "orthographic"
    device = "wrt.kernels.shade.cameras.orthographic"

    height: float = field(default=2.0, metadata=given(
        "number", "extent of the view from the lower to the upper edge", "length", ge=SMALLEST))

    def record(self, size: tuple[int, int]) -> Record:
        return {"half_width": 0.5 * self.height * size[0] / size[1], "half_height": 0.5 * self.height}


@dataclass(frozen=True, eq=False)
class FisheyeCamera(CameraKind):
    """An equidistant fisheye; black beyond the image circle, whose diameter is the shorter side of the picture.

    A ray's angle to the camera's axis is proportional to its pixel's distance from the centre of the picture. fov: full angle of view
    across the image circle, in radians."""

    kind = "fisheye"
    device = "wrt.kernels.shade.cameras.fisheye"

    fov: float = field(default=math.pi, metadata=given(
        "angle", "full angle of view across the image circle", ge=0.0005, le=360.0))

    def record(self, size: tuple[int, int]) -> Record:
        """Return half the angle of view, and half the picture's width and height in units of the image circle's radius."""
        return {"half_angle": 0.5 * self.fov, "half_width": size[0] / min(size), "half_height": size[1] / min(size)}


@dataclass(frozen=True, eq=False)
class PanoramaCamera(CameraKind):
    """All directions around a point, equirectangular, with the camera's axis in the middle of the picture.

    A picture of aspect ratio 2:1 can serve as the image of an EnvironmentBackground."""

    kind = "panorama"
    device = "wrt.kernels.shade.cameras.panorama"


# To add a kind: CAMERAS[Mine.kind] = Mine.
CAMERAS: dict[str, type[CameraKind]] = {each.kind: each for each in (Camera, OrthographicCamera, FisheyeCamera, PanoramaCamera)}

