"""An equidistant fisheye: the angle to the axis grows in proportion to the distance from the picture's centre."""

from typing import Any

import warp as wp

from wrt.kernels.shade.cameras import no_ray
from wrt.kernels.shade.elementary import sin_cos
from wrt.kernels.shade.features import Features
from wrt.kernels.structs import Ray, make_ray


@wp.struct
class Camera:
    """A fisheye camera. The unit of length on the film is the radius of the image circle."""

    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    half_angle: float  # Angle between the axis and the rays at the edge of the image circle, in radians.
    half_width: float  # Half the width of the picture, in radii of the image circle.
    half_height: float  # Half the height, in the same unit.


@wp.func
def camera_ray(camera: Camera, film: wp.vec2, xi: wp.vec2) -> Ray:
    """Return the ray of a film point, or no_ray() beyond the image circle."""
    x = (2.0 * film[0] - 1.0) * camera.half_width
    y = (1.0 - 2.0 * film[1]) * camera.half_height
    radius = wp.sqrt(x * x + y * y)
    if radius > 1.0:
        return no_ray()
    sin, cos = sin_cos(radius * camera.half_angle)
    aside = 0.0
    if radius > 0.0:
        aside = sin / radius
    direction = cos * camera.forward + aside * (x * camera.right + y * camera.up)
    return make_ray(camera.origin, wp.normalize(direction))


def make_camera_ray(features: Features | None = None) -> Any:
    return camera_ray
