"""Pictures by one ray at a time (wrt.kernels.loops.one_ray): on CUDA, and for counters.

A thread takes a pixel, or a sample if the pixels alone would leave multiprocessors of a GPU idle.
"""

from __future__ import annotations

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
ROUNDS = 4  # samples of a launch for each resident thread


def film_launch(device: Device, kernel: Kernel, scene: SceneRecords, limits: list[WarpStruct], film: DeviceFilm,
                alone: bool) -> Callable[[Work], int]:
    """Return a function that adds samples to the film and returns their number.

    limits: for each group of the film; alone: one thread for each pixel, always.
    """
    room = 0 if alone else device.sm_count * THREADS_OF_SM * ROUNDS
    samples = wp.empty(0, dtype=Sample, device=device)

    def trace(work: Work) -> int:
        nonlocal samples
        pixels, end = work.rectangle[2] * work.rectangle[3], work.first + work.n
        by_samples = work.n > 1 and pixels * ROUNDS <= room
        step = min(room // pixels, work.n) if by_samples else work.n
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
    """Return a function that writes AOVs to the film and returns the number of its pixels."""

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
