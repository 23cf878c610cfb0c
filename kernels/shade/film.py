"""The film: adds samples to pixels, and writes the AOVs (depth, normal, albedo, ids) of a pixel's hit."""

from typing import Any

import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.step import Sample, mean3
from wrt.kernels.structs import AovFilm, Film, Hit, Ray, Surfaces


@wp.struct
class Pixel:
    """A local copy of one pixel of a Film (kernels/structs.py), whose arrays have the same names."""

    mean: wp.vec3
    m2: wp.vec3
    samples: int
    rays: wp.int64
    cut_depth: int
    cut_throughput: int
    lost: float
    not_finite: int
    clamped: float


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
    pixel.clamped = film.clamped[i]
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
    film.clamped[i] = pixel.clamped


@wp.func
def add_sample(before: Pixel, sample: Sample, clamp: float) -> Pixel:
    """Add a sample to mean and sum of squared deviations (Welford 1962). If its radiance is not finite, count it and add black.

    clamp: Film.clamp."""
    pixel = before
    color = sample.radiance
    if not wp.isfinite(color[0] + color[1] + color[2]):
        pixel.not_finite += 1
        color = wp.vec3(0.0, 0.0, 0.0)
    largest = wp.max(color)
    if clamp > 0.0 and largest > clamp:
        color = (clamp / largest) * color
        pixel.clamped += mean3(sample.radiance - color)
    pixel.samples += 1
    delta = color - pixel.mean
    pixel.mean = pixel.mean + delta / float(pixel.samples)
    pixel.m2 = pixel.m2 + wp.cw_mul(delta, color - pixel.mean)
    pixel.rays += wp.int64(sample.rays)
    pixel.cut_depth += sample.cut_depth
    pixel.cut_throughput += sample.cut_throughput
    pixel.lost += sample.lost
    return pixel


@wp.func
def pixel_center(x: int, y: int, width: int, height: int) -> wp.vec2:
    """Return the centre of a pixel on the film, in [0, 1]^2."""
    return wp.vec2((float(x) + 0.5) / float(width), (float(y) + 0.5) / float(height))


def make_write_aovs(features: Features) -> Any:
    """Return write_aovs(film, pixel, surfaces, ray, hit)."""
    surface_at, look_up, resolve, shading_normal, _, _ = make_shading(features)

    @wp.func
    def write_aovs(film: AovFilm, pixel: int, surfaces: Surfaces, ray: Ray, hit: Hit):
        """Write the AOVs of `hit`, the closest hit of `ray` or a miss, to entry `pixel` of the film."""
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

    return write_aovs
