"""How a wave begins: its samples, and their camera rays."""

from typing import Any

import warp as wp

from wrt.kernels.memory import number_of_vec2, put_in_vec2, put_in_vec3, put_number
from wrt.kernels.query import put_ray, queued_ray
from wrt.kernels.shade.render import center_of
from wrt.kernels.shade.sampling import hash_pair, make_draw, quantiles
from wrt.kernels.shade.step import Sample, make_paths
from wrt.kernels.shade.wave import BLOCK, Wave, enqueue
from wrt.kernels.structs import AovFilm, Film, Limits, kernel

first_path, _, _ = make_paths()


def make_begin_kernel(features: Any, camera_kind: Any) -> Any:
    """Camera rays of a wave. Where there is none, the sample is done."""
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
            wave.keys[p - first] = key
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
    def look(wave: Wave, camera: camera_struct, film: Film, first: int, end: int):
        """The camera rays of the samples first .. end - 1, each to its place in the queue: in lanes (kernels.memory)."""
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
            i = i + 1

    @kernel
    def begin_wave(wave: Wave, camera: camera_struct, limits: Limits, film: Film):
        job = wave.job[0]
        queued = int(0)
        first = int(0)
        while first < job.pixels:
            end = wp.min(first + wp.max(BLOCK / job.samples, 1), job.pixels)
            place(wave, film, limits, first, end)
            look(wave, camera, film, first * job.samples, end * job.samples)
            for p in range(first, end):
                key = wave.keys[p - first]
                for number in range(p * job.samples, (p + 1) * job.samples):
                    wave.done[number] = Sample()
                    wave.size[number] = 0
                    wave.traced[number] = 0
                    ray = queued_ray(wave.rays, number)
                    if ray.t_max > 0.0:
                        path = first_path(ray, key)
                        wave.paths[number] = path
                        enqueue(wave, queued, number, path)
                        queued += 1
            first = end
        wave.job[0].queued = queued

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
