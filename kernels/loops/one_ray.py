"""One ray at a time: the render loop on CUDA, and on a CPU if rays are counted, logged or recorded.

A thread follows a camera ray and all rays that it causes. It traces a ray, shades the hit (shade/step.py), and pushes the new paths
on a small stack. A GPU hides the latency of one thread behind thousands of other threads. A CPU cannot, so wave.py traces and shades the
rays of many samples together. Both loops share the step and the follow-up, and take a sample's paths in the same order. So their films
have the same bits (tests/wrt/renderer/test_waves.py, tests/test_random_scenes.py)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.record import RAYS, PathEnd, record_end, record_light
from wrt.kernels.shade.backgrounds import BACKGROUNDS
from wrt.kernels.shade.direct import make_light_points
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.film import AovFilm, Film, Pixel, add_sample, load_pixel, make_write_aovs, pixel_center, store_pixel
from wrt.kernels.shade.follow_up import FOLLOWED, add_cuts, make_follow_up
from wrt.kernels.shade.paths import Path, camera_path, ray_of
from wrt.kernels.shade.sampling import hash_pair, make_sample_2d, quantile
from wrt.kernels.shade.shading import make_cutout, make_shading
from wrt.kernels.shade.shadows import Shadow, make_transmittance
from wrt.kernels.shade.step import DirectLight, Sample, Shaded, Step, add_light, add_surface_light, make_step, receives_light
from wrt.kernels.shade.surface import with_normal
from wrt.kernels.structs import Hit, Lighting, Limits, Ray, Surfaces, any_positive, kernel


@wp.struct
class Tile:
    """A rectangle of pixels, and the samples to add to each pixel."""

    x: int  # The left column in the picture.
    y: int  # The top line in the picture.
    width: int  # In pixels.
    first_sample: int  # Index of the first sample of each pixel.
    n_samples: int  # Number of samples of each pixel.
    threads: int  # Number of threads that share the samples of a pixel: 1 or n_samples.
    samples: wp.array(dtype=Sample)  # The result of each thread, if threads > 1: sample i of pixel p of the tile at p * n_samples + i.


def make_direct_light(features: Features, accel_struct: Any, transmittance: Any, step: Step) -> Any:
    """Return direct_light, which traces one shadow ray to each light, and to each of Features.extra_lights."""
    light_point = make_light_points(features).point

    @wp.func
    def direct_light(accel: accel_struct, surfaces: Surfaces, lighting: Lighting, shaded: Shaded, index: wp.uint32) -> DirectLight:
        """Return the direct light that `shaded` reflects, summed over the lights. index: index of the sample."""
        out = DirectLight()
        for i in range(lighting.count + wp.static(step.extra_lights)):
            point = light_point(lighting, shaded.key, index, i)
            request = step.shadow_request(shaded, step.sample_light(lighting, surfaces, i, shaded.surface, point))
            shadow = Shadow()
            if any_positive(request.value):
                shadow = transmittance(accel, surfaces, request.ray, request.end)
                out = add_light(out, request.value, shaded.scatter, shadow)
            if wp.static(features.recording):
                record_light(accel.record, i, request, shadow)
        return out

    return direct_light


def make_radiance(features: Features, accel_struct: Any, closest_hit: Any, any_hit: Any) -> Any:
    """Return radiance(accel, surfaces, lighting, limits, camera_ray, key, index) -> Sample of a camera ray and all rays that it causes."""
    shading = make_shading(features)
    step, follow_up = make_step(features, shading), make_follow_up(features)
    background_radiance = BACKGROUNDS[features.background].radiance
    transmittance = make_transmittance(features, shading, accel_struct, closest_hit, any_hit)
    direct_light = make_direct_light(features, accel_struct, transmittance, step)

    @wp.func
    def radiance(accel: accel_struct, surfaces: Surfaces, lighting: Lighting, limits: Limits, camera_ray: Ray, key: wp.uint32,
                 index: wp.uint32) -> Sample:
        out = Sample()
        stack = wp.zeros(shape=wp.static(features.stack_size), dtype=Path)
        stack[0] = camera_path(camera_ray, key)
        size = int(1)
        traced = int(0)
        while size > 0:
            size = size - 1
            path = stack[size]
            ray = ray_of(path)
            out.rays += 1
            traced += 1
            hit = closest_hit(accel, surfaces, ray)
            if wp.static(features.recording):
                end = PathEnd()
                end.ray = accel.record.used[RAYS] - 1
                end.path = path
            if hit.prim_id < 0:
                if wp.static(features.recording):
                    end.background = background_radiance(lighting.background, path.direction)
                    record_end(accel.record, end)
                out.radiance += wp.cw_mul(path.throughput, background_radiance(lighting.background, path.direction))
                continue
            surface = shading.surface_at(surfaces, ray, hit)
            texels = shading.look_up(surfaces, surface)
            surface = with_normal(surface, shading.shading_normal(surfaces, surface, texels, -path.direction))
            shaded = step.shade(surfaces, lighting, path, surface, texels, hit.t, step.choose_facet(path.key, index))
            next = follow_up(surfaces, shaded, limits, traced)
            if next.onward == FOLLOWED:
                stack[size] = shaded.onward
                size = size + 1
            if next.coated == FOLLOWED:
                stack[size] = shaded.coated
                size = size + 1
            if next.reflected == FOLLOWED:
                stack[size] = shaded.reflected
                size = size + 1
            if next.refracted == FOLLOWED:
                stack[size] = shaded.refracted
                size = size + 1
            direct = DirectLight()
            if wp.static(features.direct_light):
                if receives_light(shaded.scatter):
                    direct = direct_light(accel, surfaces, lighting, shaded, index)
            if wp.static(features.recording):
                end.surface = surface
                end.shaded = shaded
                end.next = next
                end.direct = direct
                record_end(accel.record, end)
            out = add_surface_light(add_cuts(out, next), next.pending_light, direct)
        return out

    return radiance


def make_traversals(features: Features, structure: Any) -> Any:
    """Return closest_hit and any_hit of a structure (wrt.accel.snapshot.Structure), which ignore hits on the clear parts of
    cut-outs."""
    accepts = make_cutout(features)
    return structure.traversal(any_hit=False, accepts=accepts), structure.traversal(any_hit=True, accepts=accepts)


def make_camera_sample(features: Features, camera_kind: Any) -> Any:
    """Return camera_sample(camera, film, x, y, xi, lens_xi) -> Ray. x, y: the pixel. xi, lens_xi: film and lens sample in [0, 1)^2."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray(features)

    @wp.func
    def camera_sample(camera: camera_struct, film: Film, x: int, y: int, xi: wp.vec2, lens_xi: wp.vec2) -> Ray:
        # The pixel filter is sampled by importance: each sample has weight 1 and belongs to this pixel alone.
        offset = wp.vec2(xi[0] - 0.5, xi[1] - 0.5)
        if wp.static(features.filter):
            offset = wp.vec2(quantile(film.filter_icdf, xi[0]), quantile(film.filter_icdf, xi[1]))
        position = wp.vec2((float(x) + 0.5 + offset[0]) / float(film.width), (float(y) + 0.5 + offset[1]) / float(film.height))
        return camera_ray(camera, position, lens_xi)

    return camera_sample


