"""Replay of fetches and prefetches through one LRU cache per multiprocessor, and of the stacks of logged walks (CPU only).
The prefetcher is that of Tozlu, Naithani and Zhou 2026, arXiv 2605.16253, section 5: at the first, second and third pop in a row it fetches
the next 1, 2 and 16 entries of the stack."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.study.cache_lru import Caches
from wrt.kernels.study.tree_walk import QUEUE, WalkLog

UNUSED = wp.constant(wp.int64(1))  # Flag of a tag, which is 2 * line + flag: the line was prefetched and no fetch has used it yet.


@wp.struct
class Served:
    """Counts of each cache."""

    fetches: wp.array(dtype=wp.int64)
    misses: wp.array(dtype=wp.int64)  # Fetches whose line is not in the cache.
    prefetches: wp.array(dtype=wp.int64)  # Prefetches whose line is not in the cache.
    used: wp.array(dtype=wp.int64)  # Prefetched lines that a fetch uses before they leave the cache.
    missed: wp.array(dtype=wp.int8)  # 1 for each access, fetch or prefetch, whose line is not in the cache.


@kernel
def replay_prefetches(caches: Caches, first: wp.array(dtype=wp.int64), line: wp.array(dtype=wp.int64),
                      prefetch: wp.array(dtype=wp.int8), sm: int, out: Served):
    """Replay the accesses first[sm] .. first[sm + 1] - 1 of cache `sm`, in one thread. prefetch: 1 for a prefetch, 0 for a fetch."""
    for i in range(int(first[sm]), int(first[sm + 1])):
        ahead = prefetch[i] != wp.int8(0)
        begin = (sm * caches.sets + int(line[i] % wp.int64(caches.sets))) * caches.ways
        moved = line[i] * wp.int64(2) + wp.where(ahead, UNUSED, wp.int64(0))
        found = bool(False)
        for way in range(caches.ways):
            tag = caches.tags[begin + way]
            caches.tags[begin + way] = moved
            moved = tag
            if (tag >> wp.int64(1)) == line[i]:
                found = True
                break
        out.missed[i] = wp.int8(wp.where(found, 0, 1))
        if ahead:
            if found:
                caches.tags[begin] = moved  # keeps the line's flag
            else:
                out.prefetches[sm] += wp.int64(1)
        else:
            out.fetches[sm] += wp.int64(1)
            if not found:
                out.misses[sm] += wp.int64(1)
            elif (moved & UNUSED) != wp.int64(0):
                out.used[sm] += wp.int64(1)


NEVER = wp.constant(-1)


@wp.struct
class Entries:
    """For each pushed entry: the step of its ray at which it is popped and fetched, and at which it is prefetched; NEVER if not."""

    used: wp.array(dtype=wp.int32)
    prefetched: wp.array(dtype=wp.int32)


@kernel
def replay_stacks(log: WalkLog, ahead: wp.vec3i, first_ray: int, scratch: wp.array(dtype=wp.int64), out: Entries):
    """Replay the stack of ray first_ray + tid. ahead: numbers of entries that the first, second and further pops in a row prefetch.
    scratch: QUEUE indices of entries for each thread."""
    ray = first_ray + wp.tid()
    base = wp.tid() * QUEUE
    push = log.push_first[ray]
    size = int(0)
    in_row = int(0)
    steps = int(log.fetch_first[ray + 1] - log.fetch_first[ray])
    for i in range(steps):
        fetch = log.fetch_first[ray] + wp.int64(i)
        if i > 0:
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                entry = scratch[base + size]
                found = log.push[entry] == log.fetch[fetch]
                if found:
                    out.used[entry] = i
            in_row = wp.where(log.entered[fetch - wp.int64(1)] > wp.int8(0), 1, in_row + 1)
            reach = ahead[wp.min(in_row, 3) - 1]
            for j in range(wp.min(reach, size)):
                entry = scratch[base + size - 1 - j]
                if out.prefetched[entry] == NEVER:
                    out.prefetched[entry] = i
        for _ in range(int(log.entered[fetch])):
            scratch[base + size] = push
            size = size + 1
            push = push + wp.int64(1)
