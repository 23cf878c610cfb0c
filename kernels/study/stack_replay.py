"""Replay of the stacks of logged walks (tree_walk.WalkLog): when each entry is used, and when a prefetcher of the next entries fetches it.
The prefetcher is that of Tozlu, Naithani and Zhou 2026, arXiv 2605.16253, section 5: at the first, second and third pop in a row it fetches
the next 1, 2 and 16 entries of the stack."""

import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.study.tree_walk import QUEUE, WalkLog

NEVER = wp.constant(-1)


@wp.struct
class Entries:
    """For each pushed entry: the step of its ray at which it is popped and fetched, and at which it is prefetched; NEVER if not."""

    used: wp.array(dtype=wp.int32)
    prefetched: wp.array(dtype=wp.int32)


@kernel
def replay_stacks(log: WalkLog, ahead: wp.vec3i, first_ray: int, scratch: wp.array(dtype=wp.int64), out: Entries):
    """Replay ray first_ray + tid. ahead: numbers of entries that the first, second and further pops in a row prefetch.
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
