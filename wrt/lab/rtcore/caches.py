"""Simulate the caches of a GPU: which recorded fetches miss in the L1 of each SM and in the shared L2."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from wrt.accel.queries.answers import Counters
from wrt.core.device import launch, start, upload
from wrt.core.threads import thread_count
from wrt.kernels.study.cache_lru import Caches, Missed, Trace, replay_lru, replay_warps
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE

LINE = 128  # bytes of a cache line on NVIDIA GPUs since Volta


@dataclass(frozen=True)
class Cache:
    """A set-associative cache. size: bytes; ways: lines in a set."""

    size: int
    ways: int

    @property
    def sets(self) -> int:
        return self.size // (LINE * self.ways)


@dataclass(frozen=True, eq=False)
class Prefetches:
    """Prefetches, (P,) int64 arrays. after: index of the fetch that starts each one, ascending; address, size: in bytes."""

    after: np.ndarray
    address: np.ndarray
    size: np.ndarray


@dataclass(frozen=True, eq=False)
class Level1:
    """Result of `first_level`. accesses: number of L1 accesses; wanted: sum over the accesses of the lanes that need the line.
    The arrays are (M,) int64 over the misses. line: the cache line; time: the miss's round; lanes: number of lanes that wait for it."""

    accesses: int
    wanted: int
    line: np.ndarray
    time: np.ndarray
    lanes: np.ndarray


@dataclass(frozen=True)
class Misses:
    """Cache counts, summed over all rays.
    - accesses: to the L1s; l1, l2: misses of the L1s and of the L2, one line each; compulsory: number of different lines.
    - wanted: lanes that need a line; wait_l2, wait_dram: lanes that wait for the L2 and for DRAM. Each lane of an access counts."""

    accesses: int
    l1: int
    l2: int
    compulsory: int
    wanted: int
    wait_l2: int
    wait_dram: int


