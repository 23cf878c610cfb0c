"""Visibility by rays alone: what the ray through each pixel's centre hits, with no shading."""

from typing import Any

import warp as wp

from wrt.kernels.shade.cameras.perspective import Camera, make_camera_ray
from wrt.kernels.structs import Surfaces, Tile, kernel


def make_primary_rays_kernel(accel_struct: Any, closest_hit: Any) -> Any:
    """A kernel over the pixels of a tile, for a perspective camera; a miss has depth = inf and prim_id = -1."""
    camera_ray = make_camera_ray()

    @kernel
    def primary_rays(
        accel: accel_struct,
        surfaces: Surfaces,
        camera: Camera,
        tile: Tile,
        width: int,
        height: int,
        depth: wp.array(dtype=wp.float32),
        prim_id: wp.array(dtype=wp.int32),
    ):
        tid = wp.tid()
        x = tile.x + tid % tile.width
        y = tile.y + tid / tile.width
        position = wp.vec2((float(x) + 0.5) / float(width), (float(y) + 0.5) / float(height))
        ray = camera_ray(camera, position, wp.vec2(0.5, 0.5))
        hit = closest_hit(accel, surfaces, ray)
        depth[y * width + x] = hit.t
        prim_id[y * width + x] = hit.prim_id

    return primary_rays
