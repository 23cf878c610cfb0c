"""One ray at a time: a loop around the integrator's step that traces what it asks for. Pending paths wait on a small stack."""

from typing import Any

import warp as wp

from wrt.kernels.shade.backgrounds import make_background
from wrt.kernels.shade.direct import make_light_points
from wrt.kernels.shade.film import Pixel, center_of, load_pixel, make_see, store_pixel, with_sample
from wrt.kernels.shade.sampling import hash_pair, make_sample_2d, quantile
from wrt.kernels.shade.shading import make_cutout, make_shading
from wrt.kernels.shade.shadows import Shadow, make_transmittance
from wrt.kernels.shade.step import Lit, Sample, add_up, counted, is_lit, lit_by, make_shaded, make_step
from wrt.kernels.structs import AovFilm, Film, Hit, Lighting, Limits, Ray, Surfaces, Tile, any_positive, kernel


def make_direct_light(features: Any, accel_struct: Any, transmittance: Any, step: Any, counting: bool = False) -> Any:
    """Light straight from every light (and the background) by one shadow ray each."""
    Shaded = make_shaded(counting)
    choose, shadow_request, extra_lights = step.choose, step.shadow_request, step.extra_lights
    light_point = make_light_points(features).point

    @wp.func
    def direct_light(accel: accel_struct, surfaces: Surfaces, lighting: Lighting, shaded: Shaded, index: wp.uint32) -> Shadow:
        """As `add_up` takes it. cut: shadow rays that were, and lost: the light they were worth in a room of radiance 1."""
        out = Shadow()
        for i in range(lighting.count + wp.static(extra_lights)):
            point = light_point(lighting, shaded.key, index, i)
            request = shadow_request(shaded, choose(lighting, surfaces, i, shaded.surface, point))
            if any_positive(request.value):
                out = lit_by(out, request.value, shaded.scatter, transmittance(accel, surfaces, request.ray, request.end))
        return out

    return direct_light


