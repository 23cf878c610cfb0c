"""Many camera samples at a time, for one CPU thread: the integrator's step in a loop over queues.

A wavefront (Laine, Karras and Aila 2013, "Megakernels Considered Harmful"): the pending rays of a wave of samples wait in one
queue; one launch traces all of them, and the next shades all hits. Each sample goes through its own paths in the order of loop.py
and adds up its light in that order, so that pictures have the same bits. Traversal and shading are kernels of their own: another
scene compiles no traversal.

Each kernel is one thread with a loop over its queue: it counts without atomics, and reads its arguments once. trace_wave launches
the others, so that a wave is a single launch to Python.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.launches import Launch, run, run_range, run_with
from wrt.kernels.query import HitArrays, Queue, hit_at, put_ray, queued_ray
from wrt.kernels.shade.backgrounds import BACKGROUNDS
from wrt.kernels.shade.direct import make_light_points
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.render import center_of, load_pixel, make_see, store_pixel, with_sample
from wrt.kernels.shade.sampling import hash_pair, make_draw, quantiles
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.shadows import Shadow, ShadowWalk, begin_shadow, make_go_through
from wrt.kernels.shade.step import Lit, Sample, ShadowRequest, add_up, counted, is_lit, lit_by, make_path, make_paths, make_step
from wrt.kernels.structs import AovFilm, Film, Lighting, Limits, Surfaces, any_positive, kernel

Path = make_path(False)
first_path, ray_of, _ = make_paths()
AHEAD = 4  # hits, of what memory is asked for before it is read
BLOCK = 64  # rays for which something is computed in lanes at a time


@wp.struct
class Job:
    """What a wave is: `samples` of each of the first `pixels` of Wave.order, in a tile at x, y; and how many rays are queued."""

    x: int
    y: int
    width: int
    pixels: int
    first_sample: int
    samples: int
    queued: int


@wp.struct
class Wave:
    """Samples are numbered pixel by pixel; there is room for `capacity`. By number: xi, lens_xi, what places a sample on the film
    and on the lens; done, the sum so far; size, traced: paths that wait, and rays so far; paths[level * capacity + number]: those
    that wait.

    By place in the queue: number, rays, hits, lit, scatter, asked (shadow rays of a hit), and for light i from i * capacity on
    request: the place of its shadow ray, or -1. By place of a shadow ray, for light i from i * capacity on: value, shadow_rays,
    occluded or, where shadows are transparent, walks and shadow_hits, and waiting: which walks those rays are of. asking: shadow
    rays to each light.
    """

    capacity: int
    job: wp.array(dtype=Job)
    order: wp.array(dtype=wp.int32)
    xi: wp.array(dtype=wp.vec2)
    lens_xi: wp.array(dtype=wp.vec2)
    done: wp.array(dtype=Sample)
    size: wp.array(dtype=wp.int32)
    traced: wp.array(dtype=wp.int32)
    paths: wp.array(dtype=Path)
    number: wp.array(dtype=wp.int32)
    rays: Queue
    hits: HitArrays
    lit: wp.array(dtype=Lit)
    scatter: wp.array(dtype=Scatter)
    asked: wp.array(dtype=wp.int32)
    request: wp.array(dtype=wp.int32)
    asking: wp.array(dtype=wp.int32)
    value: wp.array(dtype=wp.vec3)
    shadow_rays: Queue
    occluded: wp.array(dtype=wp.bool)
    walks: wp.array(dtype=ShadowWalk)
    shadow_hits: HitArrays
    waiting: wp.array(dtype=wp.int32)
    sky_x: wp.array(dtype=wp.float32)
    sky_y: wp.array(dtype=wp.float32)
    sky_z: wp.array(dtype=wp.float32)
    keys: wp.array(dtype=wp.uint32)
    indices: wp.array(dtype=wp.uint32)


@wp.func
def enqueue(wave: Wave, k: int, number: int, path: Path):
    wave.number[k] = number
    put_ray(wave.rays, k, ray_of(path))


@wp.func
def pixel_of(job: Job, at: int, x: int, y: int, columns: int) -> int:
    """Where the pixel `at` of a tile is in a film that begins at x, y."""
    return (job.y + at / job.width - y) * columns + job.x + at % job.width - x


@wp.func_native("return array.data[(long long)i][k];")
def number_2(array: wp.array(dtype=wp.vec2), i: int, k: int) -> float: ...


@wp.func_native("array.data[(long long)i][k] = value;")
def put_number_3(array: wp.array(dtype=wp.vec3), i: int, k: int, value: float) -> None: ...


@wp.func_native("array.data[(long long)i] = value;")
def put_number(array: wp.array(dtype=wp.float32), i: int, value: float) -> None: ...


@wp.func_native("""
    auto& sample = samples.data[(long long)i];
    sample.radiance = radiance; sample.lost = lost;
    sample.rays = rays; sample.cut_depth = cut_depth; sample.cut_throughput = cut_throughput;
