"""Caches, simulated: what recorded fetches find in the L1 of each SM and the L2 of them all, in the order of the warps."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import warp as wp

from wrt.device import load_kernel, run_all, start, thread_count, upload
from wrt.errors import InputError
from wrt.kernels.cache_lru import Caches, replay_lru
from wrt.kernels.counters import PRIMITIVE_SPACE

LINE = 128  # bytes: of a cache line on NVIDIA's GPUs since Volta


@dataclass(frozen=True)
class Cache:
    """size in bytes; ways: lines a set. As many sets as fit."""

    size: int
    ways: int

    def __post_init__(self) -> None:
        if self.ways < 1 or self.size < LINE * self.ways:
            raise InputError(f"a cache of {self.ways} ways has at least {LINE * max(self.ways, 1)} bytes, got {self.size}")

    @property
    def sets(self) -> int:
        return self.size // (LINE * self.ways)


@dataclass(frozen=True, eq=False)
class Stream:
    """Accesses to cache lines, those of each SM one after another (SM s: first[s] to first[s + 1]) and in the order of time.

    line: number of the line; time: the round in which it is asked for (a warp makes one fetch a lane and round).
    """

    line: np.ndarray
    time: np.ndarray
    first: np.ndarray


@dataclass(frozen=True)
class Misses:
    """accesses: of the L1s; l1, l2: those that miss there (each reads one line from below); compulsory: different lines."""

    accesses: int
    l1: int
    l2: int
    compulsory: int


def lines_of(address: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cache lines that fetches touch, one after another, and the fetch that each belongs to; both (M,) int64."""
    begin, end = address // LINE, (address + size - 1) // LINE
    count = end - begin + 1
    fetch = np.repeat(np.arange(len(address)), count)
    within = np.arange(len(fetch)) - np.repeat(np.cumsum(count) - count, count)
    return begin[fetch] + within, fetch


def distinct_lines(first: np.ndarray, address: np.ndarray, size: np.ndarray) -> np.ndarray:
    """How many different cache lines each ray touches, (N,) int64; ray i has the fetches first[i] to first[i + 1]."""
    line, fetch = lines_of(address, size)
    owner = np.repeat(np.arange(len(first) - 1), np.diff(first))[fetch]
    count = int(line.max(initial=0)) + 1
    both = np.unique(owner * count + line)
    return np.bincount(both // count, minlength=len(first) - 1)


def replay(first: np.ndarray, line: np.ndarray, cache: Cache) -> np.ndarray:
    """Whether each access finds its line, (M,) bool; every stream first[s] to first[s + 1] has a cache of its own, empty at
    the beginning, which drops the least recently used line of a full set. A line belongs in set `line modulo sets`."""
    streams, cpu = len(first) - 1, start("cpu")
    hit = wp.zeros(len(line), dtype=wp.int8, device=cpu)
    load_kernel(replay_lru, cpu)
    begins, lines = upload(first, wp.int64, cpu), upload(line, wp.int64, cpu)

    def job(s: int) -> None:  # each with tags of its own: two SMs never write to the same memory
        own = Caches()
        own.sets, own.ways = cache.sets, cache.ways
        own.tags = wp.full(cache.sets * cache.ways, wp.int64(-1), dtype=wp.int64, device=cpu)
        wp.launch(replay_lru, dim=1, inputs=[own, begins[s:s + 2], lines, hit], device=cpu)

    run_all([lambda s=s: job(s) for s in range(streams)], thread_count(None))  # type: ignore[misc]
    return hit.numpy().astype(bool)


def starts(length: np.ndarray, sms: int, slots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """When and where warps run: round of the first fetch, SM, and slot; (W,) each. length: rounds that each warp takes.

    Warps go to the SMs by turns. An SM has so many slots; a warp begins when one is free.
    """
    begin, slot = np.zeros(len(length), np.int64), np.zeros(len(length), np.int64)
    for sm in range(min(sms, len(length))):
        free = [(0, s) for s in range(slots)]
        for warp in range(sm, len(length), sms):
            begin[warp], slot[warp] = free[0]
            heapq.heapreplace(free, (int(begin[warp] + length[warp]), int(slot[warp])))
    return begin, np.arange(len(length)) % sms, slot


def warp_stream(warp: np.ndarray, first: np.ndarray, address: np.ndarray, size: np.ndarray, sms: int, slots: int) -> Stream:
    """Fetches in the order in which SMs make them. warp: (N,) of each ray, 0 to W - 1; ray i has the fetches first[i] to
    first[i + 1].

    In each round every lane of a warp makes its next fetch, and each line that they touch is asked for once: nothing waits for
    memory, so the order of warps is that of their lengths. Raises InputError where it is too long to be sorted.
    """
    fetches = np.diff(first)
    length = np.zeros(int(warp.max(initial=-1)) + 1, np.int64)
    np.maximum.at(length, warp, fetches)
    begin, sm, slot = starts(length, sms, slots)
    line, fetch = lines_of(address, size)
    ray = np.repeat(np.arange(len(warp)), fetches)[fetch]
    time = begin[warp[ray]] + fetch - first[ray]
    # The primitives' lines stand behind the nodes': fewer bits, so that one number holds all that is sorted by.
    base = int(PRIMITIVE_SPACE) // LINE
    nodes = int(line[line < base].max(initial=-1)) + 1
    line = np.where(line >= base, line - base + nodes, line)
    radix = [int(time.max(initial=0)) + 1, slots, int(line.max(initial=0)) + 1]
    if sms * radix[0] * radix[1] * radix[2] >= 1 << 63:
        raise InputError("the trace is too long for the cache simulation; take fewer rays")
    key = ((sm[warp[ray]] * radix[0] + time) * radix[1] + slot[warp[ray]]) * radix[2] + line
    key = np.unique(key)
    line, key = key % radix[2], key // (radix[2] * radix[1])
    return Stream(line, key % radix[0], np.searchsorted(key // radix[0], np.arange(sms + 1)))


def simulate(stream: Stream, l1: Cache, l2: Cache, warm: bool = False) -> Misses:
    """What misses in the L1s (one an SM) and, in the order of time, in the L2 behind all of them. warm: the L2 has seen the same
    stream once before."""
    missed = ~replay(stream.first, stream.line, l1)
    line, time = stream.line[missed], stream.time[missed]
    line = line[np.argsort(time, kind="stable")]
    again = np.concatenate([line, line]) if warm else line
    hit = replay(np.array([0, len(again)]), again, l2)[-len(line):] if len(line) else np.zeros(0, bool)
    return Misses(len(stream.line), len(line), int((~hit).sum()), len(np.unique(stream.line)))
