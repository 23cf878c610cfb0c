"""Caches: which lines a run of fetches touches."""

from __future__ import annotations

import numpy as np

LINE = 128  # bytes: of a cache line on every NVIDIA GPU since Volta


def lines_of(address: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cache lines that fetches touch, one after another, and the fetch that each belongs to; both (M,) int64."""
    begin, end = address // LINE, (address + size - 1) // LINE
    count = end - begin + 1
    fetch = np.repeat(np.arange(len(address)), count)
    within = np.arange(len(fetch)) - np.repeat(np.cumsum(count) - count, count)
    return begin[fetch] + within, fetch


def distinct_lines(first: np.ndarray, address: np.ndarray, size: np.ndarray) -> np.ndarray:
    """How many different cache lines each ray touches, (N,) int64; ray i has the fetches first[i] to first[i + 1]."""
    n = len(first) - 1
    line, fetch = lines_of(address, size)
    owner = np.repeat(np.arange(n), np.diff(first))[fetch]
    both = np.sort(owner * (int(line.max(initial=0)) + 1) + line)
    fresh = np.ones(len(both), bool)
    fresh[1:] = both[1:] != both[:-1]
    return np.bincount(both[fresh] // (int(line.max(initial=0)) + 1), minlength=n)
