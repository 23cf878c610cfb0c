"""Background kinds: the radiance of rays that miss, and samples of the background as a light. Each kind is an entry of BACKGROUNDS."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.rows import Rows
from wrt.kernels.shade.elementary import acos, atan2, near_sin_cos, sin_cos
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.sampling import PI, TWO_PI, cosine_point, rotated_to, search_cdf, share_of_row
from wrt.kernels.structs import Background

# --- the kinds --------------------------------------------------------------------------------------------------------
# Each kind is a function (background, unit direction in world space) -> radiance.


@wp.func
def constant(b: Background, direction: wp.vec3) -> wp.vec3:
    return b.bottom


@wp.func
def gradient(b: Background, direction: wp.vec3) -> wp.vec3:
    """Interpolate linearly in the direction's y, from `bottom` at -1 to `top` at 1."""
    return wp.lerp(b.bottom, b.top, 0.5 * (direction[1] + 1.0))


@wp.func
def rotation_of(angle: float) -> tuple[float, float]:
    """Return the sine and cosine of the background's rotation, in radians. Most backgrounds have the angle 0, which is fast."""
    sin = angle  # The bits of sin_cos for 0 and -0.
    cos = float(1.0)
    if angle != 0.0:
        sin, cos = sin_cos(angle)
    return sin, cos


@wp.func
def rotated(d: wp.vec3, sin: float, cos: float) -> wp.vec3:
    """Rotate d about +y, counter-clockwise seen from above, by the angle with this sine and cosine."""
    return wp.vec3(cos * d[0] + sin * d[2], d[1], cos * d[2] - sin * d[0])


@wp.func
def rotate_y(d: wp.vec3, angle: float) -> wp.vec3:
    sin, cos = rotation_of(angle)
    return rotated(d, sin, cos)


@wp.func
def environment_pixel(b: Background, column: int, row: int) -> wp.vec3:
    """Return the radiance of a pixel of the picture: columns wrap around, rows are clamped at the poles."""
    x = wp.where(column < 0, column + b.width, wp.where(column >= b.width, column - b.width, column))
    return b.pixels[wp.clamp(row, 0, b.height - 1) * b.width + x]


@wp.func
def environment_column(b: Background, x: float, z: float) -> float:
    """Return the column of a direction in the equirectangular picture, in pixels with a fraction."""
    return (0.5 + atan2(x, -z) / TWO_PI) * float(b.width) - 0.5


@wp.func
def environment_row(b: Background, y: float) -> float:
    return acos(wp.clamp(y, -1.0, 1.0)) / PI * float(b.height) - 0.5


@wp.func
def environment_at(b: Background, x: float, y: float) -> wp.vec3:
    """Return the bilinearly interpolated radiance at column x and row y of the picture."""
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    top = (1.0 - fx) * environment_pixel(b, column, row) + fx * environment_pixel(b, column + 1, row)
    low = (1.0 - fx) * environment_pixel(b, column, row + 1) + fx * environment_pixel(b, column + 1, row + 1)
    return b.scale * ((1.0 - fy) * top + fy * low)


@wp.func
def environment(b: Background, direction: wp.vec3) -> wp.vec3:
    """Return the picture's radiance in a unit direction (world space)."""
    d = rotate_y(direction, -b.rotation)
    return environment_at(b, environment_column(b, d[0], d[2]), environment_row(b, d[1]))


@wp.func_native("""
    float* const x = rows.data + (long long)at;
    wrt::environment_at(background, x, x + length, x + 2 * (long long)length, count);
""")
def environment_colors(background: Background, rows: wp.array(dtype=wp.float32), at: int, length: int, count: int) -> None:
    """Replace `count` positions in the picture by colours (environment_at). Column x becomes red, row y green; blue has a third array.

    The arrays begin at rows[at + n * length], n = 0, 1, 2, with room for LANES - 1 more entries. For lanes_kernel (loops/state.py)."""


def make_environment_block(directions: Rows, colors: Rows) -> Any:
    """Return environment_block(b, rows, count): store `environment` of the first `count` `directions` in `colors`, vectorised."""
    load_direction, store_place = directions.load(), colors.store()

    @wp.func
    def environment_block(b: Background, rows: wp.array(dtype=wp.float32), count: int):
        sin, cos = rotation_of(-b.rotation)
        i = int(0)
        while i < count:
            d = rotated(load_direction(rows, i), sin, cos)
            store_place(rows, i, wp.vec3(environment_column(b, d[0], d[2]), environment_row(b, d[1]), 0.0))
            i = i + 1
        environment_colors(b, rows, wp.static(colors.first * colors.length), wp.static(colors.length), count)

    return environment_block


@wp.func
def environment_place(b: Background, xi: wp.vec2) -> wp.vec3:
    """Draw a point of the picture with a density in proportion to the brightness of its pixel, and uniform within the pixel.

    Return row and column, in pixels with a fraction, and the probability of the pixel."""
    row = search_cdf(b.row_cdf, 0, b.height, xi[0])
    first = row * b.width
    column = search_cdf(b.column_cdf, first, b.width, xi[1])
    p_row = share_of_row(b.row_cdf, 0, row)
    p_column = share_of_row(b.column_cdf, first, column)
    # The position of xi within its interval of the cdf is uniform again. It places the point within the pixel.
    v = 1.0 - (b.row_cdf[row] - xi[0]) / p_row
    u = 1.0 - (b.column_cdf[first + column] - xi[1]) / p_column
    return wp.vec3(float(row) + wp.clamp(v, 0.0, 1.0), float(column) + wp.clamp(u, 0.0, 1.0), p_row * p_column)


