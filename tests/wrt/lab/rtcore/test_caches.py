"""Simulated caches: the same as lists in plain Python, and as closed forms."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from wrt.accel.queries.answers import Counters
from wrt.accel.scenes.build import build
from wrt.kernels.traverse.observer import PRIMITIVE_SPACE
from wrt.lab.rtcore.caches import LINE, Cache, Misses, Prefetches, distinct_lines, first_level, lines_of, replay, second_level
from wrt.scene.shapes import icosphere


def made(warp: np.ndarray, first: np.ndarray, address: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, Counters]:
    return warp, Counters(np.zeros(0), first, address, size)


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


@pytest.mark.parametrize("cache", [Cache(1024, 1), Cache(4096, 4), Cache(3 * 8 * LINE, 8), Cache(16 * LINE, 16)])
def test_replay_is_that_of_lists_in_python(cache: Cache) -> None:
    rng = np.random.default_rng(1)
    line = np.minimum(rng.geometric(0.02, 5000), rng.integers(0, 400, 5000)).astype(np.int64)
    found = replay(line, cache)
    assert found.tolist() == plain_replay(line.tolist(), cache) and 0.0 < found.mean() < 1.0


def test_closed_forms() -> None:
    cache = Cache(64 * LINE, 4)
    assert not replay(np.arange(1000), cache).any()  # streaming: nothing comes twice
    resident = np.tile(np.arange(64), 10)
    assert replay(resident, cache).sum() == 9 * 64  # fits: all but the first round hit
    assert not replay(np.tile(np.arange(80), 10), cache).any()  # 5 lines round and round in 4 ways: LRU's worst case
    half = replay(np.tile(np.arange(72), 10), cache)  # 8 of 16 sets have 5 lines, the others 4
    assert half.sum() == 9 * 8 * 4
    same_set = np.tile(np.arange(5) * cache.sets, 10)
    assert not replay(same_set, cache).any() and replay(same_set, Cache(64 * LINE, 64)).sum() == 45


def test_lines_of_fetches() -> None:
    address, size = np.array([0, 100, 128, 0]), np.array([128, 40, 1, 300])
    line, fetch = lines_of(address, size)
    assert line.tolist() == [0, 0, 1, 1, 0, 1, 2] and fetch.tolist() == [0, 1, 1, 2, 3, 3, 3]
    assert distinct_lines(np.array([0, 2, 2, 4]), address, size).tolist() == [2, 0, 3]


def simulate(warps: tuple[np.ndarray, Counters], machine: tuple[int, int, Cache, Cache], warm: bool = False) -> Misses:
    sms, slots, l1, l2 = machine
    return second_level(first_level(*warps, sms, slots, l1), l2, warm)


def test_a_warp_asks_for_a_line_once_a_round() -> None:
    """Four rays, two warps, one SM with one slot."""
    first = np.array([0, 2, 4, 5, 6])
    address = np.array([0, 128, 64, 256, 0, int(PRIMITIVE_SPACE)])
    warps = made(np.array([0, 0, 1, 1]), first, address, np.full(6, 32))
    missed = first_level(*warps, 1, 1, Cache(8 * LINE, 8))
    assert missed.accesses == 5 and missed.line.tolist() == [0, 1, 2, 3]  # the primitive's line stands behind the nodes' three
    assert missed.time.tolist() == [0, 1, 1, 2]
    machine = (1, 1, Cache(LINE, 1), Cache(8 * LINE, 8))
    assert simulate(warps, machine) == Misses(accesses=5, l1=5, l2=4, compulsory=4, wanted=6, wait_l2=6, wait_dram=5)
    assert simulate(warps, machine, warm=True).l2 == 0


def test_no_rays() -> None:
    none = np.zeros(0, np.int64)
    machine = (4, 2, Cache(LINE, 1), Cache(LINE, 1))
    assert simulate(made(none, np.zeros(1, np.int64), none, none), machine) == Misses(0, 0, 0, 0, 0, 0, 0)


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
    events, lanes = [], []
    for sm in range(sms):
        free = [0] * slots
        for w in range(sm, 10, sms):
            rays = fetches[32 * w:32 * w + 32]
            slot = free.index(min(free))
            for k in range(max(map(len, rays))):
                touched = dict.fromkeys(
                    line for ray in rays if k < len(ray) for line in range(ray[k][0] // LINE, sum(ray[k], -1) // LINE + 1))
                events += [(free[slot] + k, sm, slot, i, line) for i, line in enumerate(touched)]
                lanes += [((free[slot] + k, sm, slot, line), 1) for ray in rays if k < len(ray)
                          for line in range(ray[k][0] // LINE, sum(ray[k], -1) // LINE + 1)]
            free[slot] += max(map(len, rays))
    caches: list[list[int]] = [[event[4] for event in sorted(events) if event[1] == sm] for sm in range(sms)]
    hits = [plain_replay(lines, l1) for lines in caches]
    below = [(event, hit) for sm in range(sms)
             for event, hit in zip([e for e in sorted(events) if e[1] == sm], hits[sm], strict=True)]
    missed = [event[4] for event, hit in sorted(below, key=lambda each: each[0][:2]) if not hit]
    waits = {(event[0], event[1], event[2], event[4]) for event, hit in below if not hit}
    found = simulate(made(warp, counters.first, counters.address, counters.size), (sms, slots, l1, l2))
    assert found.accesses == len(events) and found.compulsory == len({event[4] for event in events})
    assert found.l1 == len(missed) < len(events) and found.l2 == plain_replay(missed, l2).count(False) < len(missed)
    assert found.wanted == len(lanes) > len(events) and found.wait_l2 == sum(key in waits for key, _ in lanes)
    deep = [hit for hit in plain_replay(missed, l2)]
    ordered = [event for event, hit in sorted(below, key=lambda each: each[0][:2]) if not hit]
    dram = {(e[0], e[1], e[2], e[4]) for e, hit in zip(ordered, deep, strict=True) if not hit}
    assert found.wait_dram == sum(key in dram for key, _ in lanes)


def test_prefetches_are_those_of_lists_in_python() -> None:
    """Two warps on one SM with one slot: a round accesses the lines of all fetches, then those of their prefetches, which cost no wait."""
    rng = np.random.default_rng(4)
    length = rng.integers(1, 30, 40)
    first = np.concatenate([[0], np.cumsum(length)])
    total = int(first[-1])
    address, size = rng.integers(0, 60, total) * 64, rng.integers(1, 200, total)
    after = np.sort(rng.integers(0, total, 300))
    more = Prefetches(after, rng.integers(0, 60, 300) * 64, rng.integers(1, 200, 300))
    warp, l1 = np.arange(40) // 32, Cache(16 * LINE, 4)
    missed = first_level(*made(warp, first, address, size), 1, 1, l1, more)

    def lines(of: tuple[np.ndarray, np.ndarray], i: int) -> range:
        return range(int(of[0][i]) // LINE, int(of[0][i] + of[1][i] - 1) // LINE + 1)

    order, waiting, wanted = [], [], 0
    for rays in (range(32), range(32, 40)):
        for k in range(int(length[rays].max())):
            now = [int(first[ray]) + k for ray in rays if k < length[ray]]
            asked = [line for j in now for line in lines((address, size), j)]
            ahead = [line for j in now for i in np.flatnonzero(after == j) for line in lines((more.address, more.size), int(i))]
            wanted += len(asked)
            for line in dict.fromkeys([*asked, *ahead]):
                order.append(line)
                waiting.append(asked.count(line))
    hits = plain_replay(order, l1)
    assert missed.accesses == len(order) and missed.wanted == wanted
    assert missed.line.tolist() == [line for line, hit in zip(order, hits, strict=True) if not hit]
    assert missed.lanes.tolist() == [lanes for lanes, hit in zip(waiting, hits, strict=True) if not hit]
    assert 0 in missed.lanes
