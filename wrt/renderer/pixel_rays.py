"""The camera rays of a picture as arrays, for ray queries."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import warp as wp

from wrt.accel.queries.rays import to_origin
from wrt.core.checks import as_one, as_size
from wrt.core.device import launch, made_once, start, upload
from wrt.kernels.shade.cameras import make_camera_rays_kernel
from wrt.renderer.upload import camera_struct
from wrt.scene.cameras import CameraKind
from wrt.scene.size import moved_camera
from wrt.scene.values import type_of

camera_rays_kernel = made_once(make_camera_rays_kernel)


def camera_rays(camera: CameraKind, size: tuple[int, int] | str) -> tuple[np.ndarray, np.ndarray]:
    """Make one ray for each pixel, through the centres of the lens and of the pixel. The AOVs of a Film come from the same rays.

    Parameters
    ----------
    camera
        A camera of any kind.
    size
        Width and height of the picture, or text such as "640x360".

    Returns
    -------
    origins, directions
        (width * height, 3) float32 each, in world space, row by row from the top left. Origins farther than 1,024 from 0 are float64, if
        float32 would round them. Directions have unit length, so that a hit's t is the AOV "depth". Beyond the image circle of a
        fisheye, directions are 0.
    """
    width, height = as_size(size)
    x = (np.arange(width, dtype=np.float32) + np.float32(0.5)) / np.float32(width)
    y = (np.arange(height, dtype=np.float32) + np.float32(0.5)) / np.float32(height)
    film = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
    return film_rays(camera, (width, height), film.reshape(-1, 2))


def film_rays(camera: CameraKind, size: tuple[int, int], film: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Make rays through the points `film` (N, 2) of a picture; its top left corner is (0, 0), its bottom right corner (1, 1)."""
    device = start("cpu")
    kernel = camera_rays_kernel(import_module(as_one(camera, CameraKind, "camera").device))
    place = camera.camera_to_world[:3, 3]
    far = place if type_of(place) is np.float64 else None
    camera = moved_camera(camera, far)
    origins, directions = (wp.empty(len(film), dtype=wp.vec3, device=device) for _ in range(2))
    launch(kernel, len(film), camera_struct(camera, size), upload(film, wp.vec2, device), origins, directions)
    return to_origin(origins.numpy(), far), directions.numpy()
