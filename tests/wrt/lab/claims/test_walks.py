"""Walks by other rules, and replays of their logs: each kernel against a traversal or a replay in plain Python."""

from __future__ import annotations

import itertools
from collections import OrderedDict, deque
from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.rewalk import INF, WalkRay
from tests.rewalk import rays as with_hits
from wrt.accel.bvh.six import Bvh6
from wrt.accel.cells.trees import KdTree
from wrt.accel.geometry import Geometry
from wrt.kernels.study.k_hits import KEPT
from wrt.lab.claims.classics import split_references
from wrt.lab.claims.memory import cut, schedule
from wrt.lab.claims.prefetch import AHEAD, Accesses, fully_associative, in_order, replayed, through_caches, through_l2
from wrt.lab.claims.scenes import hall, statue
from wrt.lab.claims.stacks import FULL, cloud, k_walk, short_walk
from wrt.lab.claims.walks import NODE_BYTES, Rays, Rules, Tree, Walk, build_tree, tree_of, walk
from wrt.lab.claims.warps import LOOP_NAMES, helped, looped, repacked
from wrt.lab.rtcore.caches import LINE, Cache
from wrt.scene.shapes import icosphere

RULES = [Rules(a, b, c) for a in (False, True) for b in (False, True) for c in (False, True)]
BALLS = Geometry(np.concatenate([(0.3 + 0.2 * k) * icosphere(2).vertices + [0.1 * k, 0.0, 0.0] for k in range(4)]).astype(np.float32),
                 np.concatenate([icosphere(2).faces + len(icosphere(2).vertices) * k for k in range(4)]).astype(np.int32),
                 np.zeros((0, 4), np.float32))


