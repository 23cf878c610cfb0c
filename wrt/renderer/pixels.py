"""Rendering with threads that trace one ray at a time (wrt.kernels.loops.one_ray): on CUDA, and on a CPU if rays are counted.

A thread renders all samples of a pixel. If the pixels are too few to occupy a GPU, a thread renders one sample only.
"""

from collections.abc import Callable

import warp as wp

from wrt.core.device import launch_on
from wrt.core.types import Device, Kernel, WarpStruct
from wrt.kernels.loops.one_ray import Tile, add_samples
from wrt.kernels.shade.step import Sample
from wrt.renderer.film_arrays import AovFilm, DeviceFilm
from wrt.renderer.tiles import Work
from wrt.renderer.waves import SceneRecords

THREADS_OF_SM = 2048  # resident threads of NVIDIA's largest multiprocessors
ROUNDS = 4  # threads in one launch for each resident thread


def film_launch(device: Device, kernel: Kernel, scene: SceneRecords, limits: list[WarpStruct], film: DeviceFilm,
                always_by_pixels: bool) -> Callable[[Work], int]:
    """Return a function that adds the samples of a Work to the film, and returns their number, summed over the pixels.

    limits: a struct Limits for each group of the film. always_by_pixels: each thread renders all samples of a pixel."""
    most_threads = 0 if always_by_pixels else device.sm_count * THREADS_OF_SM * ROUNDS
    samples = wp.empty(0, dtype=Sample, device=device)

    def trace(work: Work) -> int:
        nonlocal samples
        pixels, end = work.rectangle[2] * work.rectangle[3], work.first + work.n
        by_samples = work.n > 1 and pixels * ROUNDS <= most_threads
        step = min(most_threads // pixels, work.n) if by_samples else work.n
        if by_samples and len(samples) < pixels * step:
            samples = wp.empty(pixels * step, dtype=Sample, device=device)
        for first in range(work.first, end, step):
            tile = tile_of(work._replace(first=first, n=min(step, end - first)))
            tile.threads = tile.n_samples if by_samples else 1
            tile.samples = samples
            for limit, group in zip(limits, film.groups, strict=True):
                launch_on(device, kernel, pixels * tile.threads, *scene, limit, group, tile)
                if tile.threads > 1:
                    launch_on(device, add_samples, pixels, group, tile)
        return work.total

    return trace


def aov_launch(device: Device, kernel: Kernel, scene: SceneRecords, film: AovFilm) -> Callable[[Work], int]:
    """Return a function that writes the AOVs of a Work's rectangle to the film, and returns the number of pixels."""

    def trace(work: Work) -> int:
        launch_on(device, kernel, work.rectangle[2] * work.rectangle[3], scene.accel, scene.surfaces, scene.camera, film.struct,
                  tile_of(work))
        return work.total

    return trace


def tile_of(work: Work) -> WarpStruct:
    tile = Tile()
    tile.x, tile.y, tile.width, _ = work.rectangle
    tile.first_sample, tile.n_samples, tile.threads = work.first, work.n, 1
    return tile