""")
def put_fields(samples: wp.array(dtype=Sample), i: int, radiance: wp.vec3, rays: int, cut_depth: int, cut_throughput: int,
               lost: float) -> None: ...


@wp.func
def put_sample(samples: wp.array(dtype=Sample), i: int, sample: Sample):
    """samples[i] = sample, field by field: a copy of the whole reads 16 bytes at a time what was written 4 at a time just before, for
    which a core waits until it is in the cache."""
    put_fields(samples, i, sample.radiance, sample.rays, sample.cut_depth, sample.cut_throughput, sample.lost)


@wp.func
def pixel_key(job: Job, at: int, limits: Limits) -> wp.uint32:
    """Of the samples of pixel `at` of a tile."""
    return hash_pair(hash_pair(limits.seed, wp.uint32(job.x + at % job.width)), wp.uint32(job.y + at / job.width))


@wp.func_native("return array.data[(long long)i];")
def bits_of(array: wp.array(dtype=wp.uint32), i: int) -> wp.uint32: ...


@wp.func_native("array.data[(long long)i][k] = value;")
def put_number_2(array: wp.array(dtype=wp.vec2), i: int, k: int, value: float) -> None: ...


@wp.func_native("__builtin_prefetch(array.data + (long long)i);")
def call_in_face(array: wp.array(dtype=wp.vec3i), i: int) -> None: ...


@wp.func_native("__builtin_prefetch(array.data + (long long)i);")
def call_in_number(array: wp.array(dtype=wp.int32), i: int) -> None: ...


@wp.func_native("__builtin_prefetch(array.data + (long long)i);")
def call_in_corner(array: wp.array(dtype=wp.vec3), i: int) -> None: ...


@wp.func_native("__builtin_prefetch(array.data + (long long)i);")
def call_in_count(array: wp.array(dtype=wp.int64), i: int) -> None: ...


@wp.func
def call_in_surface(wave: Wave, surfaces: Surfaces, k: int, queued: int):
    """What the hits after this one will read of their triangles: the face of one, the corners of another before it."""
    if k + 2 * AHEAD < queued:
        prim_id = wave.hits.prim_id[k + 2 * AHEAD]
        if prim_id >= 0 and prim_id < surfaces.n_triangles:
            call_in_face(surfaces.faces, prim_id)
            call_in_number(surfaces.prim_material, prim_id)
    if k + AHEAD < queued:
        prim_id = wave.hits.prim_id[k + AHEAD]
        if prim_id >= 0 and prim_id < surfaces.n_triangles:
            face = surfaces.faces[prim_id]
            for corner in range(3):
                call_in_corner(surfaces.vertices, face[corner])
                if surfaces.normals.shape[0] > 1:
                    call_in_corner(surfaces.normals, face[corner])


def make_begin_kernel(features: Any, camera_kind: Any) -> Any:
    """Camera rays of a wave. Where there is none, the sample is done."""
    camera_struct = camera_kind.Camera
    camera_ray = camera_kind.make_camera_ray(features)
    draw = make_draw(features)

    @wp.func
    def place(wave: Wave, film: Film, limits: Limits, first: int, end: int):
        """The samples of the pixels first .. end - 1: where they are on the film, in pixels, and on the lens."""
        job = wave.job[0]
        for p in range(first, end):
            key = pixel_key(job, wave.order[p], limits)
            draw(key, 0, job.first_sample, job.samples, wave.xi, p * job.samples)
            if wp.static(features.lens):
                draw(key, 1, job.first_sample, job.samples, wave.lens_xi, p * job.samples)
        if wp.static(features.filter):
            quantiles(film.filter_icdf, wave.xi, first * job.samples, (end - first) * job.samples)
        for p in range(first, end):
            x = float(job.x + wave.order[p] % job.width) + 0.5
            y = float(job.y + wave.order[p] / job.width) + 0.5
            i = p * job.samples
            while i < (p + 1) * job.samples:
                offset_x = number_2(wave.xi, i, 0)
                offset_y = number_2(wave.xi, i, 1)
                if wp.static(not features.filter):
                    offset_x = offset_x - 0.5
                    offset_y = offset_y - 0.5
                put_number_2(wave.xi, i, 0, x + offset_x)
                put_number_2(wave.xi, i, 1, y + offset_y)
                i = i + 1

    @wp.func
    def look(wave: Wave, camera: camera_struct, film: Film, first: int, end: int):
        """The camera rays of the samples first .. end - 1, each to its place in the queue: in lanes (backgrounds.environment_places
        tells how)."""
        i = int(first)
        while i < end:
            position = wp.vec2(number_2(wave.xi, i, 0) / float(film.width), number_2(wave.xi, i, 1) / float(film.height))
            lens_xi = wp.vec2(0.0, 0.0)
            if wp.static(features.lens):
                lens_xi = wp.vec2(number_2(wave.lens_xi, i, 0), number_2(wave.lens_xi, i, 1))
            ray = camera_ray(camera, position, lens_xi)
            put_number_3(wave.rays.origin, i, 0, ray.origin[0])
            put_number_3(wave.rays.origin, i, 1, ray.origin[1])
            put_number_3(wave.rays.origin, i, 2, ray.origin[2])
            put_number_3(wave.rays.direction, i, 0, ray.direction[0])
            put_number_3(wave.rays.direction, i, 1, ray.direction[1])
            put_number_3(wave.rays.direction, i, 2, ray.direction[2])
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
                key = pixel_key(job, wave.order[p], limits)
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


def make_shade_kernel(features: Any) -> Any:
    """The step at every hit of the queue: its light, its new paths, and its requests for shadow rays."""
    shading = make_shading(features)
    step = make_step(features, shading)
    _, _, _, shade, extra_lights, shadow_request, keep, worth = step
    radiance, by_kind, radiance_at, places = BACKGROUNDS[features.background]
    light_numbers, sky_point, light_point = make_light_points(features)
    sky_in_lanes = features.sky_light and by_kind is None  # else the numbers are all there is to it

    @wp.func
    def follow(wave: Wave, number: int, size: int, path: Path, verdict: int) -> int:
        """The number of paths that wait, with this one where it is followed."""
        if verdict == 1:
            wave.paths[size * wave.capacity + number] = path
            return size + 1
        return size

    @wp.func
    def ask(wave: Wave, i: int, request: ShadowRequest) -> int:
        """The place of a shadow ray to light i."""
        slot = i * wave.capacity + wave.asking[i]
        wave.asking[i] = wave.asking[i] + 1
        wave.value[slot] = request.value
        put_ray(wave.shadow_rays, slot, request.ray)
        if wp.static(features.transparent_shadows):
            wave.walks[slot] = begin_shadow(request.ray, request.end)
            wave.waiting[slot] = slot
        return slot

    @wp.func
    def sky_points(wave: Wave, light: int, first: int, end: int):
        """Those of the rays first .. end - 1 that hit something, one after another: in lanes (backgrounds.environment_places tells
        how)."""
        job = wave.job[0]
        hits = int(0)
        for k in range(first, end):
            if wave.hits.prim_id[k] >= 0:
                number = wave.number[k]
                wave.keys[hits] = wave.paths[wave.size[number] * wave.capacity + number].key
                wave.indices[hits] = wp.uint32(job.first_sample + number % job.samples)
                hits += 1
        i = int(0)
        while i < hits:
            point = sky_point(light_numbers(bits_of(wave.keys, i), bits_of(wave.indices, i), light))
            put_number(wave.sky_x, i, point[0])
            put_number(wave.sky_y, i, point[1])
            put_number(wave.sky_z, i, point[2])
            i = i + 1

    @kernel
    def shade_wave(wave: Wave, surfaces: Surfaces, lighting: Lighting, limits: Limits):
        job = wave.job[0]
        hits = int(0)
        for k in range(job.queued):
            if wp.static(not features.instances):
                call_in_surface(wave, surfaces, k, job.queued)
            if k % BLOCK == 0:
                if wp.static(places is not None):
                    places(lighting.background, wave.rays.direction, k, wp.min(k + BLOCK, job.queued), wave.sky_x, wave.sky_y)
                if wp.static(sky_in_lanes):
                    sky_points(wave, lighting.count, k, wp.min(k + BLOCK, job.queued))
                    hits = int(0)
            number = wave.number[k]
            size = wave.size[number]
            traced = wave.traced[number] + 1
            wave.traced[number] = traced
            path = wave.paths[size * wave.capacity + number]
            out = wave.done[number]
            out.rays += 1
            asked = int(0)
            hit = hit_at(wave.hits, k)
            if hit.prim_id < 0:
                if wp.static(places is not None):
                    seen = radiance_at(lighting.background, wave.sky_x[k % BLOCK], wave.sky_y[k % BLOCK])
                    out.radiance += wp.cw_mul(path.throughput, seen)
                else:
                    out.radiance += wp.cw_mul(path.throughput, radiance(lighting.background, path.direction))
            else:
                index = wp.uint32(job.first_sample + number % job.samples)
                shaded = shade(surfaces, lighting, path, ray_of(path), hit, index)
                lit = Lit()
                lit.light = shaded.light
                lit.throughput = shaded.throughput
                if wp.static(features.blend):
                    verdict = keep(shaded.onward, limits, traced)
                    size = follow(wave, number, size, shaded.onward, verdict)
                    out = counted(out, verdict)
                    out.lost += worth(surfaces, shaded.onward, verdict)
                if wp.static(features.reflection):
                    verdict = keep(shaded.reflected, limits, traced)
                    size = follow(wave, number, size, shaded.reflected, verdict)
                    out = counted(out, verdict)
                    lit.reflected = worth(surfaces, shaded.reflected, verdict)
                if wp.static(features.refraction):
                    verdict = keep(shaded.refracted, limits, traced)
                    size = follow(wave, number, size, shaded.refracted, verdict)
                    out = counted(out, verdict)
                    lit.refracted = worth(surfaces, shaded.refracted, verdict)
                if wp.static(features.lit):
                    if is_lit(shaded.scatter):
                        for i in range(lighting.count + wp.static(extra_lights)):
                            point = wp.vec3()
                            if wp.static(sky_in_lanes):
                                point = wp.vec3(wave.sky_x[hits], wave.sky_y[hits], wave.sky_z[hits])
                            if wp.static(not sky_in_lanes) or i < lighting.count:
                                point = light_point(lighting, shaded.key, index, i)
                            request = shadow_request(surfaces, lighting, shaded, i, point)
                            slot = int(-1)
                            if any_positive(request.value):
                                slot = ask(wave, i, request)
                                asked += 1
                            wave.request[i * wave.capacity + k] = slot
                hits += 1
                if asked > 0:
                    wave.lit[k] = lit
                    if wp.static(features.transparent_shadows):
                        wave.scatter[k] = shaded.scatter
                else:
                    out = add_up(out, lit, Shadow())
            put_sample(wave.done, number, out)
            wave.size[number] = size
            wave.asked[k] = asked

    return shade_wave


def make_shadow_kernel(features: Any) -> Any:
    """Shadow rays to one light that have met the closest surface on their way."""
    go_through = make_go_through(features, make_shading(features))

    @kernel
    def shadow_wave(wave: Wave, surfaces: Surfaces, light: int):
        first = light * wave.capacity
        left = int(0)
        for j in range(wave.asking[light]):
            slot = wave.waiting[first + j]
            walk = go_through(surfaces, wave.walks[slot], hit_at(wave.shadow_hits, first + j))
            wave.walks[slot] = walk
            if walk.done == 0:
                wave.waiting[first + left] = slot
                put_ray(wave.shadow_rays, first + left, walk.ray)
                left += 1
        wave.asking[light] = left

    return shadow_wave


def make_gather(transparent_shadows: bool) -> Any:
    """What the lights send to the hits of the queue; then the next path of each sample is queued."""

    @wp.func
    def gather(wave: Wave, lights: int):
        queued = int(0)
        for k in range(wave.job[0].queued):
            number = wave.number[k]
            if wave.asked[k] > 0:
                direct = Shadow()
                for i in range(lights):
                    slot = wave.request[i * wave.capacity + k]
                    if slot >= 0:
                        if wp.static(transparent_shadows):
                            direct = lit_by(direct, wave.value[slot], wave.scatter[k], wave.walks[slot].shadow)
                        else:
                            shadow = Shadow()
                            shadow.rays = 1
                            if not wave.occluded[slot]:
                                shadow.transmittance = wp.vec3(1.0, 1.0, 1.0)
                            direct = lit_by(direct, wave.value[slot], Scatter(), shadow)
                put_sample(wave.done, number, add_up(wave.done[number], wave.lit[k], direct))
            size = wave.size[number] - 1
            if size >= 0:
                wave.size[number] = size
                enqueue(wave, queued, number, wave.paths[size * wave.capacity + number])
                queued += 1
        for i in range(lights):
            wave.asking[i] = 0
        wave.job[0].queued = queued

    return gather


@wp.func
def add_to_film(wave: Wave, film: Film):
    """The samples of a wave to their pixels, in their order."""
    job = wave.job[0]
    for p in range(job.pixels):
        if p + AHEAD < job.pixels:
            next = pixel_of(job, wave.order[p + AHEAD], film.x, film.y, film.columns)
            call_in_corner(film.mean, next)
            call_in_corner(film.m2, next)
            call_in_count(film.rays, next)
        i = pixel_of(job, wave.order[p], film.x, film.y, film.columns)
        pixel = load_pixel(film, i)
        for j in range(job.samples):
            pixel = with_sample(pixel, wave.done[p * job.samples + j])
        store_pixel(film, i, pixel)


@wp.struct
class WaveLaunches:
    """Those of a wave. shadow_hit: any hit, or where shadows are transparent, the closest one, with which go_through goes on."""

    begin: Launch
    closest_hit: Launch
    shade: Launch
    shadow_hit: Launch
    go_through: Launch


@cache
def make_loop_kernel(transparent_shadows: bool) -> Any:
    """All of a wave, from its camera rays to the film."""
    gather = make_gather(transparent_shadows)

    @kernel
    def trace_wave(wave: Wave, launches: WaveLaunches, lights: int, film: Film):
        run(launches.begin)
        while wave.job[0].queued > 0:
            run_range(launches.closest_hit, 0, wave.job[0].queued)
            run(launches.shade)
            for light in range(lights):
                first = light * wave.capacity
                asking = wave.asking[light]
                while asking > 0:
                    run_range(launches.shadow_hit, first, first + asking)
                    asking = 0
                    if wp.static(transparent_shadows):
                        run_with(launches.go_through, light)
                        asking = wave.asking[light]
            gather(wave, lights)
        add_to_film(wave, film)

    return trace_wave


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


def make_see_kernel(features: Any) -> Any:
    """What those rays meet."""
    see = make_see(features)

    @kernel
    def see_wave(wave: Wave, surfaces: Surfaces, film: AovFilm):
        job = wave.job[0]
        for p in range(job.pixels):
            pixel = pixel_of(job, wave.order[p], film.x, film.y, film.columns)
            see(film, pixel, surfaces, queued_ray(wave.rays, p), hit_at(wave.hits, p))

    return see_wave
