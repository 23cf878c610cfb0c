"""A camera: columns are angles, lines are heights on a cylinder."""

import math
from dataclasses import dataclass, field

import warp as wp

from wrt.kernels.structs import Ray, make_ray
from wrt.scene.cameras import CAMERAS, CameraKind
from wrt.scene.kinds import given


@wp.struct
class Camera:
    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    half_angle: float
    half_height: float


@wp.func
def camera_ray(camera: Camera, film: wp.vec2, xi: wp.vec2) -> Ray:
    angle = (2.0 * film[0] - 1.0) * camera.half_angle
    height = (1.0 - 2.0 * film[1]) * camera.half_height
    around = wp.cos(angle) * camera.forward + wp.sin(angle) * camera.right
    return make_ray(camera.origin, wp.normalize(around + height * camera.up))


def make_camera_ray(features=None):
    return camera_ray


@dataclass(frozen=True, eq=False)
class CylinderCamera(CameraKind):
    """A picture on a cylinder around the camera."""

    kind = "cylinder"
    device = __name__

    fov_x: float = field(default=math.pi, metadata=given("angle", "from the left edge to the right one", ge=1.0, le=360.0))

    def record(self, size):
        return {"half_angle": 0.5 * self.fov_x, "half_height": 0.5 * self.fov_x * size[1] / size[0]}


CAMERAS[CylinderCamera.kind] = CylinderCamera
