"""Simulated caches: the same as lists in plain Python, and as closed forms."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from wrt.accel import build
from wrt.cache_sim import LINE, Cache, distinct_lines, lines_of, replay, simulate, starts, warp_stream
from wrt.errors import InputError
from wrt.kernels.counters import PRIMITIVE_SPACE
from wrt.shapes import icosphere


def plain_replay(line: list[int], cache: Cache) -> list[bool]:
    """Each set a list, the most recently used line first."""
    sets: dict[int, list[int]] = {}
    hits = []
    for each in line:
        ways = sets.setdefault(each % cache.sets, [])
        hits.append(each in ways)
        if each in ways:
            ways.remove(each)
        ways.insert(0, each)
        del ways[cache.ways:]
    return hits


def one(line: np.ndarray, cache: Cache) -> np.ndarray:
    return replay(np.array([0, len(line)]), line, cache)


@pytest.mark.parametrize("cache", [Cache(1024, 1), Cache(4096, 4), Cache(3 * 8 * LINE, 8), Cache(16 * LINE, 16)])
def test_replay_is_that_of_lists_in_python(cache: Cache) -> None:
    rng = np.random.default_rng(1)
    line = np.minimum(rng.geometric(0.02, 5000), rng.integers(0, 400, 5000)).astype(np.int64)
    first = np.array([0, 1500, 1500, 5000])
    found = replay(first, line, cache)
    expected = [hit for a, b in pairwise(first) for hit in plain_replay(line[a:b].tolist(), cache)]
    assert found.tolist() == expected and 0.0 < found.mean() < 1.0


def test_closed_forms() -> None:
    cache = Cache(64 * LINE, 4)
    assert not one(np.arange(1000), cache).any()  # streaming: nothing comes twice
    resident = np.tile(np.arange(64), 10)
    assert one(resident, cache).sum() == 9 * 64  # fits: all but the first round hit
    assert not one(np.tile(np.arange(80), 10), cache).any()  # 5 lines round and round in 4 ways: LRU's worst case
    half = one(np.tile(np.arange(72), 10), cache)  # 8 of 16 sets have 5 lines, the others 4
    assert half.sum() == 9 * 8 * 4
    same_set = np.tile(np.arange(5) * cache.sets, 10)
    assert not one(same_set, cache).any() and one(same_set, Cache(64 * LINE, 64)).sum() == 45


def test_a_larger_cache_of_one_set_never_hits_less() -> None:
    line = np.random.default_rng(2).integers(0, 60, 3000)
    hits = [one(line, Cache(ways * LINE, ways)).sum() for ways in (1, 2, 7, 20, 60)]
    assert hits == sorted(hits) and hits[-1] == 3000 - len(np.unique(line))


def test_lines_of_fetches() -> None:
    address, size = np.array([0, 100, 128, 0]), np.array([128, 40, 1, 300])
    line, fetch = lines_of(address, size)
    assert line.tolist() == [0, 0, 1, 1, 0, 1, 2] and fetch.tolist() == [0, 1, 1, 2, 3, 3, 3]
    assert distinct_lines(np.array([0, 2, 2, 4]), address, size).tolist() == [2, 0, 3]


def test_warps_wait_for_a_slot() -> None:
    begin, sm, slot = starts(np.array([5, 7, 2, 1, 4, 9]), sms=2, slots=1)
    assert begin.tolist() == [0, 0, 5, 7, 7, 8] and sm.tolist() == [0, 1] * 3
    begin, _, slot = starts(np.array([5, 3, 1, 1]), sms=1, slots=2)
    assert begin.tolist() == [0, 0, 3, 4] and slot.tolist() == [0, 1, 1, 1]


def test_a_warp_asks_for_a_line_once_a_round() -> None:
    """Four rays, two warps, one SM with one slot; lines by round."""
    first = np.array([0, 2, 4, 5, 6])
    address = np.array([0, 128, 64, 256, 0, int(PRIMITIVE_SPACE)])
    stream = warp_stream(np.array([0, 0, 1, 1]), first, address, np.full(6, 32), sms=1, slots=1)
    assert stream.line.tolist() == [0, 1, 2, 0, 3]  # the primitive's line stands behind the nodes' three
    assert stream.time.tolist() == [0, 1, 1, 2, 2]
    misses = simulate(stream, Cache(8 * LINE, 8), Cache(8 * LINE, 8))
    assert (misses.accesses, misses.l1, misses.l2, misses.compulsory) == (5, 4, 4, 4)
    assert simulate(stream, Cache(LINE, 1), Cache(8 * LINE, 8), warm=True).l2 == 0


def test_a_recorded_trace_in_the_order_of_warps() -> None:
    """All of it again in plain Python: rounds, slots, lines, both levels."""
    rng = np.random.default_rng(3)
    origins = rng.normal(size=(300, 3))
    directions = 0.3 * rng.normal(size=(300, 3)) - origins
    counters = build(icosphere(4), "bvh2").closest_hit(3.0 * origins, directions, trace=True).counters
    assert counters is not None
    warp, sms, slots, l1, l2 = np.arange(300) // 32, 3, 2, Cache(16 * LINE, 4), Cache(64 * LINE, 16)
    space = int(PRIMITIVE_SPACE)  # where primitives begin; here, as in memory, behind the nodes
    behind = LINE * (1 + int((counters.address + counters.size)[counters.address < space].max() - 1) // LINE)
    address = np.where(counters.address >= space, counters.address - space + behind, counters.address).tolist()
    fetches = [list(zip(address[i:j], counters.size[i:j].tolist(), strict=True)) for i, j in pairwise(counters.first)]
    events = []
    for sm in range(sms):
        free = [0] * slots
        for w in range(sm, 10, sms):
            rays = fetches[32 * w:32 * w + 32]
            slot = free.index(min(free))
            for k in range(max(map(len, rays))):
                touched = {line for ray in rays if k < len(ray) for line in range(ray[k][0] // LINE, sum(ray[k], -1) // LINE + 1)}
                events += [(free[slot] + k, sm, slot, line) for line in sorted(touched)]
            free[slot] += max(map(len, rays))
    caches: list[list[int]] = [[event[3] for event in sorted(events) if event[1] == sm] for sm in range(sms)]
    hits = [plain_replay(lines, l1) for lines in caches]
    below = [(event, hit) for sm in range(sms)
             for event, hit in zip([e for e in sorted(events) if e[1] == sm], hits[sm], strict=True)]
    missed = [event[3] for event, hit in sorted(below, key=lambda each: each[0][:2]) if not hit]
    found = simulate(warp_stream(warp, counters.first, counters.address, counters.size, sms, slots), l1, l2)
    assert found.accesses == len(events) and found.compulsory == len({event[3] for event in events})
    assert found.l1 == len(missed) < len(events) and found.l2 == plain_replay(missed, l2).count(False) < len(missed)


def test_what_is_no_cache_is_refused() -> None:
    for size, ways in ((100, 1), (1024, 0), (1024, 16)):
        with pytest.raises(InputError, match="a cache of"):
            Cache(size, ways)
