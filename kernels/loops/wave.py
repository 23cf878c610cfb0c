"""Many camera samples at a time, for one CPU thread: pictures on a CPU. one_ray.py says why there are two loops;
tests/wrt/renderer/test_waves.py and tests/test_random_scenes.py hold them to the same bits.

A wavefront (Laine, Karras and Aila 2013, "Megakernels Considered Harmful"): the pending rays of a wave of samples wait in one
queue; one launch traces all of them, and the next shades all hits. Camera rays are made, traced and shaded FRESH at a time, while
they are in the cache; what comes of them waits until all have been. Each sample goes through its own paths in the order of
one_ray.py and adds up its light in that order, so that pictures have the same bits. Traversal and shading are kernels of their own:
another scene compiles no traversal.

Each kernel is one thread with a loop over its queue: it counts without atomics, and reads its arguments once. trace_wave launches
the others, so that a wave is a single launch to Python. What begins a wave is in wave_begin.py, the step in wave_shade.py; for many
hits at a time, surfaces are in wave_surfaces.py, textures in wave_textures.py, normals in wave_normals.py, random numbers in
wave_numbers.py, and lights in wave_lights.py; wave_rows.py has what they hand to each other.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.launches import Launch, run_range, run_with
from wrt.kernels.native import source
from wrt.kernels.query import HitArrays, Queue, hit_at, put_ray, queued_ray
from wrt.kernels.shade.film import load_pixel, make_see, store_pixel, with_sample
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.paths import make_path, make_paths
from wrt.kernels.shade.sampling import LANES
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.shadows import Shadow, ShadowWalk, make_go_through
from wrt.kernels.shade.step import Lit, Sample, add_up, lit_by
from wrt.kernels.structs import AovFilm, Film, Surfaces, kernel

Path = make_path(False)
ray_of = make_paths(False).ray_of
BLOCK = 64  # rays for which something is computed in lanes at a time
FRESH = 2048  # camera rays that are made, traced and shaded at a time, while they are in the cache


@wp.struct
class Job:
    """What a wave is: `samples` of each of the first `pixels` of Wave.order, in a tile at x, y. And how far it is: fresh: 1 while
    its camera rays are traced, of which `begun` are in the queue; hits: of the rays that are shaded, those that hit something;
    queued: rays that are traced next; asked: surfaces that ask lights."""

    x: int
    y: int
    width: int
    pixels: int
    first_sample: int
    samples: int
    fresh: int
    begun: int
    hits: int
    queued: int
    asked: int


@wp.struct
class Wave:
    """Samples are numbered pixel by pixel; there is room for `capacity`. By number: xi, lens_xi, what places a sample on the film
    and on the lens; done, the sum so far; size, traced: paths that wait, and rays so far; paths[level * capacity + number]: those
    that wait, and after them the one that is queued. pixel_keys: of the samples of each pixel, and pixels: where on the film it is.

    By place in the queue: number, rays, hits. By count of the surfaces that ask lights: asked (their sample's number), lit,
    scatter, and for light i from i * capacity on request: the place of its shadow ray, or -1. By place of a shadow ray, for light i
    from i * capacity on: value, shadow_rays, occluded. Where shadows are transparent, walks and shadow_hits are in place of
    occluded, and waiting: which walks the shadow rays are of. asking: the number of shadow rays to each light.

    met, missed: places in the queue of the rays that hit something and of the others, each in their order. By place in a block of
    BLOCK of the hits, and of those that missed: rows (wave_rows.py), wanted (wave_textures.py).
    """

    capacity: int
    job: wp.array(dtype=Job)
    order: wp.array(dtype=wp.int32)
    xi: wp.array(dtype=wp.vec2)
    lens_xi: wp.array(dtype=wp.vec2)
    done: wp.array(dtype=Sample)
    size: wp.array(dtype=wp.int32)
    traced: wp.array(dtype=wp.int32)
    pixel_keys: wp.array(dtype=wp.uint32)
    pixels: wp.array(dtype=wp.int32)
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
    met: wp.array(dtype=wp.int32)
    missed: wp.array(dtype=wp.int32)
    rows: wp.array(dtype=wp.float32)
    wanted: wp.array(dtype=wp.int32)


@wp.func
def enqueue(wave: Wave, k: int, number: int, path: Path):
    wave.number[k] = number
    put_ray(wave.rays, k, ray_of(path))


@wp.func
def pixel_of(job: Job, at: int, x: int, y: int, columns: int) -> int:
    """Where the pixel `at` of a tile is in a film that begins at x, y."""
    return (job.y + at / job.width - y) * columns + job.x + at % job.width - x


@wp.func_native("""
    auto& sample = samples.data[(long long)i];
    static_assert(sizeof(sample) == sizeof(radiance) + 16, "every field of Sample is stored");
    sample.radiance = radiance; sample.lost = lost;
    sample.rays = rays; sample.cut_depth = cut_depth; sample.cut_throughput = cut_throughput;
""")
def put_fields(samples: wp.array(dtype=Sample), i: int, radiance: wp.vec3, rays: int, cut_depth: int, cut_throughput: int,
               lost: float) -> None: ...


@wp.func
def put_sample(samples: wp.array(dtype=Sample), i: int, sample: Sample):
    """samples[i] = sample, field by field: a copy of the whole reads 16 bytes at a time what was written 4 at a time just before,
    and for that a core waits until it is in the cache."""
    put_fields(samples, i, sample.radiance, sample.rays, sample.cut_depth, sample.cut_throughput, sample.lost)


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
    """What the lights send to the surfaces that asked them."""

    @wp.func
    def gather(wave: Wave, lights: int):
        for a in range(wave.job[0].asked):
            direct = Shadow()
            light = wp.vec3()  # a struct that changes in a loop is written and read back
            rays = int(0)
            for i in range(lights):
                slot = wave.request[i * wave.capacity + a]
                if slot >= 0:
                    if wp.static(transparent_shadows):
                        direct = lit_by(direct, wave.value[slot], wave.scatter[a], wave.walks[slot].shadow)
                    else:
                        light += wp.where(wave.occluded[slot], 0.0, 1.0) * wave.value[slot]
                        rays += 1
            if wp.static(not transparent_shadows):
                direct.transmittance = light
                direct.rays = rays
            number = wave.asked[a]
            put_sample(wave.done, number, add_up(wave.done[number], wave.lit[a], direct))
        for i in range(lights):
            wave.asking[i] = 0
        wave.job[0].asked = 0

    return gather


@wp.func_native(source("loops/film_samples.h", LANES=LANES))
def add_to_pixels(film: Film, pixels: wp.array(dtype=wp.int32), done: wp.array(dtype=Sample), p: int, samples: int) -> None:
    """As with_sample, to the LANES entries of the film from pixels[p] on: done[p * samples] and what follows it."""


@wp.func
def add_to_film(wave: Wave, film: Film):
    """The samples of a wave to their pixels, in their order."""
    job = wave.job[0]
    for p in range(job.pixels):
        wave.pixels[p] = pixel_of(job, wave.order[p], film.x, film.y, film.columns)
    p = int(0)
    while p + LANES <= job.pixels:
        add_to_pixels(film, wave.pixels, wave.done, p, job.samples)
        p += LANES
    while p < job.pixels:
        pixel = load_pixel(film, wave.pixels[p])
        for j in range(job.samples):
            pixel = with_sample(pixel, wave.done[p * job.samples + j])
        store_pixel(film, wave.pixels[p], pixel)
        p += 1


@wp.struct
class WaveLaunches:
    """Those of a wave. shadow_hit: any hit; walk_hit: the closest one, with which go_through goes on."""

    begin: Launch
    closest_hit: Launch
    shade: Launch
    shadow_hit: Launch
    walk_hit: Launch
    go_through: Launch


@cache
def make_loop_kernel(transparent_shadows: bool) -> Any:
    """All of a wave, from its camera rays to the film."""
    gather = make_gather(transparent_shadows)

    @wp.func
    def ask_lights(wave: Wave, launches: WaveLaunches, lights: int):
        """All shadow rays, and what their surfaces send on."""
        for light in range(lights):
            first = light * wave.capacity
            if wp.static(transparent_shadows):
                while wave.asking[light] > 0:
                    run_range(launches.walk_hit, first, first + wave.asking[light])
                    run_with(launches.go_through, light)
            elif wave.asking[light] > 0:
                run_range(launches.shadow_hit, first, first + wave.asking[light])
        gather(wave, lights)

    @kernel
    def trace_wave(wave: Wave, launches: WaveLaunches, lights: int, film: Film):
        job = wave.job[0]
        wave.job[0].queued = 0
        wave.job[0].fresh = 1
        pixel = int(0)
        while pixel < job.pixels:
            end = wp.min(pixel + wp.max(FRESH / job.samples, 1), job.pixels)
            run_range(launches.begin, pixel, end)
            run_range(launches.closest_hit, pixel * job.samples, wave.job[0].begun)
            run_range(launches.shade, pixel * job.samples, wave.job[0].begun)
            pixel = end
        wave.job[0].fresh = 0
        while True:
            ask_lights(wave, launches, lights)
            queued = wave.job[0].queued
            if queued == 0:
                break
            wave.job[0].queued = 0
            run_range(launches.closest_hit, 0, queued)
            run_range(launches.shade, 0, queued)
        add_to_film(wave, film)

    return trace_wave


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
