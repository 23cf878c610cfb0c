"""Camera kinds. Each kind is a module with a struct `Camera` and a function `make_camera_ray(features=None)`.

Camera is a Warp struct that begins with origin, right, up and forward, in world space; right, up and forward are orthonormal. The
host's class of the same kind (wrt/scene/cameras.py) sets the other fields in its method `record`.

make_camera_ray returns a Warp function (camera, film, xi) -> Ray. The ray is in world space and has a unit direction:
- Film point (0, 0) is the picture's top left corner, (1, 1) the bottom right corner. Pixel filters reach a little beyond [0, 1]^2.
- The lens sample xi lies in [0, 1)^2. It is 0 unless features.lens is set.
- With features = None, the ray goes through the middle of the lens.
- At film points that get no light, the function returns no_ray()."""

from typing import Any

import warp as wp

from wrt.kernels.structs import Ray, kernel, make_ray


@wp.func
def no_ray() -> Ray:
    """Return the ray of a film point that gets no light: t_max = -1 and direction 0."""
    ray = make_ray(wp.vec3(0.0, 0.0, 0.0), wp.vec3(0.0, 0.0, 0.0))
    ray.t_max = -1.0
    return ray


def make_camera_rays_kernel(camera_kind: Any) -> Any:
    """Return the kernel that writes origin and unit direction of the ray through each film point and the middle of the lens.

    The direction is 0 at film points that get no light. kernels/shade/cameras describes the module `camera_kind`."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray()

    @kernel
    def camera_rays(
        camera: camera_struct,
        film: wp.array(dtype=wp.vec2),
        origins: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
    ):
        tid = wp.tid()
        ray = camera_ray(camera, film[tid], wp.vec2(0.5, 0.5))
        origins[tid] = ray.origin
        directions[tid] = ray.direction

    return camera_rays