def lines_of(address: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cache lines that the fetches touch, in the fetches' order, and the index of each line's fetch, (M,) int64 each."""
    begin, end = address // LINE, (address + size - 1) // LINE
    count = end - begin + 1
    fetch = np.repeat(np.arange(len(address)), count)
    within = np.arange(len(fetch)) - np.repeat(np.cumsum(count) - count, count)
    return begin[fetch] + within, fetch


def distinct_lines(first: np.ndarray, address: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Count the different cache lines that each ray fetches, (N,) int64. Ray i has the fetches first[i] to first[i + 1] - 1."""
    line, fetch = lines_of(address, size)
    owner = np.repeat(np.arange(len(first) - 1), np.diff(first))[fetch]
    count = int(line.max(initial=0)) + 1
    both = np.unique(owner * count + line)
    return np.bincount(both // count, minlength=len(first) - 1)


def replay(line: np.ndarray, cache: Cache) -> np.ndarray:
    """Return flags of the accesses that hit, (M,) bool, in an LRU cache that is empty at first. Line n is in set n modulo cache.sets."""
    cpu = start("cpu")
    hit = wp.zeros(len(line), dtype=wp.int8, device=cpu)
    launch(replay_lru, 1, caches_of(cache, 1), upload(line, wp.int64, cpu), hit)
    return hit.numpy().astype(bool)


def caches_of(cache: Cache, count: int) -> Caches:
    """Return `count` empty caches on the CPU."""
    out = Caches()
    out.sets, out.ways = cache.sets, cache.ways
    out.tags = wp.full(count * cache.sets * cache.ways, wp.int64(-1), dtype=wp.int64, device=start("cpu"))
    return out


def first_level(warp: np.ndarray, fetches: Counters, sms: int, slots: int, l1: Cache, prefetches: Prefetches | None = None) -> Level1:
    """Simulate the L1 of each SM. warp: (N,) warp of each ray, ascending, at most 32 rays a warp; fetches: Counters of these rays.
    SM i runs the warps i, i + sms, i + 2 sms ..., at most `slots` at a time. In each round every lane of a warp makes its next fetch, and
    each cache line that the lanes touch is accessed once. Rounds do not wait for memory: a warp holds its slot for as many rounds as its
    longest ray has fetches. Prefetches access the L1 in the round of their fetch, after all fetches, and no lane waits for them."""
    cpu = start("cpu")
    # Place the primitives behind the nodes, as in one memory.
    space, node = int(PRIMITIVE_SPACE), fetches.address < int(PRIMITIVE_SPACE)
    behind = LINE * -(-int((fetches.address + fetches.size)[node].max(initial=0)) // LINE)

    def placed(address: np.ndarray) -> np.ndarray:
        return np.where(address < space, address, address - space + behind)

    address = placed(fetches.address)
    touched = (address + fetches.size - 1) // LINE - address // LINE + 1
    trace = Trace()
    if prefetches is not None and len(prefetches.after):
        begin = placed(prefetches.address)
        np.add.at(touched, prefetches.after, (begin + prefetches.size - 1) // LINE - begin // LINE + 1)
        trace.prefetch_first = upload(np.searchsorted(prefetches.after, np.arange(len(address) + 1)), wp.int64, cpu)
        trace.prefetch_address, trace.prefetch_size = upload(begin, wp.int64, cpu), upload(prefetches.size, wp.int64, cpu)
    count = int(warp[-1]) + 1 if len(warp) else 0
    warp_first = np.searchsorted(warp, np.arange(count + 1))
    most = np.diff(np.concatenate([[0], np.cumsum(touched)])[fetches.first[warp_first]])  # most misses of each warp
    begin = np.concatenate([[0], np.cumsum([int(most[sm::sms].sum()) for sm in range(sms)])])
    trace.sms, trace.slots = sms, slots
    trace.warp_first, trace.first = upload(warp_first, wp.int64, cpu), upload(fetches.first, wp.int64, cpu)
    trace.address, trace.size = upload(address, wp.int64, cpu), upload(fetches.size, wp.int64, cpu)
    out = Missed()
    out.first = upload(begin, wp.int64, cpu)
    out.line, out.time, out.lanes = (wp.empty(int(begin[-1]), dtype=wp.int64, device=cpu) for _ in range(3))
    out.accesses, out.misses, out.wanted = (wp.zeros(sms, dtype=wp.int64, device=cpu) for _ in range(3))
    out.slot_warp = wp.full(sms * slots, -1, dtype=wp.int32, device=cpu)
    out.slot_round = wp.zeros(sms * slots, dtype=wp.int64, device=cpu)
    out.seen_size = 32 * int(touched.max(initial=1))
    out.seen, out.seen_at = (wp.zeros(sms * out.seen_size, dtype=wp.int64, device=cpu) for _ in range(2))
    caches = caches_of(l1, sms)
    launch(replay_warps, sms, trace, caches, out, None, threads=thread_count(None), step=1)
    used = np.concatenate([np.arange(a, a + n) for a, n in zip(begin, out.misses.numpy(), strict=False)])
    return Level1(int(out.accesses.numpy().sum()), int(out.wanted.numpy().sum()), out.line.numpy()[used],
                  out.time.numpy()[used], out.lanes.numpy()[used])


def second_level(missed: Level1, l2: Cache, warm: bool = False) -> Misses:
    """Simulate the L2 for the misses of all L1s, in the order of their rounds. warm: the L2 has seen the same accesses once before."""
    order = np.argsort(missed.time, kind="stable")
    line, lanes = missed.line[order], missed.lanes[order]
    again = np.concatenate([line, line]) if warm else line
    hit = replay(again, l2)[len(again) - len(line):]
    return Misses(missed.accesses, len(line), int((~hit).sum()), len(np.unique(line)), missed.wanted, int(lanes.sum()),
                  int(lanes[~hit].sum()))