@cache
def some_rays(n: int = 96) -> Rays:
    rng = np.random.default_rng(3)
    origins = (1.5 * rng.normal(size=(n, 3))).astype(np.float32)
    directions = (0.4 * rng.normal(size=(n, 3)) - origins).astype(np.float32)
    return Rays(origins, directions, np.where(np.arange(n) % 5 == 0, 0.9, np.inf).astype(np.float32), (np.arange(n) % 3 == 0).astype(int),
                np.zeros(n, int), np.arange(n), np.arange(n) // 32)


@cache
def hits_of() -> list[dict[int, np.float32]]:
    """Return all hits of each ray, by brute force."""
    rays = some_rays()
    return [ray.hits for ray in with_hits(BALLS, rays.origins, rays.directions)]


def twin(tree: Tree, i: int, rules: Rules) -> tuple[list[int], list[int], list[int], int]:
    """Traverse with ray i in plain Python: references of the fetches, number of pushes after each, references pushed, prim_id."""
    rays, wide, width = some_rays(), tree.wide, tree.width
    ray = WalkRay(rays.origins[i], rays.directions[i], np.float32(0.0), rays.t_max[i], hits_of()[i])
    fetches, entered, pushed = (list[int]() for _ in range(3))
    waiting = deque([(np.float32(0.0), 0)])
    while waiting:
        t, reference = waiting.popleft() if rules.queue else waiting.pop()
        if fetches and rules.culled and t > ray.best[0]:
            continue
        fetches.append(reference)
        found = []
        if reference < 0:
            first, count = (-1 - reference) >> 6, (-1 - reference & 63) + 1
            for prim_id in wide.order[first : first + -(-count // width)].reshape(-1)[:count].tolist():
                if prim_id in ray.hits:
                    ray.best = min(ray.best, (ray.hits[prim_id], prim_id))
        else:
            found = [(t, int(child)) for child, lo, hi in zip(wide.children[reference], wide.lo[reference], wide.hi[reference], strict=True)
                     if child and (t := ray.enter(lo, hi)) < INF]
            if rules.ordered:
                found.sort(key=lambda each: (each[0], each[1] % (1 << 32)), reverse=not rules.queue)
        waiting.extend(found)
        entered.append(len(found))
        pushed += [child for _, child in found]
        if rays.kind[i] == 1 and ray.best[1] < 1 << 31:
            break
    return fetches, entered, pushed, ray.best[1] if ray.best[1] < 1 << 31 else -1


@pytest.mark.parametrize("rules", RULES, ids=str)
@pytest.mark.parametrize(("width", "max_leaf", "bits"), [(2, 1, 32), (6, 1, 8), (8, 5, 12)])
def test_a_walk_is_that_of_plain_python(width: int, max_leaf: int, bits: int, rules: Rules) -> None:
    tree = build_tree(BALLS, width, max_leaf, bits)
    log = walk(tree, some_rays(), rules, log=True)
    for i in range(len(some_rays())):
        fetches, entered, pushed, prim_id = twin(tree, i, rules)
        rows = slice(log.first[i], log.first[i + 1])
        assert log.fetch[rows].tolist() == fetches and log.entered[rows].tolist() == entered
        assert log.push[log.push_first[i] : log.push_first[i + 1]].tolist() == pushed
        assert log.counts["prim_id"][i] == prim_id or (some_rays().kind[i] == 1 and prim_id >= 0)


def test_bvh6_counts_what_the_study_counts() -> None:
    accel, rays = Bvh6(BALLS), some_rays()
    counters = accel.closest_hit(rays.origins, rays.directions, 0.0, rays.t_max, counters=True).counters
    assert counters is not None
    rays = rays.part(np.arange(len(rays)))
    rays.kind[...] = 0
    counts = walk(tree_of(BALLS, accel.decoded()), rays, Rules()).counts
    assert np.array_equal(counts["inner"], counters.nodes) and np.array_equal(counts["leaves"], counters.leaves)


def stack_twin(log: Walk, i: int, ahead: tuple[int, int, int]) -> tuple[list[int], list[int]]:
    """Replay a stack in plain Python: the steps at which each entry of ray i is used and prefetched."""
    fetches, entered = (list(each[log.first[i] : log.first[i + 1]]) for each in (log.fetch, log.entered))
    pushes = list(log.push[log.push_first[i] : log.push_first[i + 1]])
    stack: list[int] = []
    used, prefetched, next_push, in_row = [-1] * len(pushes), [-1] * len(pushes), 0, 0
    for step, (fetch, count) in enumerate(zip(fetches, entered, strict=True)):
        if step:
            while pushes[stack[-1]] != fetch:
                stack.pop()
            used[stack.pop()] = step
            in_row = 1 if entered[step - 1] else in_row + 1
            for entry in stack[::-1][: ahead[min(in_row, 3) - 1]]:
                prefetched[entry] = step if prefetched[entry] < 0 else prefetched[entry]
        stack += range(next_push, next_push + count)
        next_push += count
    return used, prefetched


@pytest.mark.parametrize("rules", [Rules(False, False), Rules(True, True)], ids=str)
@pytest.mark.parametrize("ahead", [AHEAD, (0, 3, 5)])
def test_a_stack_is_replayed_as_in_plain_python(rules: Rules, ahead: tuple[int, int, int]) -> None:
    log = walk(build_tree(BALLS, 6), some_rays(), rules, log=True)
    used, prefetched = replayed(log, ahead)
    for i in range(len(some_rays())):
        rows = slice(log.push_first[i], log.push_first[i + 1])
        assert (used[rows].tolist(), prefetched[rows].tolist()) == stack_twin(log, i, ahead)
    if not rules.culled:  # closest hits use every entry
        owner = np.repeat(np.arange(len(some_rays())), np.diff(log.push_first))
        assert (used[some_rays().kind[owner] == 0] > 0).all()


class CacheTwin:
    """A cache in plain Python. totals: fetches, their misses, prefetches that load a line, used lines."""

    def __init__(self, sets: int, ways: int) -> None:
        self.sets: list[OrderedDict[int, bool]] = [OrderedDict() for _ in range(sets)]  # line -> prefetched and unused
        self.ways, self.totals = ways, np.zeros(4, int)

    def misses(self, line: int, ahead: bool) -> bool:
        kept = self.sets[line % len(self.sets)]
        hit = line in kept
        self.totals += [not ahead, not ahead and not hit, ahead and not hit, not ahead and hit and kept[line]]
        kept[line] = ahead and (not hit or kept[line])
        kept.move_to_end(line)
        if len(kept) > self.ways:
            kept.popitem(last=False)
        return not hit


def test_caches_with_prefetches_are_those_of_plain_python() -> None:
    rng, sms, ways = np.random.default_rng(0), 3, 7
    n = 4000
    accesses = Accesses(rng.integers(200, size=n), rng.integers(40, size=n), rng.integers(60, size=n),
                        rng.integers(2, size=n).astype(np.int8))
    ordered = first, line, prefetch = in_order(accesses, np.arange(200) // 8, sms, 2)
    l1s, l2 = [CacheTwin(1, ways) for _ in range(sms)], CacheTwin(4, 5)
    for turn in range(int(np.diff(first).max())):
        for sm in range(sms):
            at = first[sm] + turn
            if at < first[sm + 1] and l1s[sm].misses(int(line[at]), bool(prefetch[at])):
                l2.misses(int(line[at]), bool(prefetch[at]))
    found = through_caches(ordered, fully_associative(ways * 64, 64))
    shared = through_l2(ordered, found.missed, Cache(4 * 5 * LINE, 5))
    for each, totals in ((found, sum((level.totals for level in l1s), np.zeros(4, int))), (shared, l2.totals)):
        assert [each.fetches, each.misses, each.prefetches, each.used] == totals.tolist() and totals.all()
    order = in_order(accesses, np.arange(200) // 8, sms, 2)
    assert len({*zip(accesses.ray // 8, accesses.step, accesses.prefetch, accesses.line, strict=True)}) == len(order[1])


def test_lanes_that_help_take_the_oldest_entries() -> None:
    rays = some_rays()
    log = walk(build_tree(BALLS, 6), rays, Rules(False, False), log=True)
    used, _ = replayed(log)
    for warp, steps in enumerate(helped(log, rays.warp)):
        pool = deque((i, 0) for i in np.flatnonzero(rays.warp == warp))
        expected = 0
        while pool:
            expected += 1
            for i, step in [pool.popleft() for _ in range(min(32, len(pool)))]:
                begin = log.push_first[i] + log.entered[log.first[i] : log.first[i] + step].sum()
                pool.extend((i, int(at)) for at in used[begin : begin + log.entered[log.first[i] + step]] if at >= 0)
        assert steps == expected


def loop_twin(lanes: list[list[int]], loop: str) -> tuple[int, int, int, int]:
    """Issue the steps of a warp in plain Python: node steps, triangle steps, and the lanes that work in each. lanes: 0 a node, n a leaf."""
    queues, held, counts = [deque(lane) for lane in lanes], [0] * len(lanes), [0, 0, 0, 0]

    def take() -> None:
        for i, queue in enumerate(queues):
            if not held[i] and queue and queue[0] > 0:
                held[i] = queue.popleft()

    take()
    while any(queues) or any(held):
        while any(queue and queue[0] == 0 and not held[i] for i, queue in enumerate(queues)):
            go = [i for i, queue in enumerate(queues) if queue and queue[0] == 0 and (not held[i] or loop.startswith("spec"))]
            for i in go:
                queues[i].popleft()
            counts[0], counts[2] = counts[0] + 1, counts[2] + len(go)
            take()
            if loop == "if-if":
                break
        while any(held):
            busy = [i for i, left in enumerate(held) if left]
            for i in busy:
                held[i] -= 1
            counts[1], counts[3] = counts[1] + 1, counts[3] + len(busy)
            if loop == "if-if":
                break
        take()
    return counts[0], counts[1], counts[2], counts[3]


@pytest.mark.parametrize("loop", LOOP_NAMES)
def test_loops_issue_the_steps_of_plain_python(loop: str) -> None:
    rays = some_rays()
    log = walk(build_tree(BALLS, 2, 3), rays, Rules(), log=True)
    found = looped(log, rays.warp, LOOP_NAMES[loop])
    for warp in range(3):
        lanes = [[0 if r >= 0 else (-1 - int(r) & 63) + 1 for r in log.fetch[log.first[i] : log.first[i + 1]]]
                 for i in np.flatnonzero(rays.warp == warp)]
        got = [int(getattr(found, name).numpy()[warp]) for name in ("node", "test", "node_lanes", "test_lanes")]
        assert tuple(got) == loop_twin(lanes, loop)
        assert got[2] + got[3] == sum(max(n, 1) for lane in lanes for n in lane)


def test_repacking_is_between_the_warps_and_full_lanes() -> None:
    rng = np.random.default_rng(0)
    cost, warp = rng.integers(1, 200, size=2048), np.arange(2048) // 32
    alone = cost.sum() / (32 * sum(cost[warp == w].max() for w in range(64)))
    assert alone < repacked(cost, warp, 16) < repacked(cost, warp, 31) <= 1.0
    assert repacked(cost, warp, 1) == pytest.approx(alone)
    assert repacked(np.full(64, 7), np.arange(64) // 32) == 1.0


def test_planes_of_fewer_bits_give_larger_boxes_and_the_same_hits() -> None:
    rays = some_rays()
    trees = [build_tree(BALLS, 8, 4, bits) for bits in (32, 12, 8, 4)]
    for finer, coarser in itertools.pairwise(trees):
        exists = finer.wide.exists
        for axis in range(3):
            assert (coarser.wide.lo[exists][:, axis] <= trees[0].wide.lo[exists][:, axis]).all()
            assert (coarser.wide.hi[exists][:, axis] >= trees[0].wide.hi[exists][:, axis]).all()
        one, two = (walk(tree, rays, Rules(False, False)).counts for tree in (finer, coarser))
        assert two["boxes"].sum() >= one["boxes"].sum() and np.array_equal(one["prim_id"], two["prim_id"])
    assert (trees[-1].wide.hi - trees[-1].wide.lo)[exists].sum() > 1.05 * (trees[0].wide.hi - trees[0].wide.lo)[exists].sum()


@pytest.mark.parametrize("width", [2, 4, 8])
def test_a_short_stack_finds_the_same_hits(width: int) -> None:
    rays, tree = some_rays(), build_tree(BALLS, width, 2, bits=8 if width == 8 else 32)
    full = walk(tree, rays, Rules()).counts
    last = None
    for entries in (FULL, 3, 2, 1, 0):
        counts = short_walk(tree, rays, entries)
        for name in ("prim_id", "t", "leaves", "tests"):
            assert np.array_equal(counts[name], full[name])
        assert entries < FULL or np.array_equal(counts["inner"], full["inner"])
        assert last is None or (counts["inner"] >= last).all()
        last = counts["inner"]


def stackless_twin(tree: Tree, i: int) -> int:
    """Traverse without a stack in plain Python: each pop reads again the nodes from the root to the entry. Return the inner nodes read."""
    rays, wide = some_rays(), tree.wide
    ray = WalkRay(rays.origins[i], rays.directions[i], np.float32(0.0), rays.t_max[i], hits_of()[i])
    nodes = 0
    path: tuple[Any, ...] = ()
    waiting: list[Any] = [(np.float32(0.0), 0, path)]  # an entry: t, reference, and (t, reference) of its ancestors and itself
    while waiting:
        t, reference, path = waiting.pop()
        if path:
            read = next((level for level, (begin, _) in enumerate(path) if begin > ray.best[0]), None)
            levels = len(path) if read is None else read + 1
            nodes += levels
            # Each node that is read again shows which of its waiting children are behind the best hit by now.
            waiting = [entry for entry in waiting if entry[0] <= ray.best[0] or len(entry[2]) > levels
                       or entry[2][:-1] != path[: len(entry[2]) - 1]]
            if read is not None:  # that child and the siblings behind it are culled, with all that waits below them
                waiting = [entry for entry in waiting if entry[2][:read] != path[:read] or len(entry[2]) <= read]
                continue
        while True:
            if reference < 0:
                first = (-1 - reference) >> 6
                for prim_id in wide.order[first, : (-1 - reference & 63) + 1].tolist():
                    if prim_id in ray.hits:
                        ray.best = min(ray.best, (ray.hits[prim_id], prim_id))
                break
            nodes += 1
            found = sorted((t, int(c) % (1 << 32), int(c)) for c, lo, hi in
                           zip(wide.children[reference], wide.lo[reference], wide.hi[reference], strict=True)
                           if c and (t := ray.enter(lo, hi)) < INF)
            if not found:
                break
            waiting += [(t, c, (*path, (t, c))) for t, _, c in found[:0:-1]]
            path, reference = (*path, (found[0][0], found[0][2])), found[0][2]
    return nodes


@pytest.mark.parametrize("width", [2, 6])
def test_without_a_stack_each_pop_begins_at_the_root(width: int) -> None:
    rays = some_rays().part(np.arange(len(some_rays())))
    rays.kind[...] = 0
    tree = build_tree(BALLS, width, 2)
    assert short_walk(tree, rays, 0)["inner"].tolist() == [stackless_twin(tree, i) for i in range(len(rays))]


def test_k_hits_are_the_nearest_and_the_bound_only_saves_nodes() -> None:
    rays = some_rays()
    tree = build_tree(BALLS, 6)
    free, bound = (k_walk(tree, rays, each) for each in (False, True))
    for i, hits in enumerate(hits_of()):
        near = sorted(t for t in hits.values() if t <= rays.t_max[i])[:KEPT]
        for counts in (free, bound):
            assert counts["prim_id"][i] == len(near) and counts["t"][i] == (near[-1] if near else np.inf)
    assert (bound["inner"] <= free["inner"]).all()
    crowded = Geometry.of(cloud(3000))
    dense = build_tree(crowded, 6)
    free, bound = (k_walk(dense, rays, each) for each in (False, True))
    assert np.array_equal(free["t"], bound["t"]) and bound["inner"].sum() < free["inner"].sum()


def test_treelets_hold_every_node_once_and_rays_make_every_fetch() -> None:
    tree, rays = build_tree(BALLS, 6), some_rays()
    treelet = cut(tree.wide, 640)
    assert (treelet >= 0).all() and np.bincount(treelet).max() <= 640 // NODE_BYTES
    log = walk(tree, rays, Rules(), log=True)
    item = log.address // NODE_BYTES
    moves = sum(1 + int((np.diff(treelet[item[log.first[i] : log.first[i + 1]]]) != 0).sum()) for i in range(len(rays)))
    found = schedule(log, treelet)
    assert found.moves == moves and len(np.unique(log.address // 128)) <= found.lines <= len(log.fetch)
    whole = schedule(log, np.zeros_like(treelet))  # one treelet: every line is loaded once
    assert whole.moves == len(rays) and whole.lines == len(np.unique(log.address // 128))


def test_generated_scenes_have_the_stated_size() -> None:
    assert len(statue().faces) == 81_920 and 80_000 < len(hall().faces) < 120_000


def test_the_references_of_split_cells_are_those_of_plain_python() -> None:
    tree = KdTree(BALLS)
    nodes = tree.built.arrays["nodes"]
    total = 0

    def below(node: int) -> set[int]:
        nonlocal total
        first, axis = divmod(int(nodes["word"][node]), 4)
        if axis == 3:
            return set(tree.built.order[first : first + int(nodes["split"][node])].tolist())
        found = below(first) | below(first + 1)
        total += len(found)
        return found

    assert below(0) == set(range(len(BALLS)))
    assert split_references(tree) == total > len(BALLS)
