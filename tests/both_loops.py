"""Render with both loops of the renderer, waves of samples and one ray at a time, to compare their films bit by bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from wrt.core.device import load_kernel
from wrt.renderer import launches as waves
from wrt.renderer.film import OF_AOVS, AovFilm, DeviceFilm, Rectangle, Work
from wrt.renderer.plan import aov_kernel, render_kernel
from wrt.renderer.prepare import Prepared


def one_ray_at_a_time(ready: Prepared) -> Prepared:
    """Return a copy that renders with the one-ray-at-a-time loop, the only loop on CUDA."""
    plan = ready.plan
    makes = (render_kernel, aov_kernel) if plan.options.aov else (render_kernel,)
    kernels = [make(plan.features, plan.structure) for make in makes]
    for kernel in kernels:
        load_kernel(kernel, ready.device)
    return replace(ready, waves=None, kernels=kernels)


def film_of(ready: Prepared, rectangle: Rectangle, *launches: tuple[int, int], groups: int = 1,
            seed: int = 5) -> dict[str, np.ndarray]:
    """Return all arrays of the film, by name. launches: the first sample and the number of samples per pixel of each launch."""
    film = DeviceFilm(ready.plan.scene.settings, ready.plan.crop, ready.device, seed, groups)
    trace = ready.launch(film)
    for first, n in launches:
        assert trace(Work(rectangle, first, n)) == rectangle[2] * rectangle[3] * n
    return {name: film.picture(array) for name, array in film.arrays()}


def aovs_of(ready: Prepared, rectangle: Rectangle) -> dict[str, np.ndarray]:
    """Return all AOVs as pictures, by name."""
    film = AovFilm(ready.plan.scene.settings, ready.plan.crop, ready.device)
    ready.launch(film)(Work(rectangle, 0, 1))
    return {name: film.picture(name) for name in OF_AOVS}


def differences(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> list[str]:
    """Return the names of the arrays whose bits differ."""
    assert one.keys() == other.keys()
    return [name for name, values in one.items() if values.tobytes() != other[name].tobytes()]


@contextmanager
def small_waves(capacity: int) -> Iterator[None]:
    """Limit the waves that the block creates to `capacity` samples."""
    before, waves.CAPACITY = waves.CAPACITY, capacity
    try:
        yield
    finally:
        waves.CAPACITY = before