@wp.func_native("""
    float* const x = rows.data + (long long)at;
    wrt::environment_place(background, x, x + length, x + 2 * (long long)length, count);
""")
def environment_places(background: Background, rows: wp.array(dtype=wp.float32), at: int, length: int, count: int) -> None:
    """Replace `count` pairs of random numbers by the results of environment_place. The arrays are as in environment_colors."""


@wp.func
def environment_direction(b: Background, place: wp.vec3, sin: float, cos: float) -> tuple[wp.vec3, float]:
    """Return the unit direction of an environment_place, and its density per steradian. sin, cos: result of rotation_of(b.rotation)."""
    sin_theta, cos_theta = near_sin_cos(PI * place[0] / float(b.height))
    sin_phi, cos_phi = near_sin_cos(TWO_PI * (place[1] / float(b.width) - 0.5))
    density = place[2] * float(b.width * b.height) / (TWO_PI * PI * wp.max(sin_theta, 1.0e-9))
    return rotated(wp.vec3(sin_theta * sin_phi, cos_theta, -sin_theta * cos_phi), sin, cos), density


@wp.func
def environment_sample(b: Background, xi: wp.vec2) -> LightSample:
    """Sample a direction with a density in proportion to the picture's brightness, uniform in angle within a pixel."""
    sin, cos = rotation_of(b.rotation)
    wi, density = environment_direction(b, environment_place(b, xi), sin, cos)
    sample = LightSample()
    sample.wi = wi
    sample.weight = environment(b, wi) / density
    return sample


def make_environment_samples(points: Rows, samples: Rows) -> Any:
    """Return environment_samples(b, rows, count): store `environment_sample` of the first `count` points in `samples`, vectorised.

    points: rows of vec3 with random numbers x and y, which are overwritten. samples: rows of LightSample, whose wi and weight are set."""
    load_place, store_place = points.load(), points.store()
    wi, weight = samples.field("wi"), samples.field("weight")
    store_wi, load_weight, store_weight = wi.store(), weight.load(), weight.store()
    look_up = make_environment_block(wi, weight)

    @wp.func
    def environment_samples(b: Background, rows: wp.array(dtype=wp.float32), count: int):
        environment_places(b, rows, wp.static(points.first * points.length), wp.static(points.length), count)
        sin, cos = rotation_of(b.rotation)
        i = int(0)
        while i < count:
            direction, density = environment_direction(b, load_place(rows, i), sin, cos)
            store_wi(rows, i, direction)
            store_place(rows, i, wp.vec3(density, 0.0, 0.0))
            i = i + 1
        look_up(b, rows, count)
        i = int(0)
        while i < count:
            w = load_weight(rows, i)
            density = load_place(rows, i)[0]
            store_weight(rows, i, wp.vec3(w[0] / density, w[1] / density, w[2] / density))
            i = i + 1

    return environment_samples


class BackgroundKind(NamedTuple):
    """The device functions of a kind of background."""

    radiance: Any  # (background, direction) -> radiance.
    sample: Any = None  # (background, xi) -> LightSample with wi and weight. None: sample by the cosine.
    make_block_radiance: Any = None  # Vectorised `radiance`, with the signature of make_environment_block. None: it is not faster.
    make_block_samples: Any = None  # Vectorised `sample`, with the signature of make_environment_samples.


# The keys are the names in wrt.scene.backgrounds.BACKGROUNDS.
BACKGROUNDS = {
    "constant": BackgroundKind(constant),
    "gradient": BackgroundKind(gradient),
    "environment": BackgroundKind(environment, environment_sample, make_environment_block, make_environment_samples),
}


# --- the kind of a scene ------------------------------------------------------------------------------------------------------


def make_sky_point(features: Features) -> Any:
    """Return sky_point(xi) -> vec3 for sky_sample: cosine_point(xi), or (xi[0], xi[1], 0) if the kind has a `sample`. Branch-free."""
    of_cosine = BACKGROUNDS[features.background].sample is None

    @wp.func
    def sky_point(xi: wp.vec2) -> wp.vec3:
        if wp.static(of_cosine):
            return cosine_point(xi)
        return wp.vec3(xi[0], xi[1], 0.0)

    return sky_point


def make_sky_sample(features: Features) -> Any:
    """Return sky_sample(b, n, point) -> LightSample of the background at a surface with normal n. `point` comes from sky_point."""
    kind = BACKGROUNDS[features.background]
    radiance, sample_of_kind = kind.radiance, kind.sample

    @wp.func
    def sky_sample(b: Background, n: wp.vec3, point: wp.vec3) -> LightSample:
        sample = LightSample()
        if wp.static(sample_of_kind is None):
            sample.wi = rotated_to(point, n)
            cosine = wp.max(wp.dot(sample.wi, n), 1.0e-9)
            sample.weight = radiance(b, sample.wi) * (PI / cosine)
        else:
            sample = sample_of_kind(b, wp.vec2(point[0], point[1]))
        sample.distant = 1
        sample.area = 1
        return sample

    return sky_sample
