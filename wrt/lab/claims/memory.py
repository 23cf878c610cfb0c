"""Claims about memory: treelets and their traffic, treelet prefetching, compressed nodes, boxes and triangles of 8 bits."""

import heapq
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from wrt.accel.bvh.wide_tree import WideTree, leaf_rows
from wrt.accel.scenes.build import build
from wrt.lab.bench.rays import counters_of
from wrt.lab.claims.claim import Claim, Figure, Study
from wrt.lab.claims.nodes import THEIRS
from wrt.lab.claims.prefetch import SLOTS, SMS, Accesses, fetches_of, fully_associative, in_order, through_caches
from wrt.lab.claims.walks import NODE_BYTES, Rules, Walk, walk
from wrt.lab.rtcore.caches import LINE, Cache


def cut(tree: WideTree, size: int) -> np.ndarray:
    """Return the treelet of each inner node and of each leaf, (nodes + rows,) int64; leaf row r has the index nodes + r. Treelets and
    their queues: Aila and Karras 2010, "Architecture Considerations for Tracing Incoherent Rays".

    A treelet begins at its root and takes the waiting child of largest box area while it holds at most `size` bytes. The children that
    still wait are the roots of other treelets."""
    n, areas = len(tree.children), tree.areas.tolist()
    children = np.where(tree.children < 0, n + leaf_rows(tree.children), tree.children).tolist()
    treelet, roots, number = np.full(n + len(tree.order), -1, np.int64), [0], 0
    while roots:
        waiting, used = [(0.0, roots.pop())], 0
        while waiting and used + NODE_BYTES <= size:
            _, item = heapq.heappop(waiting)
            treelet[item] = number
            used += NODE_BYTES
            if item < n:
                for child, area in zip(children[item], areas[item], strict=True):
                    if child:
                        heapq.heappush(waiting, (-area, child))
        roots += [item for _, item in waiting]
        number += 1
    return treelet


class Scheduled(NamedTuple):
    """Memory traffic of `schedule`. lines: cache lines of nodes and leaves that are loaded; moves: times that a ray enters a queue."""

    lines: int
    moves: int


def schedule(log: Walk, treelet: np.ndarray) -> Scheduled:
    """Trace rays treelet by treelet: load the treelet with most waiting rays, and let each of its rays go on until it leaves the treelet.
    Every ray makes the fetches of the log in the log's order. While a treelet is loaded, each of its lines is loaded at most once."""
    item = log.address // NODE_BYTES
    line, of = log.address // LINE, treelet[item]
    first = log.first[:-1][np.diff(log.first) > 0]
    starts = np.union1d(first, np.flatnonzero(np.concatenate([[True], of[1:] != of[:-1]])))  # first fetch of each stay in a treelet
    ends = np.append(starts[1:], len(of))
    more = np.append(~np.isin(starts[1:], first), False)  # whether the same ray has another stay
    queues: dict[int, list[np.ndarray]] = {}
    sizes = np.zeros(int(treelet.max()) + 1, np.int64)
    lines = moves = 0

    def enter(stays: np.ndarray) -> None:
        order = np.argsort(of[starts[stays]], kind="stable")
        where = of[starts[stays]][order]
        for part in np.split(stays[order], np.flatnonzero(np.diff(where)) + 1):
            if len(part):
                queues.setdefault(int(of[starts[part[0]]]), []).append(part)
                sizes[of[starts[part[0]]]] += len(part)

    enter(np.searchsorted(starts, first))
    while sizes.any():
        number = int(sizes.argmax())
        stays = np.concatenate(queues.pop(number))
        sizes[number] = 0
        moves += len(stays)
        length = ends[stays] - starts[stays]
        at = np.repeat(starts[stays] - (np.cumsum(length) - length), length) + np.arange(int(length.sum()))
        lines += len(np.unique(line[at]))
        enter(stays[more[stays]] + 1)
    return Scheduled(lines, moves)


TREELET_BYTES = 32 << 10  # As the cache that holds a treelet.
# Of a ray that leaves for a queue and comes back: origin, direction, t, state and the top of its stack, written and read.
QUEUED_BYTES = 2 * 64
PREFETCHED_BYTES = 512


