"""The kernels that make pictures: camera, integrator, film."""

from typing import Any

import warp as wp

from wrt.kernels.shade.loop import make_radiance
from wrt.kernels.shade.sampling import hash_pair, make_sample_2d, quantile
from wrt.kernels.shade.shading import make_cutout, make_shading
from wrt.kernels.shade.step import Sample
from wrt.kernels.structs import AovFilm, Film, Hit, Lighting, Limits, Ray, Surfaces, Tile, kernel


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


@wp.struct
class Pixel:
    """An entry of the film (Film) while samples are added to it."""

    mean: wp.vec3
    m2: wp.vec3
    samples: int
    rays: wp.int64
    cut_depth: int
    cut_throughput: int
    lost: float
    not_finite: int


@wp.func
def load_pixel(film: Film, i: int) -> Pixel:
    pixel = Pixel()
    pixel.mean = film.mean[i]
    pixel.m2 = film.m2[i]
    pixel.samples = film.samples[i]
    pixel.rays = film.rays[i]
    pixel.cut_depth = film.cut_depth[i]
    pixel.cut_throughput = film.cut_throughput[i]
    pixel.lost = film.lost[i]
    pixel.not_finite = film.not_finite[i]
    return pixel


@wp.func
def store_pixel(film: Film, i: int, pixel: Pixel):
    film.mean[i] = pixel.mean
    film.m2[i] = pixel.m2
    film.samples[i] = pixel.samples
    film.rays[i] = pixel.rays
    film.cut_depth[i] = pixel.cut_depth
    film.cut_throughput[i] = pixel.cut_throughput
    film.lost[i] = pixel.lost
    film.not_finite[i] = pixel.not_finite


@wp.func
def with_sample(before: Pixel, sample: Sample) -> Pixel:
    pixel = before
    color = sample.radiance
    if not wp.isfinite(color[0] + color[1] + color[2]):
        pixel.not_finite += 1
        color = wp.vec3(0.0, 0.0, 0.0)
    pixel.samples += 1
    delta = color - pixel.mean
    pixel.mean = pixel.mean + delta / float(pixel.samples)
    pixel.m2 = pixel.m2 + wp.cw_mul(delta, color - pixel.mean)
    pixel.rays += wp.int64(sample.rays)
    pixel.cut_depth += sample.cut_depth
    pixel.cut_throughput += sample.cut_throughput
    pixel.lost += sample.lost
    return pixel


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


@wp.func
def center_of(x: int, y: int, width: int, height: int) -> wp.vec2:
    """Where on the film a pixel has its center."""
    return wp.vec2((float(x) + 0.5) / float(width), (float(y) + 0.5) / float(height))


def make_see(features: Any) -> Any:
    """What a pixel's center shows."""
    surface_at, look_up, resolve, shading_normal, _, _ = make_shading(features)

    @wp.func
    def see(film: AovFilm, pixel: int, surfaces: Surfaces, ray: Ray, hit: Hit):
        """hit: the closest one of `ray`, or a miss."""
        film.depth[pixel] = hit.t
        film.prim_id[pixel] = hit.prim_id
        film.material_id[pixel] = -1
        if hit.prim_id >= 0:
            s = surface_at(surfaces, ray, hit)
            texels = look_up(surfaces, s)
            m = resolve(surfaces, s, texels)
            film.normal[pixel] = shading_normal(surfaces, s, texels, -ray.direction)
            film.albedo[pixel] = m.albedo
            film.material_id[pixel] = s.material

    return see


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
