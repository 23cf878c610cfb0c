"""How a wave begins: its samples, and their camera rays."""

from typing import Any

import warp as wp

from wrt.kernels.loops.wave import BLOCK, Wave, put_sample
from wrt.kernels.memory import number_of_vec2, put_in_vec2, put_in_vec3, put_int, put_number
from wrt.kernels.query import put_ray, queued_ray
from wrt.kernels.shade.film import center_of
from wrt.kernels.shade.sampling import hash_pair, make_draw, quantiles
from wrt.kernels.shade.step import Sample
from wrt.kernels.structs import AovFilm, Film, Limits, kernel


def make_begin_kernel(features: Any, camera_kind: Any) -> Any:
    """Camera rays of a wave. Where there is none, the sample is done: black."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray(features)
    draw = make_draw(features)

    @wp.func
    def place(wave: Wave, film: Film, limits: Limits, first: int, end: int):
        """The samples of the pixels first .. end - 1: where they are on the film (in pixels) and the lens; and the pixels' keys."""
        job = wave.job[0]
        for p in range(first, end):
            x = wp.uint32(job.x + wave.order[p] % job.width)
            y = wp.uint32(job.y + wave.order[p] / job.width)
            key = hash_pair(hash_pair(limits.seed, x), y)
            wave.pixel_keys[p] = key
            draw(key, 0, job.first_sample, job.samples, wave.xi, p * job.samples)
            if wp.static(features.lens):
                draw(key, 1, job.first_sample, job.samples, wave.lens_xi, p * job.samples)
        if wp.static(features.filter):
            quantiles(film.filter_icdf, wave.xi, first * job.samples, (end - first) * job.samples)
        for p in range(first, end):
            center_x = float(job.x + wave.order[p] % job.width) + 0.5
            center_y = float(job.y + wave.order[p] / job.width) + 0.5
            i = p * job.samples
            while i < (p + 1) * job.samples:
                offset_x = number_of_vec2(wave.xi, i, 0)
                offset_y = number_of_vec2(wave.xi, i, 1)
                if wp.static(not features.filter):
                    offset_x = offset_x - 0.5
                    offset_y = offset_y - 0.5
                put_in_vec2(wave.xi, i, 0, center_x + offset_x)
                put_in_vec2(wave.xi, i, 1, center_y + offset_y)
                i = i + 1

    @wp.func
    def look(wave: Wave, camera: camera_struct, film: Film, first: int, end: int) -> int:
        """The camera rays of the samples first .. end - 1, each to the place of its number in the queue: in lanes (kernels.memory).
        How many have no length."""
        dead = int(0)
        i = int(first)
        while i < end:
            x = number_of_vec2(wave.xi, i, 0)
            y = number_of_vec2(wave.xi, i, 1)
            lens_xi = wp.vec2(0.0, 0.0)
            if wp.static(features.lens):
                lens_xi = wp.vec2(number_of_vec2(wave.lens_xi, i, 0), number_of_vec2(wave.lens_xi, i, 1))
            ray = camera_ray(camera, wp.vec2(x / float(film.width), y / float(film.height)), lens_xi)
            put_in_vec3(wave.rays.origin, i, 0, ray.origin[0])
            put_in_vec3(wave.rays.origin, i, 1, ray.origin[1])
            put_in_vec3(wave.rays.origin, i, 2, ray.origin[2])
            put_in_vec3(wave.rays.direction, i, 0, ray.direction[0])
            put_in_vec3(wave.rays.direction, i, 1, ray.direction[1])
            put_in_vec3(wave.rays.direction, i, 2, ray.direction[2])
            put_number(wave.rays.t_max, i, ray.t_max)
            put_int(wave.rays.exclude, i, 0)
            put_int(wave.number, i, i)
            dead = dead + wp.where(ray.t_max > 0.0, 0, 1)
            i = i + 1
        return dead

    @wp.func
    def without_dead(wave: Wave, first: int, end: int, queued: int) -> int:
        """Leaves the camera rays of the samples first .. end - 1 in the queue from place `queued` on, but for those without length,
        whose samples are done."""
        place = queued
        for number in range(first, end):
            ray = queued_ray(wave.rays, number)
            if ray.t_max > 0.0:
                if place != number:
                    put_ray(wave.rays, place, ray)
                    wave.number[place] = number
                place += 1
            else:
                put_sample(wave.done, number, Sample())
        return place

    @kernel
    def begin_wave(wave: Wave, camera: camera_struct, limits: Limits, film: Film, first_pixel: int, end_pixel: int):
        """Of the pixels first_pixel .. end_pixel - 1, from the place of their first sample in the queue on."""
        samples = wave.job[0].samples
        queued = first_pixel * samples
        first = int(first_pixel)
        while first < end_pixel:
            end = wp.min(first + wp.max(BLOCK / samples, 1), end_pixel)
            place(wave, film, limits, first, end)
            if look(wave, camera, film, first * samples, end * samples) > 0 or queued < first * samples:
                queued = without_dead(wave, first * samples, end * samples, queued)
            else:
                queued = end * samples
            first = end
        wave.job[0].begun = queued

    return begin_wave


def make_begin_aov_kernel(camera_kind: Any) -> Any:
    """A ray through the middle of each pixel; where there is none, it has no length."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray()

    @kernel
    def begin_aov(wave: Wave, camera: camera_struct, film: AovFilm):
        job = wave.job[0]
        for p in range(job.pixels):
            x = job.x + wave.order[p] % job.width
            y = job.y + wave.order[p] / job.width
            ray = camera_ray(camera, center_of(x, y, film.width, film.height), wp.vec2(0.5, 0.5))
            put_ray(wave.rays, p, ray)

    return begin_aov
