"""What one way costs beside another: both run by turns in one process, so that what disturbs the one disturbs the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

Quartiles = tuple[float, float, float]  # low, median, high
K = TypeVar("K")


def alternate(jobs: Mapping[K, Callable[[], Any]], runs: int,
              clock: Callable[[], float] = time.perf_counter) -> dict[K, np.ndarray]:
    """Seconds (runs,) of each job by that clock, after one run of each that is not counted. The order turns: each run begins with
    the next job."""
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


def quartiles(values: Any) -> Quartiles:
    low, middle, high = (float(x) for x in np.quantile(values, (0.25, 0.5, 0.75)))
    return low, middle, high


def shown(values: Quartiles, digits: int = 3) -> str:
    """The median, and the middle half in brackets."""
    return f"{values[1]:.{digits}g} [{values[0]:.{digits}g}, {values[2]:.{digits}g}]"


def spread(values: Any, scale: float = 1.0) -> str:
    """The same of many values, times `scale`."""
    return shown(quartiles(scale * np.asarray(values)))
