"""Waves: the CPU's render loop. One thread renders one tile, many samples at a time.

This is a wavefront tracer (Laine, Karras and Aila 2013, "Megakernels Considered Harmful"). A wave is a group of samples. Their
pending rays wait in one queue (state.py). One launch traces all queued rays, in packets. The next launch shades all hits, vectorised
where the code has no branches. Each sample takes its paths and adds its light in the order of one_ray.py, so that both loops render
the same bits (tests/wrt/renderer/test_waves.py).

Python launches only the kernel trace_wave, which launches the others:
1. For FRESH camera rays at a time, while they are in the cache: begin_wave, closest_hit, and shade_wave (wave_shade.py), which
   pushes new paths and requests shadow rays.
2. Until no path waits: trace the shadow rays to each light, and add the direct light (add_direct_light). Then run closest_hit and
   shade_wave for the top path of each sample.
3. Add the finished samples to the film (add_to_film).

Each kernel is one thread that loops over its queue, so that it counts without atomics. The exceptions are the traversal kernels of
structures without `stream` (wrt.accel.base), which have one thread for each ray. Traversal and shading are separate kernels, so that
a new scene does not recompile traversal. The vectorised parts of shading are in wave_hits.py and wave_lights.py."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.launches import Launch, run_range, run_with
from wrt.kernels.loops.state import BLOCK, Task, Wave, lanes_kernel, store_sample
from wrt.kernels.query import load_hit, load_render_ray, store_render_ray
from wrt.kernels.rows import number_of_vec2, put_in_vec2, put_in_vec3, put_int, put_number
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.film import AovFilm, Film, add_sample, load_pixel, make_write_aovs, pixel_center, store_pixel
from wrt.kernels.shade.sampling import LANES, hash_pair, make_draw, quantiles
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.shadows import make_advance_shadow
from wrt.kernels.shade.step import DirectLight, Sample, add_light, add_surface_light
from wrt.kernels.structs import Limits, Surfaces, kernel, noinline

FRESH = 2048  # Number of camera rays that are made, traced and shaded together, so that they stay in the cache.


@wp.func
def film_index(task: Task, at: int, x: int, y: int, columns: int) -> int:
    """Return the index in the film of the tile's pixel `at`. (x, y): the film's first pixel in the picture. columns: the film's width."""
    return (task.y + at / task.width - y) * columns + task.x + at % task.width - x


# --- the camera rays of a wave ----------------------------------------------------------------------------------------


def make_place_samples(features: Features) -> Any:
    """Return place_samples(wave, film, limits, first, end): draw keys, film points and lens points of the pixels first .. end - 1."""
    draw = make_draw(features)

    @wp.func
    def draw_samples(wave: Wave, limits: Limits, first: int, end: int):
        task = wave.task[0]
        for p in range(first, end):
            x = wp.uint32(task.x + wave.pixels.order[p] % task.width)
            y = wp.uint32(task.y + wave.pixels.order[p] / task.width)
            key = hash_pair(hash_pair(limits.seed, x), y)
            wave.pixels.key[p] = key
            draw(key, 0, task.first_sample, task.samples, wave.samples.film_point, p * task.samples)
            if wp.static(features.lens):
                draw(key, 1, task.first_sample, task.samples, wave.samples.lens_point, p * task.samples)

    @wp.func
    def place_samples(wave: Wave, film: Film, limits: Limits, first: int, end: int):
        task = wave.task[0]
        draw_samples(wave, limits, first, end)
        points = wave.samples.film_point
        if wp.static(features.filter):
            quantiles(film.filter_icdf, points, first * task.samples, (end - first) * task.samples)
        for p in range(first, end):
            center_x = float(task.x + wave.pixels.order[p] % task.width) + 0.5
            center_y = float(task.y + wave.pixels.order[p] / task.width) + 0.5
            i = p * task.samples
            while i < (p + 1) * task.samples:
                offset_x = number_of_vec2(points, i, 0)
                offset_y = number_of_vec2(points, i, 1)
                if wp.static(not features.filter):
                    offset_x = offset_x - 0.5
                    offset_y = offset_y - 0.5
                put_in_vec2(points, i, 0, center_x + offset_x)
                put_in_vec2(points, i, 1, center_y + offset_y)
                i = i + 1

    return place_samples


