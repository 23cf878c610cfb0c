"""Cases for shading.cpp: counts around multiples of the lanes, bad coordinates and samples, with the results of the scalar kernels."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.kernel_tools import DEVICE, floats, ints, launch, vec2s, zeros  # isort: skip (starts Warp)
import warp as wp

from tests.kernels.shade.test_textures import picture, surfaces_with, texture_kernel
from tests.kernels.shade.test_twins import OF_FILM, pixel_kernel, quantile_kernel
from wrt.core.device import records, upload
from wrt.kernels.shade.backgrounds import environment_at
from wrt.kernels.shade.film import Film
from wrt.kernels.shade.sampling import LANES, hash_pair, sample_2d
from wrt.kernels.shade.step import Sample
from wrt.kernels.structs import Background, kernel
from wrt.renderer.upload import upload_scene
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.materials import Texture
from wrt.scene.model import Scene

COUNTS = (1, 2, 15, 16, 17, 31, 32, 33, 48, 63, 64)
POINTS, QUANTILES, SKY, TEXELS, PIXELS = (np.int32([kind]) for kind in range(5))


@kernel
def points_kernel(key: wp.uint32, first: int, seed: wp.array(dtype=wp.uint32), out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    seed[0] = hash_pair(key, wp.uint32(1))
    out[i] = sample_2d(key, wp.uint32(first + i), 1)


def points() -> Iterator[list[np.ndarray]]:
    for n in COUNTS:
        for key, first in ((0, 0), (0xFFFFFFFF, 5), (77, 0x7FFFFFFF - n)):
            seed, out = zeros(1, wp.uint32), zeros(n, wp.vec2)
            launch(points_kernel, n, wp.uint32(key), first, seed, out)
            yield [POINTS, np.concatenate([seed.numpy().view(np.int32), np.int32([first, n])]), out.numpy()]


def quantiles(rng: np.random.Generator) -> Iterator[list[np.ndarray]]:
    for n in COUNTS:
        icdf, values = np.sort(rng.normal(size=33)).astype(np.float32), rng.random((n, 2)).astype(np.float32)
        values[0] = 0.0, np.nextafter(np.float32(1.0), np.float32(0.0))
        out = zeros(values.shape)
        launch(quantile_kernel, values.shape, floats(icdf), wp.array(values, device=DEVICE), out)
        yield [QUANTILES, icdf, values, out.numpy()]


@kernel
def sky_kernel(b: Background, x: wp.array(dtype=float), y: wp.array(dtype=float), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = environment_at(b, x[i], y[i])


def skies(rng: np.random.Generator) -> Iterator[list[np.ndarray]]:
    """Yield lookups in environments up to half a pixel beside the image, where the seam and the poles are."""
    for height, width in ((1, 1), (1, 7), (5, 1), (5, 8)):
        image = rng.random((height, width, 3)).astype(np.float32)
        b = upload_scene(Scene(background=EnvironmentBackground(image, scale=1.5)), DEVICE).lighting.background
        for n in COUNTS:
            x, y = (rng.uniform(-0.5, size - 0.5, n).astype(np.float32) for size in (width, height))
            x[0], y[-1] = -0.5, height - 0.5
            out = zeros(n, wp.vec3)
            launch(sky_kernel, n, b, floats(x), floats(y), out)
            yield [SKY, np.int32([width, height]), np.float32([b.scale]), b.pixels.numpy(), x, y, *out.numpy().T]


def texels(rng: np.random.Generator) -> Iterator[list[np.ndarray]]:
    """Yield lookups in textures of 1x1 texels and larger, with every wrap mode; uv near, far, and not finite."""
    wraps = [(u, v) for u in ("repeat", "clamp", "mirror") for v in ("repeat", "clamp", "mirror")]
    pictures = [Texture(picture(rng, 1 + i, 1 + 2 * i), srgb=i % 2 == 0, wrap=wrap) for i, wrap in enumerate(wraps)]
    surfaces = surfaces_with(pictures)
    arrays = [surfaces.textures.numpy(), surfaces.texels.numpy()[:-1], surfaces.srgb_to_linear.numpy()]
    for n in COUNTS:
        for scale in (0.5, 4.0, 1e3, 1e12, 1e38):
            for mask in (15, 7, 6, 1, 8):
                room = -(-n // LANES) * LANES
                index, uv = np.full(room, -1, np.int32), rng.uniform(-scale, scale, (room, 2)).astype(np.float32)
                index[:n] = rng.integers(-1, len(pictures), n)
                uv[rng.random((room, 2)) < 0.1] = rng.choice([0.0, -0.0, 1.0, -1.0, np.nan, np.inf])
                out = zeros(n, wp.vec4)
                launch(texture_kernel(True, False), n, surfaces, ints(index[:n]), vec2s(uv[:n]), out)
                expected = out.numpy().T[[c for c in range(4) if mask >> c & 1]]
                yield [TEXELS, *arrays, index, np.int32([n, mask]), *uv.T, expected]


def pixels(rng: np.random.Generator) -> Iterator[list[np.ndarray]]:
    for samples in (0, 1, 5, 16):
        n, done = 3 * LANES, records(Sample, LANES * samples)
        done["radiance"] = rng.lognormal(size=(len(done), 3)) * rng.choice([0.0, 1e-30, 1e20], (len(done), 1))
        done["radiance"][rng.random(len(done)) < 0.1, 1] = rng.choice([np.nan, np.inf, 3e38])
        done["lost"] = rng.random(len(done))
        for name in ("rays", "cut_depth", "cut_throughput"):
            done[name] = rng.integers(0, 1 << 30 if name == "rays" else 9, len(done))
        order, film = rng.permutation(n)[: 2 * LANES].astype(np.int32), Film()
        for name, dtype in OF_FILM.items():
            setattr(film, name, zeros(n, dtype))
        film.clamped = zeros(n, wp.float32)
        launch(pixel_kernel, 1, film, upload(order, wp.int32, DEVICE), upload(done, Sample, DEVICE), 0, samples)
        yield [PIXELS, order, np.int32([n]), done, *(getattr(film, name).numpy() for name in OF_FILM)]


def write_cases(path: Path) -> None:
    """Write each array behind its number of bytes, an int32."""
    rng = np.random.default_rng(1)
    with path.open("wb") as file:
        for cases in (points(), quantiles(rng), skies(rng), texels(rng), pixels(rng)):
            for arrays in cases:
                for array in arrays:
                    data = np.ascontiguousarray(array).tobytes()
                    file.write(np.int32(len(data)).tobytes() + data)
