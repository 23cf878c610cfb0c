"""The kernels that make pictures: camera, integrator, film."""

import warp as wp

from wrt.kernels.shade.camera import chief_ray, make_camera_ray
from wrt.kernels.shade.loop import make_radiance
from wrt.kernels.shade.sampling import hash_pair, make_sample_2d
from wrt.kernels.shade.shading import make_cutout, make_shading
from wrt.kernels.structs import AovFilm, Camera, Film, Lighting, Limits, Surfaces, Tile, kernel, make_ray


@wp.func
def filter_offset(icdf: wp.array(dtype=wp.float32), x: float) -> float:
    """Where a filter puts the sample x in [0, 1): its inverse distribution, in pixels from the pixel's centre."""
    position = x * float(icdf.shape[0] - 1)
    i = wp.min(int(position), icdf.shape[0] - 2)
    return wp.lerp(icdf[i], icdf[i + 1], position - float(i))


def make_traversals(features, structure):
    """closest_hit and any_hit of a structure (wrt.accel.structure.Structure); with cut-outs both look at each hit's alpha."""
    accepts = make_cutout(features) if features.cutout else None
    return structure.traversal(any_hit=False, accepts=accepts), structure.traversal(any_hit=True, accepts=accepts)


def make_render_kernel(features, structure):
    """A kernel that adds samples to the pixels of a tile; it holds only the code that `features` asks for.

    Where the structure's units count, it must be a wrt.kernels.study.ray_log one, and every ray is logged.
    """
    accel_struct = structure.struct
    closest_hit, any_hit = make_traversals(features, structure)
    sample_2d = make_sample_2d(features)
    camera_ray = make_camera_ray(features.lens, features.blades)
    counting = structure.units.counters
    radiance = make_radiance(features, accel_struct, closest_hit, any_hit, counting)

    @kernel
    def render(
        accel: accel_struct,
        surfaces: Surfaces,
        lighting: Lighting,
        camera: Camera,
        limits: Limits,
        film: Film,
        tile: Tile,
    ):
        tid = wp.tid()
        if wp.static(counting):
            accel.row = tid
        x = tile.x + tid % tile.width
        y = tile.y + tid / tile.width
        pixel = (y - film.y) * film.columns + x - film.x
        key = hash_pair(hash_pair(limits.seed, wp.uint32(x)), wp.uint32(y))
        mean = film.mean[pixel]
        m2 = film.m2[pixel]
        n = film.samples[pixel]
        for i in range(tile.n_samples):
            index = wp.uint32(tile.first_sample + i)
            # The filter is sampled by importance, so that each sample has weight 1 and belongs to this pixel alone.
            xi = sample_2d(key, index, 0)
            offset = wp.vec2(xi[0] - 0.5, xi[1] - 0.5)
            if wp.static(features.filter):
                offset = wp.vec2(filter_offset(film.filter_icdf, xi[0]), filter_offset(film.filter_icdf, xi[1]))
            position = wp.vec2(
                (float(x) + 0.5 + offset[0]) / float(film.width), (float(y) + 0.5 + offset[1]) / float(film.height)
            )
            lens_xi = wp.vec2(0.0, 0.0)
            if wp.static(features.lens):
                lens_xi = sample_2d(key, index, 1)
            ray = camera_ray(camera, position, lens_xi)
            sample = radiance(accel, surfaces, lighting, limits, ray, key, index)
            color = sample.radiance
            if not wp.isfinite(color[0] + color[1] + color[2]):
                film.not_finite[pixel] += 1
                color = wp.vec3(0.0, 0.0, 0.0)
            n = n + 1
            delta = color - mean
            mean = mean + delta / float(n)
            m2 = m2 + wp.cw_mul(delta, color - mean)
            film.rays[pixel] += wp.int64(sample.rays)
            film.cut_depth[pixel] += sample.cut_depth
            film.cut_throughput[pixel] += sample.cut_throughput
            film.lost[pixel] += sample.lost
        film.mean[pixel] = mean
        film.m2[pixel] = m2
        film.samples[pixel] = n

    return render


def make_aov_kernel(features, structure):
    """What the ray through each pixel's centre (and the lens' centre) meets first."""
    accel_struct = structure.struct
    closest_hit, _ = make_traversals(features, structure)
    surface_at, resolve, shading_normal, _, _ = make_shading(features)

    @kernel
    def aovs(accel: accel_struct, surfaces: Surfaces, camera: Camera, film: AovFilm, tile: Tile):
        tid = wp.tid()
        x = tile.x + tid % tile.width
        y = tile.y + tid / tile.width
        pixel = (y - film.y) * film.columns + x - film.x
        position = wp.vec2((float(x) + 0.5) / float(film.width), (float(y) + 0.5) / float(film.height))
        ray = make_ray(camera.origin, wp.normalize(chief_ray(camera, position)))
        hit = closest_hit(accel, surfaces, ray)
        film.depth[pixel] = hit.t
        film.prim_id[pixel] = hit.prim_id
        film.material_id[pixel] = -1
        if hit.prim_id >= 0:
            s = surface_at(surfaces, ray, hit)
            m = resolve(surfaces, s)
            film.normal[pixel] = shading_normal(surfaces, m, s, -ray.direction)
            film.albedo[pixel] = m.albedo
            film.material_id[pixel] = s.material

    return aovs
