"""Claims about prefetching the next entries of the stack."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from wrt.core.device import launch, start, upload
from wrt.core.threads import thread_count
from wrt.core.types import WarpStruct
from wrt.kernels.study import tree_walk
from wrt.kernels.study.cache_prefetch import Entries, Served, replay_prefetches, replay_stacks
from wrt.kernels.study.tree_walk import QUEUE
from wrt.lab.claims.claim import TTP_RULES, Claim, Figure, Study
from wrt.lab.claims.nodes import SETUP, THEIRS, TTP
from wrt.lab.claims.walks import NODE_BYTES, RAYS_PER_LAUNCH, Rules, Walk
from wrt.lab.rtcore.caches import LINE, Cache, caches_of

AHEAD = (1, 2, 16)
SMS, SLOTS, L1_BYTES = 8, 4, 32 << 10
L2_BYTES, L2_WAYS = 512 << 10, 16


@dataclass(frozen=True, eq=False)
class Traffic:
    """Totals of `through_caches`."""

    fetches: int
    misses: int  # Fetches that miss.
    prefetches: int  # Prefetches that load a line.
    used: int  # Lines among these that a fetch uses.
    missed: np.ndarray  # (A,) bool, True if the line of an access was not in the cache.


def device_log(log: Walk) -> WarpStruct:
    cpu, out = start("cpu"), tree_walk.WalkLog()
    out.fetch_first, out.push_first = upload(log.first.copy(), wp.int64, cpu), upload(log.push_first.copy(), wp.int64, cpu)
    out.fetch, out.push = upload(log.fetch.copy(), wp.int32, cpu), upload(log.push.copy(), wp.int32, cpu)
    out.entered = upload(log.entered.astype(np.int8), wp.int8, cpu)
    return out


def replayed(log: Walk, ahead: tuple[int, int, int] = AHEAD) -> tuple[np.ndarray, np.ndarray]:
    """Return the step at which each pushed entry is used, and at which it is prefetched, (P,) int32 each; -1 for never.
    The log must be one of a stack."""
    cpu, n, out = start("cpu"), len(log.counts), Entries()
    out.used, out.prefetched = (wp.full(len(log.push), -1, dtype=wp.int32, device=cpu) for _ in range(2))
    scratch, given = wp.empty(RAYS_PER_LAUNCH * int(QUEUE), dtype=wp.int64, device=cpu), device_log(log)
    launch(replay_stacks, n, given, wp.vec3i(*ahead), None, scratch, out, step=RAYS_PER_LAUNCH)
    return out.used.numpy().copy(), out.prefetched.numpy().copy()


@dataclass(frozen=True, eq=False)
class Accesses:
    """Accesses of rays to memory, (A,) each: ray, step of the ray, cache line, and whether it is a prefetch, which follows the step's
    fetch."""

    ray: np.ndarray
    step: np.ndarray
    line: np.ndarray
    prefetch: np.ndarray


def in_order(accesses: Accesses, warp: np.ndarray, sms: int, slots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return first (sms + 1,), line and prefetch, in the order in which each SM makes the accesses.
    SM i runs the warps i, i + sms, ..., `slots` at a time until all of these end. In a round, each warp in turn makes one step of all its
    rays,
    in which equal lines are one access."""
    w = warp[accesses.ray]
    sm, batch = w % sms, w // sms // slots
    order = np.lexsort((accesses.ray, accesses.line, accesses.prefetch, w, accesses.step, batch, sm))
    keys = np.stack([sm, batch, accesses.step, w, accesses.prefetch, accesses.line])[:, order]
    fresh = np.concatenate([[True], (keys[:, 1:] != keys[:, :-1]).any(axis=0)]) if keys.shape[1] else np.zeros(0, bool)
    return np.searchsorted(keys[0, fresh], np.arange(sms + 1)).astype(np.int64), keys[5, fresh], keys[4, fresh].astype(np.int8)


def through_caches(ordered: tuple[np.ndarray, np.ndarray, np.ndarray], cache: Cache) -> Traffic:
    """Replay accesses in order through one L1 per SM. cache: `sets` and `ways` count lines."""
    first, line, prefetch = ordered
    cpu, sms, out = start("cpu"), len(first) - 1, Served()
    out.fetches, out.misses, out.prefetches, out.used = (wp.zeros(sms, dtype=wp.int64, device=cpu) for _ in range(4))
    out.missed = wp.zeros(len(line), dtype=wp.int8, device=cpu)
    caches, arrays = caches_of(cache, sms), (upload(first, wp.int64, cpu), upload(line, wp.int64, cpu), upload(prefetch, wp.int8, cpu))
    launch(replay_prefetches, sms, caches, *arrays, None, out, threads=thread_count(None), step=1)
    fetches, misses, prefetches, used = (int(getattr(out, name).numpy().sum()) for name in ("fetches", "misses", "prefetches", "used"))
    return Traffic(fetches, misses, prefetches, used, out.missed.numpy().astype(bool))