def make_queue_camera_rays(features: Features, camera_kind: Any) -> Any:
    """Return queue_camera_rays(wave, camera, film, first, end) -> int: queue the rays of the samples first .. end - 1, vectorised.

    The ray of sample s is at place s. The result is the number of dead rays: no_ray() of film points that get no light."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray(features)

    @wp.func
    def queue_camera_rays(wave: Wave, camera: camera_struct, film: Film, first: int, end: int) -> int:
        samples = wave.samples
        rays = wave.queue.rays
        dead = int(0)
        i = int(first)
        while i < end:
            x = number_of_vec2(samples.film_point, i, 0)
            y = number_of_vec2(samples.film_point, i, 1)
            lens_xi = wp.vec2(0.0, 0.0)
            if wp.static(features.lens):
                lens_xi = wp.vec2(number_of_vec2(samples.lens_point, i, 0), number_of_vec2(samples.lens_point, i, 1))
            ray = camera_ray(camera, wp.vec2(x / float(film.width), y / float(film.height)), lens_xi)
            put_in_vec3(rays.origin, i, 0, ray.origin[0])
            put_in_vec3(rays.origin, i, 1, ray.origin[1])
            put_in_vec3(rays.origin, i, 2, ray.origin[2])
            put_in_vec3(rays.direction, i, 0, ray.direction[0])
            put_in_vec3(rays.direction, i, 1, ray.direction[1])
            put_in_vec3(rays.direction, i, 2, ray.direction[2])
            put_number(rays.t_max, i, ray.t_max)
            put_int(rays.exclude, i, 0)
            put_int(wave.queue.sample, i, i)
            dead = dead + wp.where(ray.t_max > 0.0, 0, 1)
            i = i + 1
        return dead

    return queue_camera_rays


@wp.func
def close_gaps(wave: Wave, first: int, end: int, queued: int) -> int:
    """Remove the dead rays, no_ray(), of the samples first .. end - 1 from the queue. Samples with dead rays are black.

    The live rays move to the places from `queued` on. Return the place behind the last live ray."""
    place = queued
    for s in range(first, end):
        ray = load_render_ray(wave.queue.rays, s)
        if ray.t_max > 0.0:
            if place != s:
                store_render_ray(wave.queue.rays, place, ray)
                wave.queue.sample[place] = s
            place += 1
        else:
            store_sample(wave.samples.total, s, Sample())
    return place


def make_begin_kernel(features: Features, camera_kind: Any) -> Any:
    """Return the kernel begin_wave, which queues the camera rays of a wave."""
    camera_struct = camera_kind.Camera
    place_samples, queue_camera_rays = make_place_samples(features), make_queue_camera_rays(features, camera_kind)

    @lanes_kernel
    def begin_wave(wave: Wave, camera: camera_struct, limits: Limits, film: Film, first_pixel: int, end_pixel: int):
        """Queue the camera rays of the pixels first_pixel .. end_pixel - 1, from place first_pixel * task.samples on."""
        samples = wave.task[0].samples
        queued = first_pixel * samples
        first = int(first_pixel)
        while first < end_pixel:
            end = wp.min(first + wp.max(BLOCK / samples, 1), end_pixel)
            place_samples(wave, film, limits, first, end)
            if queue_camera_rays(wave, camera, film, first * samples, end * samples) > 0 or queued < first * samples:
                queued = close_gaps(wave, first * samples, end * samples, queued)
            else:
                queued = end * samples
            first = end
        wave.progress[0].begun = queued

    return begin_wave


# --- shadow rays, and the film ----------------------------------------------------------------------------------------


def make_shadow_kernel(features: Features) -> Any:
    """Return the kernel that advances each queued shadow ray to one light past the surface that it has just hit.

    Rays that are blocked or cut, or that have reached the light, leave the queue. Only scenes with transparent shadows need this kernel."""
    advance_shadow = make_advance_shadow(features, make_shading(features))

    @kernel
    def shadow_wave(wave: Wave, surfaces: Surfaces, light: int):
        first = light * wave.capacity
        left = int(0)
        for j in range(wave.shadow_queue.count[light]):
            slot = wave.shadow_queue.slot[first + j]
            walk = advance_shadow(surfaces, wave.shadows.walk[slot], load_hit(wave.shadow_queue.hits, first + j))
            wave.shadows.walk[slot] = walk
            if walk.done == 0:
                wave.shadow_queue.slot[first + left] = slot
                store_render_ray(wave.shadow_queue.rays, first + left, walk.ray)
                left += 1
        wave.shadow_queue.count[light] = left

    return shadow_wave


def make_add_direct_light(transparent_shadows: bool) -> Any:
    """Return add_direct_light(wave, lights): add each receiver's light to its sample, after the shadow rays are traced."""

    @noinline
    def add_direct_light(wave: Wave, lights: int):
        for a in range(wave.progress[0].receivers):
            direct = DirectLight()
            radiance = wp.vec3()  # A local variable: Warp stores and reloads a struct that changes in a loop.
            rays = int(0)
            for i in range(lights):
                slot = wave.receivers.shadow[i * wave.capacity + a]
                if slot >= 0:
                    value = wave.shadows.value[slot]
                    if wp.static(transparent_shadows):
                        direct = add_light(direct, value, wave.receivers.scatter[a], wave.shadows.walk[slot].shadow)
                    else:
                        radiance += wp.where(wave.shadow_queue.occluded[slot], 0.0, 1.0) * value
                        rays += 1
            if wp.static(not transparent_shadows):
                direct.radiance = radiance
                direct.rays = rays
            s = wave.receivers.sample[a]
            store_sample(wave.samples.total, s, add_surface_light(wave.samples.total[s], wave.receivers.pending_light[a], direct))
        for i in range(lights):
            wave.shadow_queue.count[i] = 0
        wave.progress[0].receivers = 0

    return add_direct_light


