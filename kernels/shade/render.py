"""The kernels that make pictures: camera, integrator, film."""

import warp as wp

from wrt.kernels.shade.loop import make_radiance
from wrt.kernels.shade.sampling import hash_pair, make_sample_2d
from wrt.kernels.shade.shading import make_cutout, make_shading
from wrt.kernels.shade.step import Sample
from wrt.kernels.structs import AovFilm, Film, Lighting, Limits, Surfaces, Tile, kernel


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


def make_render_kernel(features, structure, camera_kind):
    """A kernel that adds samples to the pixels of a tile; it holds only the code that `features` asks for.

    camera_kind: a module as wrt.kernels.shade.cameras says.
    Where the structure's units count, it must be a wrt.kernels.study.ray_log one, and every ray is logged.
    """
    accel_struct = structure.struct
    closest_hit, any_hit = make_traversals(features, structure)
    sample_2d = make_sample_2d(features)
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray(features)
    counting = structure.units.counters
    radiance = make_radiance(features, accel_struct, closest_hit, any_hit, counting)

    @kernel
    def render(
        accel: accel_struct,
        surfaces: Surfaces,
        lighting: Lighting,
        camera: camera_struct,
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
            sample = Sample()
            if ray.t_max > 0.0:  # else the film gets no light here
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


def make_aov_kernel(features, structure, camera_kind):
    """What the ray through each pixel's centre (and the lens' centre) meets first."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray()
    accel_struct = structure.struct
    closest_hit, _ = make_traversals(features, structure)
    surface_at, resolve, shading_normal, _, _ = make_shading(features)

    @kernel
    def aovs(accel: accel_struct, surfaces: Surfaces, camera: camera_struct, film: AovFilm, tile: Tile):
        tid = wp.tid()
        x = tile.x + tid % tile.width
        y = tile.y + tid / tile.width
        pixel = (y - film.y) * film.columns + x - film.x
        position = wp.vec2((float(x) + 0.5) / float(film.width), (float(y) + 0.5) / float(film.height))
        ray = camera_ray(camera, position, wp.vec2(0.5, 0.5))
        film.depth[pixel] = float(wp.inf)
        film.prim_id[pixel] = -1
        film.material_id[pixel] = -1
        if ray.t_max < 0.0:
            return
        hit = closest_hit(accel, surfaces, ray)
        film.depth[pixel] = hit.t
        film.prim_id[pixel] = hit.prim_id
        if hit.prim_id >= 0:
            s = surface_at(surfaces, ray, hit)
            m = resolve(surfaces, s)
            film.normal[pixel] = shading_normal(surfaces, m, s, -ray.direction)
            film.albedo[pixel] = m.albedo
            film.material_id[pixel] = s.material

    return aovs
