"""What one way costs beside another: both run by turns in one process, so that what disturbs the one disturbs the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Quartiles = tuple[float, float, float]  # low, median, high


def alternate(jobs: Mapping[str, Callable[[], Any]], runs: int) -> dict[str, np.ndarray]:
    """Seconds (runs,) of each job, after one run of each that is not counted. The order is turned round every second time."""
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    for turn in range(runs):
        for name in list(jobs)[:: 1 if turn % 2 == 0 else -1]:
            begin = time.perf_counter()
            jobs[name]()
            seconds[name].append(time.perf_counter() - begin)
    return {name: np.array(times) for name, times in seconds.items()}


def quartiles(values: Any) -> Quartiles:
    low, middle, high = (float(x) for x in np.quantile(values, (0.25, 0.5, 0.75)))
    return low, middle, high


def shown(values: Quartiles, digits: int = 3) -> str:
    """The median, and the middle half in brackets."""
    return f"{values[1]:.{digits}g} [{values[0]:.{digits}g}, {values[2]:.{digits}g}]"