def make_radiance(features: Any, accel_struct: Any, closest_hit: Any, any_hit: Any, counting: bool = False) -> Any:
    """The whole tree of rays behind one camera ray. `features`: wrt.renderer.features.Features; counting: rays carry a label."""
    shading = make_shading(features)
    step = make_step(features, shading, counting)
    surface_at, look_up, shading_normal = shading.surface_at, shading.look_up, shading.shading_normal
    Path, first_path, ray_of, shade, keep, worth = step.Path, step.first_path, step.ray_of, step.shade, step.keep, step.worth
    choose_facet = step.choose_facet
    background_radiance = make_background(features)
    transmittance = make_transmittance(features, shading, accel_struct, closest_hit, any_hit)
    direct_light = make_direct_light(features, accel_struct, transmittance, step, counting)

    @wp.func
    def radiance(
        accel: accel_struct, surfaces: Surfaces, lighting: Lighting, limits: Limits, camera_ray: Ray, key: wp.uint32,
        index: wp.uint32,
    ) -> Sample:
        out = Sample()
        stack = wp.zeros(shape=wp.static(features.stack_size), dtype=Path)
        stack[0] = first_path(camera_ray, key)
        size = int(1)
        traced = int(0)
        while size > 0:
            size = size - 1
            path = stack[size]
            ray = ray_of(path)
            out.rays += 1
            traced += 1
            hit = closest_hit(accel, surfaces, ray)
            if hit.prim_id < 0:
                out.radiance += wp.cw_mul(path.throughput, background_radiance(lighting.background, path.direction))
                continue
            met = surface_at(surfaces, ray, hit)
            texels = look_up(surfaces, met)
            met.shading = shading_normal(surfaces, met, texels, -path.direction)
            shaded = shade(surfaces, lighting, path, met, texels, hit.t, choose_facet(path.key, index))
            lit = Lit()
            lit.light = shaded.light
            lit.throughput = shaded.throughput
            if wp.static(features.blend):
                verdict = keep(shaded.onward, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.onward
                    size = size + 1
                out = counted(out, verdict)
                out.lost += worth(surfaces, shaded.onward, verdict)
            if wp.static(features.reflection):
                verdict = keep(shaded.reflected, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.reflected
                    size = size + 1
                out = counted(out, verdict)
                lit.reflected = worth(surfaces, shaded.reflected, verdict)
            if wp.static(features.refraction):
                verdict = keep(shaded.refracted, limits, traced)
                if verdict == 1:
                    stack[size] = shaded.refracted
                    size = size + 1
                out = counted(out, verdict)
                lit.refracted = worth(surfaces, shaded.refracted, verdict)
            direct = Shadow()
            if wp.static(features.lit):
                if is_lit(shaded.scatter):
                    direct = direct_light(accel, surfaces, lighting, shaded, index)
            out = add_up(out, lit, direct)
        return out

    return radiance


def make_traversals(features: Any, structure: Any) -> Any:
    """closest_hit and any_hit of a structure (wrt.accel.structure.Structure); with cut-outs both look at each hit's alpha."""
    accepts = make_cutout(features)
    return structure.traversal(any_hit=False, accepts=accepts), structure.traversal(any_hit=True, accepts=accepts)


def make_camera_sample(features: Any, camera_kind: Any) -> Any:
    """The ray of one sample of a pixel."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray(features)

    @wp.func
    def camera_sample(camera: camera_struct, film: Film, x: int, y: int, xi: wp.vec2, lens_xi: wp.vec2) -> Ray:
        # The filter is sampled by importance, so that each sample has weight 1 and belongs to this pixel alone.
        offset = wp.vec2(xi[0] - 0.5, xi[1] - 0.5)
        if wp.static(features.filter):
            offset = wp.vec2(quantile(film.filter_icdf, xi[0]), quantile(film.filter_icdf, xi[1]))
        position = wp.vec2((float(x) + 0.5 + offset[0]) / float(film.width), (float(y) + 0.5 + offset[1]) / float(film.height))
        return camera_ray(camera, position, lens_xi)

    return camera_sample


def make_render_kernel(features: Any, structure: Any, camera_kind: Any) -> Any:
    """A kernel that adds samples to the pixels of a tile, or, with a thread for each sample, writes them to `samples`, pixel by
    pixel, for add_samples. It holds only the code that `features` asks for.

    camera_kind: a module as wrt.kernels.shade.cameras says.
    Where the structure's units count, it must be a wrt.kernels.study.ray_log one, and every ray is logged.
    """
    accel_struct = structure.struct
    closest_hit, any_hit = make_traversals(features, structure)
    camera_struct = camera_kind.Camera
    camera_sample = make_camera_sample(features, camera_kind)
    sample_2d = make_sample_2d(features)
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
        samples: wp.array(dtype=Sample),
    ):
        tid = wp.tid()
        if wp.static(counting):
            accel.row = tid
        x = tile.x + tid / tile.threads % tile.width
        y = tile.y + tid / tile.threads / tile.width
        at = (y - film.y) * film.columns + x - film.x
        key = hash_pair(hash_pair(limits.seed, wp.uint32(x)), wp.uint32(y))
        pixel = Pixel()
        if tile.threads == 1:
            pixel = load_pixel(film, at)
        for i in range(tid % tile.threads, tile.n_samples, tile.threads):
            index = wp.uint32(tile.first_sample + i)
            lens_xi = wp.vec2(0.0, 0.0)
            if wp.static(features.lens):
                lens_xi = sample_2d(key, index, 1)
            ray = camera_sample(camera, film, x, y, sample_2d(key, index, 0), lens_xi)
            sample = Sample()
            if ray.t_max > 0.0:  # else the film gets no light here
                sample = radiance(accel, surfaces, lighting, limits, ray, key, index)
            if tile.threads > 1:
                samples[tid] = sample
            else:
                pixel = with_sample(pixel, sample)
        if tile.threads == 1:
            store_pixel(film, at, pixel)

    return render


@kernel
def add_samples(film: Film, tile: Tile, samples: wp.array(dtype=Sample)):
    """What a thread for each sample wrote, to the pixels of a tile, in the samples' order."""
    tid = wp.tid()
    at = (tile.y + tid / tile.width - film.y) * film.columns + tile.x + tid % tile.width - film.x
    pixel = load_pixel(film, at)
    for i in range(tile.n_samples):
        pixel = with_sample(pixel, samples[tid * tile.n_samples + i])
    store_pixel(film, at, pixel)


def make_aov_kernel(features: Any, structure: Any, camera_kind: Any) -> Any:
    """What the ray through each pixel's centre (and the lens' centre) meets first."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray()
    accel_struct = structure.struct
    closest_hit, _ = make_traversals(features, structure)
    see = make_see(features)

    @kernel
    def aovs(accel: accel_struct, surfaces: Surfaces, camera: camera_struct, film: AovFilm, tile: Tile):
        tid = wp.tid()
        x = tile.x + tid % tile.width
        y = tile.y + tid / tile.width
        ray = camera_ray(camera, center_of(x, y, film.width, film.height), wp.vec2(0.5, 0.5))
        hit = Hit()
        hit.t = float(wp.inf)
        hit.prim_id = -1
        if ray.t_max > 0.0:
            hit = closest_hit(accel, surfaces, ray)
        see(film, (y - film.y) * film.columns + x - film.x, surfaces, ray, hit)

    return aovs
