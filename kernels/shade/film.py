"""The film: adds samples to pixels, and writes the AOVs (depth, normal, albedo, ids) of a pixel's hit."""

from typing import Any

import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.shade.shading import make_shading
from wrt.kernels.shade.step import Sample, mean3
from wrt.kernels.structs import Hit, Ray, Surfaces
from wrt.kernels.warp_private import fields_of


@wp.struct
class Film:
    """Running mean, sum of squared deviations (Welford 1962), number of samples, and cost of each pixel, row by row.
    The arrays hold the rectangle of the image that begins at pixel (x, y) and is `columns` pixels wide."""

    width: int  # width, height: size of the whole image in pixels.
    height: int
    x: int
    y: int
    columns: int
    mean: wp.array(dtype=wp.vec3)  # Running mean of the samples' radiance.
    m2: wp.array(dtype=wp.vec3)  # Sum of squared deviations from the mean.
    samples: wp.array(dtype=wp.int32)  # Number of samples.
    rays: wp.array(dtype=wp.int64)  # Number of closest-hit and any-hit rays.
    cut_depth: wp.array(dtype=wp.int32)  # Number of rays cut by max_depth.
    cut_throughput: wp.array(dtype=wp.int32)  # Number of rays cut by min_throughput.
    lost: wp.array(dtype=wp.float32)  # Sum of the throughputs of the cut rays, each averaged over the colour channels.
    not_finite: wp.array(dtype=wp.int32)  # Number of samples that were NaN or infinite; they enter the mean as 0.
    clamp: float  # Largest radiance of a sample in any channel; brighter samples are scaled down to it. 0: no limit.
    clamped: wp.array(dtype=wp.float32)  # Sum of the radiance that this took from samples, averaged over the colour channels.
    filter_icdf: wp.array(dtype=wp.float32)  # Inverse cumulative distribution of the pixel filter along x or y, in pixels.


@wp.struct
class AovFilm:
    """Layers of the first hit of the ray through each pixel's centre (wrt.picture.film.Film). width .. columns: as in Film."""

    width: int
    height: int
    x: int
    y: int
    columns: int
    depth: wp.array(dtype=wp.float32)
    normal: wp.array(dtype=wp.vec3)
    albedo: wp.array(dtype=wp.vec3)
    prim_id: wp.array(dtype=wp.int32)
    material_id: wp.array(dtype=wp.int32)


@wp.struct
class Pixel:
    """A local copy of one pixel of a Film, whose arrays have the same names."""

    mean: wp.vec3
    m2: wp.vec3
    samples: int
    rays: wp.int64
    cut_depth: int
    cut_throughput: int
    lost: float
    not_finite: int
    clamped: float


@wp.func_native("\n".join(f"pixel.{name} = film.{name}.data[(long long)i];" for name in fields_of(Pixel)))
def fill(film: Film, i: int, pixel: wp.ref[Pixel]) -> None: ...


@wp.func
def load_pixel(film: Film, i: int) -> Pixel:
    pixel = Pixel()
    fill(film, i, pixel)
    return pixel


@wp.func_native("\n".join(f"film.{name}.data[(long long)i] = pixel.{name};" for name in fields_of(Pixel)))
def store_pixel(film: Film, i: int, pixel: Pixel) -> None: ...


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