@wp.func_native("wrt::add_sample(film, pixels.data + (long long)p, done.data + (long long)p * samples, samples);")
def add_to_pixels(film: Film, pixels: wp.array(dtype=wp.int32), done: wp.array(dtype=Sample), p: int, samples: int) -> None:
    """Add `samples` samples to each of LANES pixels, with film indices pixels[p], pixels[p + 1] ...; done[p * samples] is the first."""


@noinline
def add_to_film(wave: Wave, film: Film):
    """Add the samples of a wave to their pixels, in the order of the samples' indices."""
    task = wave.task[0]
    for p in range(task.pixels):
        wave.pixels.film_index[p] = film_index(task, wave.pixels.order[p], film.x, film.y, film.columns)
    p = int(0)
    while p + LANES <= task.pixels and film.clamp == 0.0:  # The vectorised code clamps nothing.
        add_to_pixels(film, wave.pixels.film_index, wave.samples.total, p, task.samples)
        p += LANES
    while p < task.pixels:
        pixel = load_pixel(film, wave.pixels.film_index[p])
        for j in range(task.samples):
            pixel = add_sample(pixel, wave.samples.total[p * task.samples + j], film.clamp)
        store_pixel(film, wave.pixels.film_index[p], pixel)
        p += 1


@wp.struct
class WaveLaunches:
    """The launches of a wave, recorded by the host."""

    begin: Launch
    closest_hit: Launch
    shade: Launch
    shadow_any_hit: Launch  # In scenes without transparent shadows.
    shadow_closest_hit: Launch  # In scenes with transparent shadows.
    advance_shadow: Launch  # In scenes with transparent shadows: the kernel of make_shadow_kernel.


@cache
def make_loop_kernel(transparent_shadows: bool) -> Any:
    """Return the kernel trace_wave, which renders a wave from its camera rays to the film."""
    add_direct_light = make_add_direct_light(transparent_shadows)

    @wp.func
    def trace_shadows(wave: Wave, launches: WaveLaunches, lights: int):
        """Trace all queued shadow rays, and add the light that reaches the receivers."""
        for light in range(lights):
            first = light * wave.capacity
            if wp.static(transparent_shadows):
                while wave.shadow_queue.count[light] > 0:
                    run_range(launches.shadow_closest_hit, first, first + wave.shadow_queue.count[light])
                    run_with(launches.advance_shadow, light)
            elif wave.shadow_queue.count[light] > 0:
                run_range(launches.shadow_any_hit, first, first + wave.shadow_queue.count[light])
        add_direct_light(wave, lights)

    @lanes_kernel
    def trace_wave(wave: Wave, launches: WaveLaunches, lights: int, film: Film):
        task = wave.task[0]
        wave.progress[0].queued = 0
        wave.progress[0].fresh = 1
        pixel = int(0)
        while pixel < task.pixels:
            end = wp.min(pixel + wp.max(FRESH / task.samples, 1), task.pixels)
            run_range(launches.begin, pixel, end)
            run_range(launches.closest_hit, pixel * task.samples, wave.progress[0].begun)
            run_range(launches.shade, pixel * task.samples, wave.progress[0].begun)
            pixel = end
        wave.progress[0].fresh = 0
        while True:
            trace_shadows(wave, launches, lights)
            queued = wave.progress[0].queued
            if queued == 0:
                break
            wave.progress[0].queued = 0
            run_range(launches.closest_hit, 0, queued)
            run_range(launches.shade, 0, queued)
        add_to_film(wave, film)

    return trace_wave


# --- AOVs -------------------------------------------------------------------------------------------------------------


def make_begin_aov_kernel(camera_kind: Any) -> Any:
    """Return the kernel that queues the rays through the pixels' centres. A centre that gets no light has no_ray()."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray()

    @kernel
    def begin_aov(wave: Wave, camera: camera_struct, film: AovFilm):
        task = wave.task[0]
        for p in range(task.pixels):
            x = task.x + wave.pixels.order[p] % task.width
            y = task.y + wave.pixels.order[p] / task.width
            ray = camera_ray(camera, pixel_center(x, y, film.width, film.height), wp.vec2(0.5, 0.5))
            store_render_ray(wave.queue.rays, p, ray)

    return begin_aov


def make_aov_kernel(features: Features) -> Any:
    """Return the kernel that writes the AOVs from the closest hits of the rays that begin_aov queued."""
    write_aovs = make_write_aovs(features)

    @kernel
    def aov_wave(wave: Wave, surfaces: Surfaces, film: AovFilm):
        task = wave.task[0]
        for p in range(task.pixels):
            pixel = film_index(task, wave.pixels.order[p], film.x, film.y, film.columns)
            write_aovs(film, pixel, surfaces, load_render_ray(wave.queue.rays, p), load_hit(wave.queue.hits, p))

    return aov_wave
