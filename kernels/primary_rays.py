"""Visibility by rays alone: what the ray through each pixel's centre hits, with no shading."""

import warp as wp

from wrt.kernels.camera import chief_ray
from wrt.kernels.structs import Camera, Ray, Surfaces, Tile, kernel


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
        ray = Ray()
        ray.origin = camera.origin
        position = wp.vec2((float(x) + 0.5) / float(width), (float(y) + 0.5) / float(height))
        ray.direction = wp.normalize(chief_ray(camera, position))
        ray.t_min = 0.0
        ray.t_max = float(wp.inf)
        ray.exclude = -1
        hit = closest_hit(accel, surfaces, ray)
        depth[y * width + x] = hit.t
        prim_id[y * width + x] = hit.prim_id

    return primary_rays
