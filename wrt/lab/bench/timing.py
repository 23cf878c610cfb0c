"""Time several jobs by turns in one process, so that disturbances hit all of them alike."""

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.core.types import Device

Quartiles = tuple[float, float, float]  # first quartile, median, third quartile
QUEUE = 10  # calls of a timed run on a GPU, so that the host prepares a call while the GPU works on others
K = TypeVar("K")
T = TypeVar("T")


def alternate(jobs: Mapping[K, Callable[[], object]], runs: int, clock: Callable[[], float] = time.perf_counter) -> dict[K, np.ndarray]:
    """Return seconds (runs,) of each job, after one run that is not timed. Round k runs every job once, beginning with job k."""
    seconds: dict[K, list[float]] = {name: [] for name in jobs}
    names = list(jobs)
    for job in jobs.values():
        job()
    for turn in range(runs):
        for name in names[turn % len(names):] + names[:turn % len(names)]:
            begin = clock()
            jobs[name]()
            seconds[name].append(max(clock() - begin, 1e-9))  # a thread's CPU time may have coarse steps
    return {name: np.array(times) for name, times in seconds.items()}


def alternate_on(device: Device, jobs: Mapping[K, Callable[[], object]], runs: int,
                 clock: Callable[[], float] = time.perf_counter) -> dict[K, np.ndarray]:
    """Return seconds (runs,) of a call of each job, as `alternate` does. A run on a GPU is QUEUE calls and one wait."""
    if device.is_cpu:
        return alternate(jobs, runs, clock)
    seconds = alternate({name: partial(_queued, job, device) for name, job in jobs.items()}, runs, clock)
    return {name: each / QUEUE for name, each in seconds.items()}


def _queued(job: Callable[[], object], device: Device) -> None:
    for _ in range(QUEUE):
        job()
    wp.synchronize_device(device)


def with_seconds(work: Callable[[], T]) -> tuple[T, float]:
    """Return the result of `work` and its wall-clock seconds."""
    begin = time.perf_counter()
    return work(), time.perf_counter() - begin


def quartiles(values: npt.ArrayLike) -> Quartiles:
    low, middle, high = (float(x) for x in np.quantile(np.asarray(values), (0.25, 0.5, 0.75)))
    return low, middle, high


def shown(values: Quartiles) -> str:
    """Format quartiles as the median, with the first and third quartile in brackets."""
    return f"{values[1]:.3g} [{values[0]:.3g}, {values[2]:.3g}]"


def spread(values: npt.ArrayLike, scale: float = 1.0) -> str:
    """Format the median and quartiles of the values, each multiplied by `scale`."""
    return shown(quartiles(scale * np.asarray(values)))
