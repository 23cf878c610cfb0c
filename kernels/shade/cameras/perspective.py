"""Perspective projection through a pinhole, or through a thin lens with a round or polygonal aperture."""

from typing import Any

import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import disk, polygon
from wrt.kernels.structs import Ray, lift, make_ray, unit


@wp.struct
class Camera:
    """The rays through the picture's corners have the directions `forward +- tan_x * right +- tan_y * up`."""

    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    tan_x: float
    tan_y: float
    focus_distance: float  # Distance along the axis to the plane in focus.
    aperture_radius: float
    blades: int  # Number of straight sides of the aperture; 0: round.
    blade_rotation: float  # In radians.


@wp.func
def chief_ray(camera: Camera, film: wp.vec2) -> wp.vec3:
    """Return the direction of the ray through the lens' centre, not normalised: its `forward` component is 1."""
    x = (2.0 * film[0] - 1.0) * camera.tan_x
    y = (1.0 - 2.0 * film[1]) * camera.tan_y
    return camera.forward + x * camera.right + y * camera.up


def make_camera_ray(features: Features | None = None) -> Any:
    lens = features is not None and features.lens
    blades = features is not None and features.lens and features.blades

    @wp.func
    def camera_ray(camera: Camera, film: wp.vec2, xi: wp.vec2) -> Ray:
        """Return the ray through the film point and the lens sample.

        All rays of one film point cross at a point S of the plane in focus. The lens does not bend the chief ray, so that S is on
        it, at the distance focus_distance along the axis. The ray goes from the lens sample to S."""
        chief = chief_ray(camera, film)
        ray = make_ray(camera.origin, unit(chief))
        if wp.static(lens):
            sample = disk(xi)
            if wp.static(blades):
                sample = polygon(xi, camera.blades, camera.blade_rotation)
            offset = camera.aperture_radius * (sample[0] * camera.right + sample[1] * camera.up)
            ray.origin = camera.origin + offset
            to_focus = camera.focus_distance * chief - offset
            ray.direction = unit(lift(to_focus) * to_focus)
        return ray

    return camera_ray
