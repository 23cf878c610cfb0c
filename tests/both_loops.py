"""Pictures by both loops of the renderer, by waves of samples and by one ray at a time, to be compared bit by bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from wrt.core.device import load_kernel
from wrt.renderer import waves
from wrt.renderer.film_arrays import OF_AOVS, AovFilm, DeviceFilm
from wrt.renderer.plan import aov_kernel, render_kernel
from wrt.renderer.prepare import Prepared
from wrt.renderer.tiles import Rectangle, Work


def one_ray_at_a_time(ready: Prepared) -> Prepared:
    """With the loop that CUDA has."""
    plan = ready.plan
    makes = (render_kernel, aov_kernel) if plan.options.aov else (render_kernel,)
    kernels = [make(plan.features, plan.structure) for make in makes]
    for kernel in kernels:
        load_kernel(kernel, ready.device)
    return replace(ready, waves=None, kernels=kernels)


def film_of(ready: Prepared, rectangle: Rectangle, *parts: tuple[int, int], groups: int = 1,
            seed: int = 5) -> dict[str, np.ndarray]:
    """Everything that samples change. parts: the first sample of each pixel and their number, one launch after another."""
    film = DeviceFilm(ready.plan.scene.settings, ready.plan.crop, ready.device, seed, groups)
    trace = ready.launch(film)
    for first, n in parts:
        assert trace(Work(rectangle, first, n)) == rectangle[2] * rectangle[3] * n
    return {name: film.picture(array) for name, array in film.arrays()}


def aovs_of(ready: Prepared, rectangle: Rectangle) -> dict[str, np.ndarray]:
    """All AOVs."""
    film = AovFilm(ready.plan.scene.settings, ready.plan.crop, ready.device)
    ready.launch(film)(Work(rectangle, 0, 1))
    return {name: film.picture(name) for name in OF_AOVS}


def differences(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> list[str]:
    """The arrays that have not the same bits."""
    assert one.keys() == other.keys()
    return [name for name, values in one.items() if values.tobytes() != other[name].tobytes()]


@contextmanager
def small_waves(capacity: int) -> Iterator[None]:
    """Waves that are made in the block have so many samples at most."""
    before, waves.CAPACITY = waves.CAPACITY, capacity
    try:
        yield
    finally:
        waves.CAPACITY = before
