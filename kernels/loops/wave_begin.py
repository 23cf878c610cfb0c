"""The kernels that begin a wave: they place its samples and queue their camera rays."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import BLOCK, Wave, store_sample
from wrt.kernels.memory import number_of_vec2, put_in_vec2, put_in_vec3, put_int, put_number
from wrt.kernels.query import load_render_ray, store_render_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.film import pixel_center
from wrt.kernels.shade.headers import lanes_kernel
from wrt.kernels.shade.sampling import hash_pair, make_draw, quantiles
from wrt.kernels.shade.step import Sample
from wrt.kernels.structs import AovFilm, Film, Limits, kernel


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
