"""Replays fetches through set-associative caches that drop the least recently used line (CPU only)."""

import warp as wp

from wrt.kernels.structs import kernel

LINE = wp.constant(wp.int64(128))


@wp.struct
class Caches:
    """One cache a thread, all alike: tags of `sets` sets of `ways` lines, the most recently used first; -1: nothing yet."""

    sets: int
    ways: int
    tags: wp.array(dtype=wp.int64)


@wp.func
def access(caches: Caches, which: int, line: wp.int64) -> bool:
    """Whether the line is there; it is afterwards. It belongs in set `line modulo sets`."""
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
    """One thread: hit[i] = 1 where lines[i] is there when it is asked for."""
    for i in range(lines.shape[0]):
        hit[i] = wp.where(access(caches, wp.tid(), lines[i]), wp.int8(1), wp.int8(0))


@wp.struct
class Trace:
    """Rays in the order of warps: warp w has the rays warp_first[w] to warp_first[w + 1] (32 at most), and ray i the fetches
    first[i] to first[i + 1]; address, size in bytes. slots: warps at a time in an SM; sms: warps go to them by turns."""

    sms: int
    slots: int
    warp_first: wp.array(dtype=wp.int64)
    first: wp.array(dtype=wp.int64)
    address: wp.array(dtype=wp.int64)
    size: wp.array(dtype=wp.int64)


@wp.struct
class Missed:
    """What the L1 of SM s misses: `misses[s]` of `accesses[s]`, from room[s] on, with the round in which it is asked for and the
    lanes that wait for it. wanted: lanes that asked for a line, each counted.

    slot_warp, slot_round: (sms * slots,) what runs, -1: nothing; seen: (sms * seen_size,) the lines of a warp's round, and
    seen_at: where each one missed, -1: it hit.
    """

    room: wp.array(dtype=wp.int64)
    line: wp.array(dtype=wp.int64)
    time: wp.array(dtype=wp.int64)
    lanes: wp.array(dtype=wp.int64)
    wanted: wp.array(dtype=wp.int64)
    accesses: wp.array(dtype=wp.int64)
    misses: wp.array(dtype=wp.int64)
    slot_warp: wp.array(dtype=wp.int32)
    slot_round: wp.array(dtype=wp.int64)
    seen: wp.array(dtype=wp.int64)
    seen_at: wp.array(dtype=wp.int64)
    seen_size: int


@wp.func
def play_round(trace: Trace, caches: Caches, out: Missed, sm: int, warp: int, step: wp.int64, time: wp.int64) -> bool:
    """Each lane makes its fetch number `step`; a line that several lanes touch is asked for once. Whether any has one more."""
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
                        at = out.room[sm] + out.misses[sm]
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
    """One SM: in each round every warp that has a slot makes one fetch a lane; a warp that ends makes room for the next one."""
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
