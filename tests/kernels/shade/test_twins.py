"""Vectorised C++ functions have the bits of their twins: scalar functions in Python.

A native Warp function only calls the C++ function. The C++ function has its twin's name, and its header the name of the twin's file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, cpu_only, floats, ints, launch, unit, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from tests.data import ROOT
from tests.kernels.shade.test_lights import environment_kernel
from tests.kernels.shade.test_textures import look_up, picture, surfaces_with
from wrt.core.device import records, upload
from wrt.kernels.loops.state import BLOCK, HEADERS, lanes_kernel
from wrt.kernels.loops.wave import add_to_pixels
from wrt.kernels.loops.wave_hits import make_sample_texture
from wrt.kernels.rows import Rows
from wrt.kernels.shade import backgrounds, sampling, textures
from wrt.kernels.shade import film as film_file
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.film import Film, add_sample, load_pixel, store_pixel
from wrt.kernels.shade.sampling import LANES, make_draw, quantile, quantiles, sample_2d
from wrt.kernels.shade.step import Sample
from wrt.kernels.structs import Background, Surfaces, kernel
from wrt.renderer.upload import upload_scene
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.materials import Texture
from wrt.scene.model import Scene

AT = 3
draw = make_draw(Features())


@lanes_kernel
def points_kernel(key: wp.uint32, first: int, n: int, lanes: wp.array(dtype=wp.vec2), single: wp.array(dtype=wp.vec2)):
    draw(key, 1, first, n, lanes, AT)
    for i in range(n):
        single[AT + i] = sample_2d(key, wp.uint32(first + i), 1)


def check_points() -> None:
    """Compare sample_points with sample_2d for several first indices and counts."""
    for key, first in ((0, 0), (0xFFFFFFFF, 5), (0x12345678, (1 << 20) - 7), (77, 0x7FFFFFFF - 37)):
        for n in (1, 7, 8, 9, 12, 16, 37):
            room = AT + LANES * -(-n // LANES)
            on_device = [zeros(room + 1, wp.vec2), zeros(room + 1, wp.vec2)]
            launch(points_kernel, 1, wp.uint32(key), first, n, *on_device)
            lanes, single = (array.numpy() for array in on_device)
            np.testing.assert_array_equal(lanes[: AT + n].view(np.int32), single[: AT + n].view(np.int32))
            drawn = lanes.any(axis=1)
            assert drawn[AT : AT + n].sum() >= n - 1 and not drawn[:AT].any() and not drawn[room:].any()


@lanes_kernel
def quantiles_kernel(icdf: wp.array(dtype=wp.float32), points: wp.array(dtype=wp.vec2), n: int):
    quantiles(icdf, points, AT, n)


@kernel
def quantile_kernel(icdf: wp.array(dtype=wp.float32), values: wp.array2d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
    i, k = wp.tid()
    out[i, k] = quantile(icdf, values[i, k])


def check_quantiles() -> None:
    for n in (1, 7, 8, 9, 16, 41):
        icdf = floats(np.sort(np.random.default_rng(n).normal(size=33)))
        values = np.random.default_rng(n + 1).random((AT + n + 1, 2)).astype(np.float32)
        values[AT : AT + 2, 0] = 0.0, np.nextafter(np.float32(1.0), np.float32(0.0))
        points, single = wp.array(values, dtype=wp.vec2, device="cpu"), zeros(values.shape)
        launch(quantiles_kernel, 1, icdf, points, n)
        launch(quantile_kernel, values.shape, icdf, wp.array(values, device="cpu"), single)
        expected = np.concatenate([values[:AT], single.numpy()[AT : AT + n], values[AT + n :]])  # The other values stay unchanged.
        np.testing.assert_array_equal(points.numpy().view(np.int32), expected.view(np.int32))


DIRECTIONS = Rows(wp.vec3, 97)
COLORS = Rows(wp.vec3, 97, DIRECTIONS.end)
seen = backgrounds.make_environment_block(DIRECTIONS, COLORS)


@lanes_kernel
def seen_kernel(b: Background, rows: wp.array(dtype=float), count: int):
    seen(b, rows, count)


def check_environment() -> None:
    """Compare directions, also at the seam and the poles. Values behind the last direction are arbitrary."""
    for rotation in (0.0, 0.7):
        rng = np.random.default_rng(1)
        axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-0.0, 1, -0.0], [0.5**0.5, 0, 0.5**0.5]])
        direction = np.concatenate([unit(rng.normal(size=(71, 3))), axes, -axes])
        n = len(direction)
        assert n + LANES == COLORS.length
        sky = EnvironmentBackground(rng.random((5, 8, 3)), rotation=rotation, scale=1.5)
        b = upload_scene(Scene(background=sky), DEVICE).lighting.background
        rows = np.full((COLORS.end, COLORS.length), np.nan)
        rows[:3, :n] = direction.T
        lanes, expected = floats(rows.ravel()), zeros(n, wp.vec3)
        launch(seen_kernel, 1, b, lanes, n)
        launch(environment_kernel, n, b, vec3s(direction), expected)
        found = lanes.numpy().reshape(COLORS.end, -1)[3:, :n].T.copy()
        np.testing.assert_array_equal(found.view(np.int32), expected.numpy().view(np.int32))


@lanes_kernel
def places_kernel(b: Background, rows: wp.array(dtype=float), length: int, count: int):
    backgrounds.environment_places(b, rows, 0, length, count)


@kernel
def place_kernel(b: Background, numbers: wp.array(dtype=wp.vec2), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = backgrounds.environment_place(b, numbers[i])


def check_places() -> None:
    """Compare random numbers, also at both ends and on the entries of the distributions, in pictures of several sizes with black parts."""
    for size in ((1, 1), (2, 3), (5, 8), (33, 17)):
        rng = np.random.default_rng(size[0])
        pixels = rng.random((*size, 3)) * (rng.random(size) < 0.6)[..., None]
        pixels[-1, 0] = 1.0
        b = upload_scene(Scene(background=EnvironmentBackground(pixels)), DEVICE).lighting.background
        ends = np.array([0.0, np.nextafter(np.float32(1.0), np.float32(0.0))], np.float32)
        special = np.concatenate([ends, b.row_cdf.numpy(), b.column_cdf.numpy()])
        numbers = rng.random((300, 2)).astype(np.float32)
        numbers = np.where(rng.random(numbers.shape) < 0.5, rng.choice(special[special < 1.0], numbers.shape), numbers)
        for n in (1, 16, 300):
            length = n + LANES
            rows, expected = np.full((3, length), np.nan), zeros(n, wp.vec3)
            rows[:2, :n] = numbers[:n].T
            lanes = floats(rows.ravel())
            launch(places_kernel, 1, b, lanes, length, n)
            launch(place_kernel, n, b, wp.array(numbers[:n], dtype=wp.vec2, device=DEVICE), expected)
            found = lanes.numpy().reshape(3, length)[:, :n].T.copy()
            np.testing.assert_array_equal(found.view(np.int32), expected.numpy().view(np.int32))


@wp.func_native(f"""
    const float *const us = uv.data, *const vs = us + {BLOCK};
    wrt::sample_texture<{BLOCK}>(surfaces, wanted.data, us, vs, count, channels, out.data);