def make_render_kernel(features: Features, structure: Any, camera_kind: Any) -> Any:
    """Return the kernel that renders a tile with one thread for each pixel, or one for each sample if Tile.threads > 1 (see add_samples).

    kernels/shade/cameras describes the module `camera_kind`. With features.counting, every ray is logged, and `structure` must come
    from kernels.study.ray_log. With features.recording, `structure` must come from record.py."""
    accel_struct = structure.struct
    closest_hit, any_hit = make_traversals(features, structure)
    camera_struct = camera_kind.Camera
    camera_sample = make_camera_sample(features, camera_kind)
    sample_2d = make_sample_2d(features)
    radiance = make_radiance(features, accel_struct, closest_hit, any_hit)

    @kernel
    def render(accel: accel_struct, surfaces: Surfaces, lighting: Lighting, camera: camera_struct, limits: Limits, film: Film,
               tile: Tile):
        tid = wp.tid()
        if wp.static(features.counting):
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
            if ray.t_max > 0.0:  # Else this film point gets no light.
                sample = radiance(accel, surfaces, lighting, limits, ray, key, index)
            if tile.threads > 1:
                tile.samples[tid] = sample
            else:
                pixel = add_sample(pixel, sample, film.clamp)
        if tile.threads == 1:
            store_pixel(film, at, pixel)

    return render


@kernel
def add_samples(film: Film, tile: Tile):
    """Add tile.samples to the pixels of a tile, with one thread for each pixel and in the samples' order."""
    tid = wp.tid()
    at = (tile.y + tid / tile.width - film.y) * film.columns + tile.x + tid % tile.width - film.x
    pixel = load_pixel(film, at)
    for i in range(tile.n_samples):
        pixel = add_sample(pixel, tile.samples[tid * tile.n_samples + i], film.clamp)
    store_pixel(film, at, pixel)


def make_aov_kernel(features: Features, structure: Any, camera_kind: Any) -> Any:
    """Return the kernel that writes the AOVs of the rays through the lens' centre and each pixel's centre."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray()
    accel_struct = structure.struct
    closest_hit, _ = make_traversals(features, structure)
    write_aovs = make_write_aovs(features)

    @kernel
    def aovs(accel: accel_struct, surfaces: Surfaces, camera: camera_struct, film: AovFilm, tile: Tile):
        tid = wp.tid()
        x = tile.x + tid % tile.width
        y = tile.y + tid / tile.width
        ray = camera_ray(camera, pixel_center(x, y, film.width, film.height), wp.vec2(0.5, 0.5))
        hit = Hit()
        hit.t = float(wp.inf)
        hit.prim_id = -1
        if ray.t_max > 0.0:
            hit = closest_hit(accel, surfaces, ray)
        write_aovs(film, (y - film.y) * film.columns + x - film.x, surfaces, ray, hit)

    return aovs
