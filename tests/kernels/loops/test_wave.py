"""What waves are made of, piece by piece."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, cpu_only, launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.core.device import records, upload
from wrt.kernels.loops.wave import LANES, add_to_pixels
from wrt.kernels.shade.film import load_pixel, store_pixel, with_sample
from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.shade.step import Sample
from wrt.kernels.structs import Film, kernel, unit

OF_FILM = {"mean": wp.vec3, "m2": wp.vec3, "samples": wp.int32, "rays": wp.int64, "cut_depth": wp.int32, "cut_throughput": wp.int32,
           "lost": wp.float32, "not_finite": wp.int32}


@kernel
def in_lanes(film: Film, pixels: wp.array(dtype=wp.int32), done: wp.array(dtype=Sample), first: int, samples: int):
    add_to_pixels(film, pixels, done, first, samples)


@kernel
def one_by_one(film: Film, pixels: wp.array(dtype=wp.int32), done: wp.array(dtype=Sample), first: int, samples: int):
    for p in range(first, first + LANES):
        pixel = load_pixel(film, pixels[p])
        for j in range(samples):
            pixel = with_sample(pixel, done[p * samples + j])
        store_pixel(film, pixels[p], pixel)


@cpu_only
@pytest.mark.parametrize("samples", [1, 5, 16])
def test_sixteen_pixels_take_their_samples_as_one_does(samples: int) -> None:
    rng = np.random.default_rng(samples)
    pixels, n = 3 * LANES, 100
    done = records(Sample, pixels * samples)
    done["radiance"] = rng.lognormal(size=(len(done), 3)) * rng.choice([0.0, 1e-30, 1.0, 1e20], (len(done), 1))
    done["radiance"][rng.random(len(done)) < 0.1, 1] = np.nan
    done["radiance"][rng.random(len(done)) < 0.1, 0] = np.inf
    done["radiance"][rng.random(len(done)) < 0.1] = np.float32(3e38)  # finite, but their sum is not
    for name in ("rays", "cut_depth", "cut_throughput"):
        done[name] = rng.integers(0, 1 << 30 if name == "rays" else 9, len(done))
    done["lost"] = rng.random(len(done))
    order = rng.permutation(n)[: pixels + LANES].astype(np.int32)
    films = []
    for kind in (in_lanes, one_by_one):
        film: Any = Film()
        arrays = {name: zeros(n, dtype) for name, dtype in OF_FILM.items()}
        for name, array in arrays.items():
            setattr(film, name, array)
        for _ in range(2):
            launch(kind, 1, film, upload(order, wp.int32, DEVICE), upload(done, Sample, DEVICE), LANES, samples)
        films.append({name: array.numpy() for name, array in arrays.items()})
    touched = order[LANES : 2 * LANES]
    assert (films[0]["samples"][touched] == 2 * samples).all() and films[0]["samples"].sum() == 2 * samples * LANES
    assert films[0]["not_finite"].sum() > 0 and (samples < 16 or films[0]["rays"].max() > 1 << 31)
    for name in OF_FILM:
        np.testing.assert_array_equal(films[0][name].view(np.uint8), films[1][name].view(np.uint8), err_msg=name)


@kernel
def unit_kernel(v: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3), warps: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = unit(v[i])
    warps[i] = wp.normalize(v[i])


def test_unit_vectors_without_a_branch() -> None:
    rng = np.random.default_rng(0)
    v = (rng.normal(size=(20_000, 3)) * 10.0 ** rng.uniform(-45, 38, (20_000, 1))).astype(np.float32)
    v[:10], v[10:20], v[20:30, 0], v[30:40, 1] = 0.0, -0.0, np.inf, np.nan
    out, warps = zeros(len(v), wp.vec3), zeros(len(v), wp.vec3)
    launch(unit_kernel, len(v), vec3s(v), out, warps)
    np.testing.assert_array_equal(out.numpy(), warps.numpy())
    assert not out.numpy()[:20].any() and not out.numpy()[30:40].any()


@kernel
def where_kernel(a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = where_vec3(i % 2 == 0, a[i], b[i])


def test_one_of_two_vectors() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 8, 3)).astype(np.float32)
    out = zeros(8, wp.vec3)
    launch(where_kernel, 8, vec3s(a), vec3s(b), out)
    assert (out.numpy() == np.where(np.arange(8)[:, None] % 2 == 0, a, b)).all()
