"""Orthographic projection: all rays are parallel to `forward`."""

from typing import Any

import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.structs import Ray, make_ray


@wp.struct
class Camera:
    """The picture spans `origin +- half_width * right +- half_height * up`."""

    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    half_width: float
    half_height: float


@wp.func
def camera_ray(camera: Camera, film: wp.vec2, xi: wp.vec2) -> Ray:
    """Return a ray along `forward` from the plane through `origin`. Objects behind that plane are invisible."""
    x = (2.0 * film[0] - 1.0) * camera.half_width
    y = (1.0 - 2.0 * film[1]) * camera.half_height
    return make_ray(camera.origin + x * camera.right + y * camera.up, camera.forward)


def make_camera_ray(features: Features | None = None) -> Any:
    return camera_ray
