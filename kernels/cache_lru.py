"""Replays streams of cache lines through set-associative caches that drop the least recently used line (CPU only)."""

import warp as wp

from wrt.kernels.structs import kernel


@wp.struct
class Caches:
    """One cache a stream, all alike: tags of `sets` sets of `ways` lines, the most recently used first; -1: nothing yet."""

    sets: int
    ways: int
    tags: wp.array(dtype=wp.int64)


@kernel
def replay_lru(caches: Caches, first: wp.array(dtype=wp.int64), lines: wp.array(dtype=wp.int64), hit: wp.array(dtype=wp.int8)):
    """hit[i] = 1 where lines[i] is there when it is asked for; stream s is lines[first[s] : first[s + 1]]. A line belongs in set
    line modulo sets."""
    stream = wp.tid()
    for i in range(int(first[stream]), int(first[stream + 1])):
        line = lines[i]
        begin = (stream * caches.sets + int(line % wp.int64(caches.sets))) * caches.ways
        moved = line
        found = wp.int8(0)
        for way in range(caches.ways):
            tag = caches.tags[begin + way]
            caches.tags[begin + way] = moved
            moved = tag
            if tag == line:
                found = wp.int8(1)
                break
        hit[i] = found