""")
def sample_lanes(surfaces: Surfaces, wanted: wp.array(dtype=wp.int32), uv: wp.array(dtype=float), count: int, channels: int,
                 out: wp.array(dtype=float)) -> None: ...


@lanes_kernel
def textures_kernel(surfaces: Surfaces, wanted: wp.array(dtype=wp.int32), uv: wp.array(dtype=float), count: int, channels: int,
                    out: wp.array(dtype=float)):
    sample_lanes(surfaces, wanted, uv, count, channels, out)


def in_lanes(surfaces: Any, index: Any, uv: np.ndarray, channels: int = 15) -> np.ndarray:
    """Return the requested channels, then NaN, (N, 4). Values behind the last index are arbitrary, as in a block that is not full."""
    wanted, coordinates = np.full(BLOCK, -1), np.full((2, BLOCK), np.nan, np.float32)
    wanted[: len(uv)], coordinates[:, : len(uv)] = index, uv.T
    out = floats(np.full(4 * BLOCK, np.nan))
    launch(textures_kernel, 1, surfaces, ints(wanted), floats(coordinates.ravel()), len(uv), channels, out)
    return np.asarray(out.numpy().reshape(4, BLOCK)[:, : len(uv)].T)


def check_textures() -> None:
    """Compare look-ups in several pictures, with every wrap mode, near and far coordinates, and without a picture."""
    for count in (1, 17, 64):
        rng = np.random.default_rng(count)
        wraps = [(u, v) for u in ("repeat", "clamp", "mirror") for v in ("repeat", "clamp", "mirror")]
        turned = np.array([[1.5, 0.25, -3.0], [0.125, -2.0, 0.5]])
        pictures = [Texture(picture(rng, 1 + i, 1 + 2 * i), srgb=i % 2 == 0, wrap=wrap) for i, wrap in enumerate(wraps)]
        pictures += [replace(each, uv_transform=turned, srgb=not each.srgb) for each in pictures]  # They share the texels.
        surfaces = surfaces_with(pictures)
        for scale in (0.5, 1.5, 4.0, 1e3, 1e12):
            for _ in range(20):
                index, uv = rng.integers(-1, len(pictures), count), rng.uniform(-scale, scale, (count, 2)).astype(np.float32)
                uv[rng.random((count, 2)) < 0.05] = rng.choice([0.0, -0.0, 1.0, -1.0, np.nan, np.inf])
                expected = look_up(pictures, index, uv).astype(np.float32)
                found = in_lanes(surfaces, index, uv)
                same = (found.view(np.int32) == expected.view(np.int32)) | (np.isnan(found) & np.isnan(expected))
                assert same.all(), (uv[~same.all(axis=1)], index[~same.all(axis=1)])


@cpu_only
def test_only_the_channels_that_are_asked_for_are_written() -> None:
    rng = np.random.default_rng(3)
    texture = Texture(picture(rng))
    uv = rng.random((20, 2)).astype(np.float32)
    expected = look_up([texture], 0, uv)
    for mask in (1, 6, 7, 8, 15):
        found, asked = in_lanes(surfaces_with([texture]), 0, uv, mask), [channel for channel in range(4) if mask >> channel & 1]
        np.testing.assert_array_equal(found[:, : len(asked)], expected[:, asked])
        assert np.isnan(found[:, len(asked) :]).all()


OF_FILM = {"mean": wp.vec3, "m2": wp.vec3, "samples": wp.int32, "rays": wp.int64, "cut_depth": wp.int32, "cut_throughput": wp.int32,
           "lost": wp.float32, "not_finite": wp.int32}


@lanes_kernel
def pixels_kernel(film: Film, pixels: wp.array(dtype=wp.int32), done: wp.array(dtype=Sample), first: int, samples: int):
    add_to_pixels(film, pixels, done, first, samples)


@kernel
def pixel_kernel(film: Film, pixels: wp.array(dtype=wp.int32), done: wp.array(dtype=Sample), first: int, samples: int):
    for p in range(first, first + LANES):
        pixel = load_pixel(film, pixels[p])
        for j in range(samples):
            pixel = add_sample(pixel, done[p * samples + j], film.clamp)
        store_pixel(film, pixels[p], pixel)


def check_film() -> None:
    for samples in (1, 5, 16):
        rng = np.random.default_rng(samples)
        pixels, n = 3 * LANES, 100
        done = records(Sample, pixels * samples)
        done["radiance"] = rng.lognormal(size=(len(done), 3)) * rng.choice([0.0, 1e-30, 1.0, 1e20], (len(done), 1))
        done["radiance"][rng.random(len(done)) < 0.1, 1] = np.nan
        done["radiance"][rng.random(len(done)) < 0.1, 0] = np.inf
        done["radiance"][rng.random(len(done)) < 0.1] = np.float32(3e38)  # The channels are finite, but their sum is not.
        for name in ("rays", "cut_depth", "cut_throughput"):
            done[name] = rng.integers(0, 1 << 30 if name == "rays" else 9, len(done))
        done["lost"] = rng.random(len(done))
        order = rng.permutation(n)[: pixels + LANES].astype(np.int32)
        films = []
        for kind in (pixels_kernel, pixel_kernel):
            film: Any = Film()
            arrays = {name: zeros(n, dtype) for name, dtype in OF_FILM.items()}
            for name, array in arrays.items():
                setattr(film, name, array)
            film.clamped = zeros(n, wp.float32)  # the vectorised code clamps nothing
            for _ in range(2):
                launch(kind, 1, film, upload(order, wp.int32, DEVICE), upload(done, Sample, DEVICE), LANES, samples)
            films.append({name: array.numpy() for name, array in arrays.items()})
        touched = order[LANES : 2 * LANES]
        assert (films[0]["samples"][touched] == 2 * samples).all() and films[0]["samples"].sum() == 2 * samples * LANES
        assert films[0]["not_finite"].sum() > 0 and (samples < 16 or films[0]["rays"].max() > 1 << 31)
        for name in OF_FILM:
            np.testing.assert_array_equal(films[0][name].view(np.uint8), films[1][name].view(np.uint8), err_msg=name)


class Twin(NamedTuple):
    """A native function and the name of its scalar twin in `file`. `check` asserts that both have the same bits."""

    native: Any
    file: Any
    name: str
    check: Callable[[], None]


TWINS = (
    Twin(sampling.sample_points, sampling, "sample_2d", check_points),
    Twin(quantiles, sampling, "quantile", check_quantiles),
    Twin(make_sample_texture("albedo_texture"), textures, "sample_texture", check_textures),
    Twin(backgrounds.environment_colors, backgrounds, "environment_at", check_environment),
    Twin(backgrounds.environment_places, backgrounds, "environment_place", check_places),
    Twin(add_to_pixels, film_file, "add_sample", check_film),
)


@cpu_only
@pytest.mark.parametrize("twin", TWINS, ids=lambda twin: twin.name)
def test_twins_have_the_same_bits(twin: Twin) -> None:
    twin.check()


@pytest.mark.parametrize("twin", TWINS, ids=lambda twin: twin.name)
def test_a_native_function_calls_its_twins_name_in_the_header_beside_it(twin: Twin) -> None:
    header = f"shade/{twin.file.__name__.split('.')[-1]}.h"
    assert f"wrt::{twin.name}" in twin.native.native_snippet
    assert f" {twin.name}(" in (ROOT / "kernels" / header).read_text()
    assert header in HEADERS
    assert f"def {twin.name}(" in (ROOT / "kernels" / header).with_suffix(".py").read_text()


def test_each_header_has_a_twin() -> None:
    folder = ROOT / "kernels" / "shade"
    assert {f"shade/{path.name}" for path in folder.glob("*.h")} == set(HEADERS)
    assert {path.stem for path in folder.glob("*.h")} == {twin.file.__name__.split(".")[-1] for twin in TWINS}
