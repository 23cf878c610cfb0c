"""Replay of fetches through set-associative LRU caches (CPU only)."""

import warp as wp

from wrt.kernels.structs import kernel

LINE = wp.constant(wp.int64(128))


@wp.struct
class Caches:
    """One cache a thread, all alike."""

    sets: int
    ways: int
    tags: wp.array(dtype=wp.int64)  # `sets` sets of `ways` lines, the most recently used first; -1: empty.


@wp.func
def access(caches: Caches, which: int, line: wp.int64) -> bool:
    """Return whether the line is in the cache, and put it there; its set is `line modulo sets`."""
    begin = (which * caches.sets + int(line % wp.int64(caches.sets))) * caches.ways
    moved = line
    for way in range(caches.ways):
        tag = caches.tags[begin + way]
        caches.tags[begin + way] = moved
        moved = tag
        if tag == line:
            return True
    return False


@kernel
def replay_lru(caches: Caches, lines: wp.array(dtype=wp.int64), hit: wp.array(dtype=wp.int8)):
    """Replay lines in one thread: hit[i] = 1 if lines[i] is in the cache."""
    for i in range(lines.shape[0]):
        hit[i] = wp.where(access(caches, wp.tid(), lines[i]), wp.int8(1), wp.int8(0))


@wp.struct
class Trace:
    """Rays in the order of warps, and their fetches."""

    sms: int  # Warps go to them by turns.
    slots: int  # Concurrent warps of an SM.
    warp_first: wp.array(dtype=wp.int64)  # Warp w has the rays warp_first[w] .. warp_first[w + 1] - 1, at most 32.
    first: wp.array(dtype=wp.int64)  # Ray i has the fetches first[i] .. first[i + 1] - 1.
    address: wp.array(dtype=wp.int64)
    size: wp.array(dtype=wp.int64)  # Bytes.


@wp.struct
class Missed:
    """Misses of each SM's L1; the misses of SM s are the entries first[s] .. first[s] + misses[s] - 1."""

    first: wp.array(dtype=wp.int64)
    line: wp.array(dtype=wp.int64)
    time: wp.array(dtype=wp.int64)  # Round of the miss.
    lanes: wp.array(dtype=wp.int64)  # Lanes that wait for the line.
    wanted: wp.array(dtype=wp.int64)  # Lanes that asked for a line, each counted.
    accesses: wp.array(dtype=wp.int64)
    misses: wp.array(dtype=wp.int64)
    slot_warp: wp.array(dtype=wp.int32)  # Running warp of each of sms * slots slots; -1: none.
    slot_round: wp.array(dtype=wp.int64)  # Its round.
    seen: wp.array(dtype=wp.int64)  # Lines of a warp's round, seen_size for each SM.
    seen_at: wp.array(dtype=wp.int64)  # Entry of each one's miss; -1: it hit.
    seen_size: int


@wp.func
def play_round(trace: Trace, caches: Caches, out: Missed, sm: int, warp: int, step: wp.int64, time: wp.int64) -> bool:
    """Let each lane make its fetch `step`; lanes share a line's access. Return whether a lane has a next fetch."""
    more = bool(False)
    begin = sm * out.seen_size
    seen = int(0)
    for ray in range(int(trace.warp_first[warp]), int(trace.warp_first[warp + 1])):
        fetch = trace.first[ray] + step
        more = more or fetch + wp.int64(1) < trace.first[ray + 1]
        if fetch < trace.first[ray + 1]:
            line = trace.address[fetch] / LINE
            last = (trace.address[fetch] + trace.size[fetch] - wp.int64(1)) / LINE
            while line <= last:
                out.wanted[sm] += wp.int64(1)
                entry = int(-1)
                for j in range(seen):
                    if out.seen[begin + seen - 1 - j] == line:
                        entry = begin + seen - 1 - j
                        break
                if entry < 0:
                    entry = begin + seen
                    seen = seen + 1
                    out.seen[entry] = line
                    out.seen_at[entry] = wp.int64(-1)
                    if not access(caches, sm, line):
                        at = out.first[sm] + out.misses[sm]
                        out.line[at] = line
                        out.time[at] = time
                        out.lanes[at] = wp.int64(0)
                        out.seen_at[entry] = at
                        out.misses[sm] += wp.int64(1)
                if out.seen_at[entry] >= wp.int64(0):
                    out.lanes[out.seen_at[entry]] += wp.int64(1)
                line = line + wp.int64(1)
    out.accesses[sm] += wp.int64(seen)
    return more


@kernel
def replay_warps(trace: Trace, caches: Caches, out: Missed, sm: int):
    """Replay one SM: in each round every warp in a slot makes one fetch a lane; a finished warp frees its slot."""
    waiting = sm
    n = trace.warp_first.shape[0] - 1
    time = wp.int64(0)
    busy = bool(True)
    while busy:
        busy = bool(False)
        for slot in range(trace.slots):
            place = sm * trace.slots + slot
            if out.slot_warp[place] < 0 and waiting < n:
                out.slot_warp[place] = waiting
                out.slot_round[place] = wp.int64(0)
                waiting = waiting + trace.sms
            if out.slot_warp[place] >= 0:
                busy = True
                if not play_round(trace, caches, out, sm, out.slot_warp[place], out.slot_round[place], time):
                    out.slot_warp[place] = -1
                out.slot_round[place] += wp.int64(1)
        time = time + wp.int64(1)