def through_l2(ordered: tuple[np.ndarray, np.ndarray, np.ndarray], missed: np.ndarray, cache: Cache) -> Traffic:
    """Replay the accesses that missed in the L1s through an L2 that all SMs share. The SMs make one access to their L1s each, in turn."""
    first, line, prefetch = ordered
    turn = np.arange(len(line)) - np.repeat(first[:-1], np.diff(first))
    order = np.argsort(turn, kind="stable")
    order = order[missed[order]]
    return through_caches((np.array([0, len(order)]), line[order], prefetch[order]), cache)


def fully_associative(size: int, line: int) -> Cache:
    """Return a fully associative cache of `size` bytes; caches.Cache counts lines of 128 bytes."""
    return Cache(size // line * 128, size // line)


def fetches_of(log: Walk) -> Accesses:
    step = np.arange(len(log.fetch)) - log.first[log.owner]
    return Accesses(log.owner, step, log.address // NODE_BYTES, np.zeros(len(step), np.int8))


def with_prefetches(log: Walk, prefetched: np.ndarray) -> Accesses:
    """Return the fetches of a log and its prefetches. prefetched: second result of `replayed`."""
    demand, chosen = fetches_of(log), prefetched >= 0
    owner = np.repeat(np.arange(len(log.counts)), np.diff(log.push_first))[chosen]
    line = log.addresses(log.push[chosen]) // NODE_BYTES
    return Accesses(np.concatenate([demand.ray, owner]), np.concatenate([demand.step, prefetched[chosen]]),
                    np.concatenate([demand.line, line]), np.concatenate([demand.prefetch, np.ones(len(line), np.int8)]))


def accuracy(log: Walk) -> tuple[float, float]:
    """Return the share of prefetched entries that are fetched later, and the share of fetches that were prefetched, without a cache."""
    used, prefetched = replayed(log)
    both = (used >= 0) & (prefetched >= 0) & (prefetched < used)
    return float(both.sum() / max((prefetched >= 0).sum() - ((prefetched >= 0) & (prefetched == used)).sum(), 1)), float(
        both.sum() / max(len(log.fetch), 1))


def ttp_prefetch(study: Study) -> Iterator[Figure]:
    """Prefetch the next 1, 2 and 16 entries, through an L1 and without a cache, for three walks."""
    name = "sponza"
    log, warp, l1 = study.ttp(name), study.rays(name).warp, fully_associative(L1_BYTES, NODE_BYTES)
    _, prefetched = replayed(log)
    orders = [in_order(each, warp, SMS, SLOTS) for each in (fetches_of(log), with_prefetches(log, prefetched))]
    plain, ahead = (through_caches(each, l1) for each in orders)
    l2_plain, l2_ahead = (through_l2(order, each.missed, Cache(L2_BYTES // NODE_BYTES * LINE, L2_WAYS))
                          for order, each in zip(orders, (plain, ahead), strict=True))
    kinds = {"unsorted, not culled": TTP_RULES, "unsorted, culled": Rules(False, True), "sorted, culled": Rules(True, True)}
    found = {said: accuracy(study.ttp(name, rules=each)) for said, each in kinds.items()}
    said = (f"{study.differences(name, THEIRS[name])}; one scene instead of the mean of 16; lines of {NODE_BYTES} bytes instead of sectors;"
            " a prefetch arrives at once, so coverage is an upper bound")
    cover = (f"of {plain.fetches} accesses {plain.misses / plain.fetches:.1%} miss without prefetches; the stack holds the next entry early"
             f" for {found['unsorted, not culled'][1]:.1%} of the fetches")
    yield Figure("used share of the prefetched lines, L1", 100.0 * ahead.used / max(ahead.prefetches, 1), 98.92, "%", said, cover)
    yield Figure("L1 misses that prefetches remove (their coverage)", 100.0 * (plain.misses - ahead.misses) / plain.misses, 31.54, "%",
                 said, cover)
    yield Figure("L2 misses of fetches that prefetches remove", 100.0 * (l2_plain.misses - l2_ahead.misses) / l2_plain.misses, 40.0, "%",
                 said, f"lines from DRAM: {l2_plain.misses} without prefetches; {l2_ahead.misses} for fetches and {l2_ahead.prefetches} for"
                       " prefetches with them")
    for kind, (right, covered) in found.items():
        yield Figure(f"prefetched entries that are fetched later, {kind}", 100.0 * right, None, "%",
                     f"without a cache; {covered:.1%} of the fetches were prefetched. Only any-hit rays that end early leave entries unused"
                     " where nothing is culled: the accuracy is a property of that walk")


TTP_PREFETCH = Claim(f"{TTP}, Figure 14 and Table III",
                     f"{SETUP}; 8 SMs, L1 of 32 KB, fully associative, LRU, L2 of 512 KB, 16 ways, 4 warps a unit; 1, 2, 16 entries at"
                     " the 1st, 2nd, 3rd pop in a row",
                     "read", ttp_prefetch)