def treelets(study: Study) -> Iterator[Figure]:
    """Compare the traffic of incoherent rays from a cache per SM with that of rays that wait for treelets."""
    name = "sponza"
    rays = study.rays(name)
    chosen = (rays.kind == 0) & (rays.depth > 0)
    part, tree = rays.part(chosen), study.six(name)
    log = walk(tree, part, Rules(), log=True)
    warp = np.unique(part.warp, return_inverse=True)[1]
    accesses = fetches_of(log)
    lines = Accesses(accesses.ray, accesses.step, log.address // LINE, accesses.prefetch)
    plain = through_caches(in_order(lines, warp, SMS, SLOTS), Cache(TREELET_BYTES, TREELET_BYTES // LINE))
    found = schedule(log, cut(tree.wide, TREELET_BYTES))
    before, scene, queued = (each / len(part) for each in (plain.misses * LINE, found.lines * LINE, found.moves * QUEUED_BYTES))
    said = (f"{study.differences(name, 'several of up to 12 million triangles')}; diffuse bounces alone; nodes of bvh6; {SMS} SMs with"
            f" {TREELET_BYTES >> 10} KB and no L2; all {len(part)} rays may wait")
    numbers = f"bytes a ray: {before:.0f} from caches, {scene:.0f} of treelets, {queued:.0f} of queues"
    yield Figure("traffic that treelets save, queues not counted", 100.0 * (1.0 - scene / before), (50.0, 90.0), "%",
                 f"{said}; 'up to 90 %' in the abstract, cited as 50 to 75 %", numbers)
    yield Figure("traffic that treelets save, with the queues' own traffic", 100.0 * (1.0 - (scene + queued) / before), (50.0, 75.0), "%",
                 f"{said}; a ray takes {QUEUED_BYTES // 2} bytes in a queue, written and read", numbers)


def treelet_accesses(log: Walk, treelet: np.ndarray, warp: np.ndarray) -> Accesses:
    """Return the fetches of a log, and a prefetch of every node of the treelet that most rays of a warp are in, whenever it changes."""
    demand = fetches_of(log)
    many, steps = int(treelet.max()) + 1, int(demand.step.max()) + 1
    key, votes = np.unique((warp[demand.ray] * steps + demand.step) * many + treelet[demand.line], return_counts=True)
    when = key // many
    order = np.lexsort((key, -votes, when))
    winner = order[np.concatenate([[True], when[order][1:] != when[order][:-1]])]  # of each step of each warp
    when, chosen = when[winner], key[winner] % many
    fresh = np.concatenate([[True], (chosen[1:] != chosen[:-1]) | (when[1:] // steps != when[:-1] // steps)])
    when, chosen = when[fresh], chosen[fresh]
    members = np.argsort(treelet, kind="stable")
    first = np.searchsorted(treelet[members], np.arange(many + 1))
    length = np.diff(first)[chosen]
    at = np.repeat(first[chosen] - (np.cumsum(length) - length), length) + np.arange(int(length.sum()))
    ray = np.searchsorted(warp, when // steps)
    return Accesses(np.concatenate([demand.ray, np.repeat(ray, length)]), np.concatenate([demand.step, np.repeat(when % steps, length)]),
                    np.concatenate([demand.line, members[at]]), np.concatenate([demand.prefetch, np.ones(len(at), np.int8)]))


def treelet_prefetch(study: Study) -> Iterator[Figure]:
    """Prefetch the treelet that most rays of a warp are in, and count the nodes that leave the cache unused."""
    name = "sponza"
    log, warp, tree = study.ttp(name), study.rays(name).warp, study.six(name)
    l1 = fully_associative(32 << 10, NODE_BYTES)
    shares = []
    for size in (PREFETCHED_BYTES, PREFETCHED_BYTES // 2):
        found = through_caches(in_order(treelet_accesses(log, cut(tree.wide, size), warp), warp, SMS, SLOTS), l1)
        shares.append(100.0 * (1.0 - found.used / max(found.prefetches, 1)))
    yield Figure("prefetched nodes that no ray uses", shares[0], 43.5, "%",
                 f"{study.differences(name, THEIRS[name])}; treelets of {PREFETCHED_BYTES} bytes; a prefetch for each change of the"
                 " treelet that most"
                 " rays of a warp are in", f"treelets of {PREFETCHED_BYTES // 2} bytes: {shares[1]:.1f} % unused")


def cwbvh(study: Study) -> Iterator[Figure]:
    """Compare the memory and the bytes a ray of compressed wide nodes with those of an uncompressed binary tree."""
    for name in ("bunny", "sponza"):
        scene, rays = study.scene(name), study.rays(name)
        diffuse = rays.part((rays.kind == 0) & (rays.depth > 0))
        sizes, moved = {}, {}
        for structure in ("bvh2", "bvh8c"):
            accel = build(scene.geometry, structure)
            counters = counters_of(accel, diffuse)
            sizes[structure] = accel.stats.bytes / len(scene.geometry)
            moved[structure] = float((counters.node_bytes.astype(np.float64) + counters.primitive_bytes).mean())
        numbers = (f"bytes a triangle {sizes['bvh2']:.0f} to {sizes['bvh8c']:.0f}, triangles included; bytes a diffuse ray"
                   f" {moved['bvh2']:.0f} to {moved['bvh8c']:.0f}")
        yield Figure(f"memory of bvh8c over bvh2, {name}", 100.0 * sizes["bvh8c"] / sizes["bvh2"], (35.0, 60.0), "%",
                     f"{study.differences(name, 'their own scenes')}; nodes of 96 bytes with references instead of 80; triangles of 40"
                     " bytes count",
                     numbers)
        yield Figure(f"bytes a diffuse ray of bvh8c over bvh2, {name}", 100.0 * moved["bvh8c"] / moved["bvh2"], None, "%", "", numbers)


NODE, TRIANGLE = (228, 96), (36, 9)  # bytes in float32, and in 8 bits


def eight_bits(study: Study) -> Iterator[Figure]:
    """Compare bytes a ray of nodes and triangles in 8 bits with those in 32 bits, alone and shared by the rays of a warp."""
    name = "sponza"
    rays = study.rays(name)
    part = rays.part((rays.kind == 0) & (rays.depth > 0))
    warp = np.unique(part.warp, return_inverse=True)[1]
    logs = [walk(study.tree(name, 8, 8, bits), part, Rules(), log=True) for bits in (32, 8)]
    alone = [float((log.counts["inner"] * NODE[i] + log.counts["tests"].astype(np.float64) * TRIANGLE[i]).mean())
             for i, log in enumerate(logs)]
    boxes = float((logs[1].counts["inner"] * NODE[1] + logs[1].counts["tests"].astype(np.float64) * TRIANGLE[0]).mean())
    shared = []
    for i, log in enumerate(logs):
        item = np.unique(warp[log.owner] * (2 * len(log.fetch) + (1 << 40)) + log.addresses(log.fetch))
        at = item % (2 * len(log.fetch) + (1 << 40))
        inner = at < NODE_BYTES * log.nodes
        tests = logs[i].counts["tests"].sum() / max(logs[i].counts["leaves"].sum(), 1)
        shared.append(float((inner.sum() * NODE[i] + (~inner).sum() * tests * TRIANGLE[i]) / len(part)))
    said = (f"{study.differences(name, 'their own scenes')}; diffuse bounces; sizes of nodes and triangles as published: {NODE[0]} to"
            f" {NODE[1]}"
            f" and {TRIANGLE[0]} to {TRIANGLE[1]} bytes")
    numbers = (f"bytes a ray: {alone[0]:.0f} in 32 bits, {boxes:.0f} with boxes of 8 bits, {alone[1]:.0f} with triangles too; shared by"
               " the rays"
               f" of a warp {shared[0]:.0f} and {shared[1]:.0f}")
    yield Figure("traffic in 8 bits with nodes shared by 32 rays, over 32 bits unshared", 100.0 * shared[1] / alone[0], 18.0, "%",
                 f"{said}; a warp of 32 rays in place of a stream", numbers)
    yield Figure("traffic in 8 bits over 32 bits, rays alone", 100.0 * alone[1] / alone[0], None, "%", said, numbers)


TREELETS = Claim("Aila, Karras: Architecture Considerations for Tracing Incoherent Rays, HPG 2010, abstract; later papers cite 50 to 75 %",
                 "treelets of the size of the cache, queues of rays, incoherent rays, scenes far larger than the caches",
                 "abstract", treelets)
TREELET_PREFETCH = Claim("Chou, Nowicki, Aamodt: Treelet Prefetching for Ray Tracing, MICRO 2023, doi 10.1145/3613424.3614288",
                         "LumiBench, Vulkan-Sim; treelets of 512 bytes", "quoted", treelet_prefetch)
CWBVH = Claim("Ylitie, Karras, Laine: Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs, HPG 2017, abstract",
              "8 children in 80 bytes; memory over that of an uncompressed tree", "abstract", cwbvh)
EIGHT_BITS = Claim("Grauer, Hanika, Dachsbacher, arXiv 2505.24653 (2025)", "8 children, 8 bits for boxes and triangles, streams of rays",
                   "quoted", eight_bits)
