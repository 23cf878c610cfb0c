"""Visibility by rays alone: what the ray through each pixel's centre hits, with no shading."""

import warp as wp

from wrt.kernels.shade.camera import chief_ray
from wrt.kernels.structs import Camera, Surfaces, Tile, kernel, make_ray


def make_primary_rays_kernel(accel_struct, closest_hit):
    """A kernel over the pixels of a tile; a miss has depth = inf and prim_id = -1."""

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
        ray = make_ray(camera.origin, wp.normalize(chief_ray(camera, position)))
        hit = closest_hit(accel, surfaces, ray)
        depth[y * width + x] = hit.t
        prim_id[y * width + x] = hit.prim_id

    return primary_rays
