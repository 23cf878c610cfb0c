"""Many camera samples at a time, for one CPU thread: pictures on a CPU, where no rays are counted.

A wavefront (Laine, Karras and Aila 2013, "Megakernels Considered Harmful"). The pending rays of a wave of samples wait in one queue
(state.py); one launch traces all of them, and the next shades all hits. So packets of rays share their way through a structure,
and what has no branches is computed in lanes. one_ray.py does the same for one sample at a time, for CUDA and where rays are
counted; it says why there are two. Each sample goes through its own paths in the order of one_ray.py and adds up its light in that
order. So pictures have the same bits: tests/wrt/renderer/test_waves.py, and of random scenes tests/test_random_scenes.py.

trace_wave is a single launch to Python. In a wave it launches, in this order:
1. for FRESH camera rays at a time, while they are in the cache: begin_wave (wave_begin.py), closest_hit (wide/batch.py, or query.py
   where a structure has no batches), and shade_wave (wave_shade.py), whose push_paths puts new paths and shadow rays aside;
2. until no path waits: the shadow rays to each light, and `add_direct_light` for what they let through; closest_hit and
   shade_wave of one path of each sample.
Then the samples go to the film. Each kernel but query.py's is one thread with a loop over its queue: it counts without atomics, and
reads its arguments once. Traversal and shading are kernels of their own: another scene compiles no traversal.

For many hits at a time, surfaces are in wave_surfaces.py, textures in wave_textures.py, normals in wave_normals.py, random numbers
in wave_numbers.py, and lights in wave_lights.py; wave_rows.py has what they hand to each other.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.launches import Launch, run_range, run_with
from wrt.kernels.loops.state import Task, Wave, put_sample
from wrt.kernels.query import hit_at, put_ray, queued_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.film import add_sample, load_pixel, make_write_aovs, store_pixel
from wrt.kernels.shade.headers import lanes_kernel
from wrt.kernels.shade.sampling import LANES
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.shadows import Shadow, make_advance_shadow
from wrt.kernels.shade.step import Sample, add_light, add_surface_light
from wrt.kernels.structs import AovFilm, Film, Surfaces, kernel

FRESH = 2048  # camera rays that are made, traced and shaded at a time, while they are in the cache


@wp.func
def film_index(task: Task, at: int, x: int, y: int, columns: int) -> int:
    """Return where the pixel `at` of a tile is in a film that begins at x, y."""
    return (task.y + at / task.width - y) * columns + task.x + at % task.width - x


def make_shadow_kernel(features: Features) -> Any:
    """Return the kernel for shadow rays to one light that have met the closest surface on their way."""
    advance_shadow = make_advance_shadow(features, make_shading(features))

    @kernel
    def shadow_wave(wave: Wave, surfaces: Surfaces, light: int):
        first = light * wave.capacity
        left = int(0)
        for j in range(wave.shadow_queue.count[light]):
            slot = wave.shadow_queue.slot[first + j]
            walk = advance_shadow(surfaces, wave.shadows.walk[slot], hit_at(wave.shadow_queue.hits, first + j))
            wave.shadows.walk[slot] = walk
            if walk.done == 0:
                wave.shadow_queue.slot[first + left] = slot
                put_ray(wave.shadow_queue.rays, first + left, walk.ray)
                left += 1
        wave.shadow_queue.count[light] = left

    return shadow_wave


def make_add_direct_light(transparent_shadows: bool) -> Any:
    """Return the function that adds what the lights send to the receivers."""

    @wp.func
    def add_direct_light(wave: Wave, lights: int):
        for a in range(wave.progress[0].receivers):
            direct = Shadow()
            light = wp.vec3()  # a struct that changes in a loop is written and read back
            rays = int(0)
            for i in range(lights):
                slot = wave.receivers.shadow[i * wave.capacity + a]
                if slot >= 0:
                    value = wave.shadows.value[slot]
                    if wp.static(transparent_shadows):
                        direct = add_light(direct, value, wave.receivers.scatter[a], wave.shadows.walk[slot].shadow)
                    else:
                        light += wp.where(wave.shadow_queue.occluded[slot], 0.0, 1.0) * value
                        rays += 1
            if wp.static(not transparent_shadows):
                direct.transmittance = light
                direct.rays = rays
            s = wave.receivers.sample[a]
            put_sample(wave.samples.total, s, add_surface_light(wave.samples.total[s], wave.receivers.pending_light[a], direct))
        for i in range(lights):
            wave.shadow_queue.count[i] = 0
        wave.progress[0].receivers = 0

    return add_direct_light


@wp.func_native("wrt::add_sample(film, pixels.data + (long long)p, done.data + (long long)p * samples, samples);")
def add_to_pixels(film: Film, pixels: wp.array(dtype=wp.int32), done: wp.array(dtype=Sample), p: int, samples: int) -> None:
    """As add_sample, to the LANES entries of the film from pixels[p] on: done[p * samples] and what follows it."""


@wp.func
def add_to_film(wave: Wave, film: Film):
    """Add the samples of a wave to their pixels, in their order."""
    task = wave.task[0]
    for p in range(task.pixels):
        wave.pixels.film_index[p] = film_index(task, wave.pixels.order[p], film.x, film.y, film.columns)
    p = int(0)
    while p + LANES <= task.pixels:
        add_to_pixels(film, wave.pixels.film_index, wave.samples.total, p, task.samples)
        p += LANES
    while p < task.pixels:
        pixel = load_pixel(film, wave.pixels.film_index[p])
        for j in range(task.samples):
            pixel = add_sample(pixel, wave.samples.total[p * task.samples + j])
        store_pixel(film, wave.pixels.film_index[p], pixel)
        p += 1


@wp.struct
class WaveLaunches:
    """Those of a wave. shadow_any_hit: any hit; shadow_closest_hit: the closest one, with which advance_shadow goes on."""

    begin: Launch
    closest_hit: Launch
    shade: Launch
    shadow_any_hit: Launch
    shadow_closest_hit: Launch
    advance_shadow: Launch


@cache
def make_loop_kernel(transparent_shadows: bool) -> Any:
    """Return the kernel for all of a wave, from its camera rays to the film."""
    add_direct_light = make_add_direct_light(transparent_shadows)

    @wp.func
    def trace_shadows(wave: Wave, launches: WaveLaunches, lights: int):
        """Trace all shadow rays, and add what the lights send."""
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


def make_aov_kernel(features: Features) -> Any:
    """Return the kernel for what the rays of an AOV film meet."""
    write_aovs = make_write_aovs(features)

    @kernel
    def aov_wave(wave: Wave, surfaces: Surfaces, film: AovFilm):
        task = wave.task[0]
        for p in range(task.pixels):
            pixel = film_index(task, wave.pixels.order[p], film.x, film.y, film.columns)
            write_aovs(film, pixel, surfaces, queued_ray(wave.queue.rays, p), hit_at(wave.queue.hits, p))

    return aov_wave
