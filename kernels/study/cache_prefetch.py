"""Replay of fetches and prefetches through one LRU cache per multiprocessor (CPU only)."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.study.cache_lru import Caches

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
