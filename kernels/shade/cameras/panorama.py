"""Equirectangular panorama of all directions around one point: columns are longitudes, lines are latitudes."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import sin_cos
from wrt.kernels.shade.features import Features
from wrt.kernels.structs import Ray, make_ray


@wp.struct
class Camera:
    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3


@wp.func
def camera_ray(camera: Camera, film: wp.vec2, xi: wp.vec2) -> Ray:
    """Return a ray: the middle column looks along `forward`, the right half to the right, the upper edge to `up`.

    For a camera that looks along -z, with +y up, this is the layout of an environment background."""
    longitude = wp.TAU * (film[0] - 0.5)
    colatitude = wp.PI * film[1]
    sin, cos = sin_cos(longitude)
    level = sin * camera.right + cos * camera.forward
    sin_down, cos_down = sin_cos(colatitude)
    return make_ray(camera.origin, wp.normalize(sin_down * level + cos_down * camera.up))


def make_camera_ray(features: Features | None = None) -> Any:
    return camera_ray
