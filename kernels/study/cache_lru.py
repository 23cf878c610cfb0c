"""Replay of memory fetches through set-associative caches with LRU replacement (CPU only)."""

import warp as wp

from wrt.kernels.structs import kernel

LINE = wp.constant(wp.int64(128))  # bytes of a cache line


@wp.struct
class Caches:
    """One cache per thread, all of the same size."""

    sets: int  # Number of sets of a cache.
    ways: int  # Number of lines of a set.
    tags: wp.array(dtype=wp.int64)  # For each cache, `sets` sets of `ways` line indices, the most recently used first; -1: empty.


@wp.func
def access(caches: Caches, which: int, line: wp.int64) -> bool:
    """Return whether a line is in cache `which`, and make it the most recent line of its set. The set is `line` modulo `sets`."""
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
    """Access lines one after another, in one thread: store hit[i] = 1 if lines[i] is in the cache, else 0."""
    for i in range(lines.shape[0]):
        hit[i] = wp.where(access(caches, wp.tid(), lines[i]), wp.int8(1), wp.int8(0))


@wp.struct
class Trace:
    """The fetches of rays, which are grouped into warps of a GPU."""

    sms: int  # Number of multiprocessors (SMs); SM s runs the warps s, s + sms, s + 2 sms and so on.
    slots: int  # Number of warps that an SM runs at a time.
    warp_first: wp.array(dtype=wp.int64)  # Warp w has the rays warp_first[w] .. warp_first[w + 1] - 1, at most 32.
    first: wp.array(dtype=wp.int64)  # Ray i has the fetches first[i] .. first[i + 1] - 1.
    address: wp.array(dtype=wp.int64)  # First byte of each fetch.
    size: wp.array(dtype=wp.int64)  # Number of bytes of each fetch.
    prefetch_first: wp.array(dtype=wp.int64)  # Fetch i starts the prefetches prefetch_first[i] .. [i + 1] - 1. Length 0: no prefetches.
    prefetch_address: wp.array(dtype=wp.int64)
    prefetch_size: wp.array(dtype=wp.int64)


@wp.struct
class Missed:
    """Misses in the L1 cache of each SM, and scratch. SM s has the entries first[s] .. first[s] + misses[s] - 1 of line, time and lanes."""

    first: wp.array(dtype=wp.int64)
    line: wp.array(dtype=wp.int64)  # Line of each miss.
    time: wp.array(dtype=wp.int64)  # Round of each miss.
    lanes: wp.array(dtype=wp.int64)  # Number of lanes that wait for the line of each miss.
    wanted: wp.array(dtype=wp.int64)  # Number of lines that the lanes of each SM request, before lanes share accesses.
    accesses: wp.array(dtype=wp.int64)  # Number of L1 accesses of each SM.
    misses: wp.array(dtype=wp.int64)  # Number of L1 misses of each SM.
    slot_warp: wp.array(dtype=wp.int32)  # Running warp of each of sms * slots slots; -1: none.
    slot_round: wp.array(dtype=wp.int64)  # Number of rounds that the running warp has finished.
    seen: wp.array(dtype=wp.int64)  # Scratch: distinct lines of a warp's round, seen_size entries per SM.
    seen_at: wp.array(dtype=wp.int64)  # Scratch: index of the miss of each line in `seen`; -1 for a hit.
    seen_size: int


@wp.func
def request(caches: Caches, out: Missed, sm: int, line: wp.int64, seen: int, time: wp.int64) -> int:
    """Access a line unless the round has done so; return its entry in out.seen. seen: number of lines that the round has accessed."""
    begin = sm * out.seen_size
    for j in range(seen):
        if out.seen[begin + seen - 1 - j] == line:
            return begin + seen - 1 - j
    entry = begin + seen
    out.seen[entry] = line
    out.seen_at[entry] = wp.int64(-1)
    if not access(caches, sm, line):
        at = out.first[sm] + out.misses[sm]
        out.line[at] = line
        out.time[at] = time
        out.lanes[at] = wp.int64(0)
        out.seen_at[entry] = at
        out.misses[sm] += wp.int64(1)
    return entry


@wp.func
def prefetch_lines(trace: Trace, caches: Caches, out: Missed, sm: int, fetch: wp.int64, seen: int, time: wp.int64) -> int:
    """Access the lines that a fetch prefetches; no lane waits for them. Return the number of lines that the round has accessed."""
    for i in range(int(trace.prefetch_first[fetch]), int(trace.prefetch_first[fetch + wp.int64(1)])):
        line = trace.prefetch_address[i] / LINE
        last = (trace.prefetch_address[i] + trace.prefetch_size[i] - wp.int64(1)) / LINE
        while line <= last:
            seen = wp.max(seen, request(caches, out, sm, line, seen, time) - sm * out.seen_size + 1)
            line = line + wp.int64(1)
    return seen


@wp.func
def play_round(trace: Trace, caches: Caches, out: Missed, sm: int, warp: int, step: wp.int64, time: wp.int64) -> bool:
    """Replay fetch `step` of each ray of a warp, then the prefetches that these fetches start. Rays that fetch the same line share one
    access. Return whether more fetches follow."""
    more = bool(False)
    seen = int(0)
    for ray in range(int(trace.warp_first[warp]), int(trace.warp_first[warp + 1])):
        fetch = trace.first[ray] + step
        more = more or fetch + wp.int64(1) < trace.first[ray + 1]
        if fetch < trace.first[ray + 1]:
            line = trace.address[fetch] / LINE
            last = (trace.address[fetch] + trace.size[fetch] - wp.int64(1)) / LINE
            while line <= last:
                out.wanted[sm] += wp.int64(1)
                entry = request(caches, out, sm, line, seen, time)
                seen = wp.max(seen, entry - sm * out.seen_size + 1)
                if out.seen_at[entry] >= wp.int64(0):
                    out.lanes[out.seen_at[entry]] += wp.int64(1)
                line = line + wp.int64(1)
    if trace.prefetch_first.shape[0] > 0:
        for ray in range(int(trace.warp_first[warp]), int(trace.warp_first[warp + 1])):
            fetch = trace.first[ray] + step
            if fetch < trace.first[ray + 1]:
                seen = prefetch_lines(trace, caches, out, sm, fetch, seen, time)
    out.accesses[sm] += wp.int64(seen)
    return more


@kernel
def replay_warps(trace: Trace, caches: Caches, out: Missed, sm: int):
    """Replay one SM. In each round, every warp in a slot makes one fetch per lane. A finished warp frees its slot."""
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
