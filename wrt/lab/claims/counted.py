"""The claims: nodes a ray, idle lanes and bytes of published designs, counted again."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wrt.accel.scenes.build import build
from wrt.lab.bench.rays import counters_of
from wrt.lab.claims.claim import Claim, Figure, Study
from wrt.lab.claims.scenes import AO, BOUNCES, PATH, SHADOW
from wrt.lab.claims.walks import Rays, Rules, Walk, walk
from wrt.lab.rtcore.model import WARP, Work, longest_of, predict
from wrt.lab.rtcore.parameters import GPUS

TTP = "Tozlu, Naithani, Zhou: TTP, ISCA 2026, arXiv 2605.16253"
SETUP = ("LumiBench, path tracing, 128 x 128, one sample a pixel, all rays; nodes of 6 children in 64 bytes, one primitive a leaf; children"
         " unsorted, popped entries not culled; reads of leaves count")
THEIRS = {"bunny": "144k triangles in a scene of LumiBench", "sponza": "Crytek's, 262k triangles"}
MEAN, MOST = {"bunny": 11.3, "sponza": 38.0}, {"bunny": 141.0, "sponza": 335.0}
NODE, TRIANGLE = (228, 96), (36, 9)  # bytes in float32, and in 8 bits


# --- nodes a ray ------------------------------------------------------------------------------------------------------

def ttp_nodes(study: Study) -> Iterator[Figure]:
    """Count nodes a ray in the walk of Vulkan-Sim, for all rays and for those without shadow rays."""
    for name in THEIRS:
        log, path = study.ttp(name), study.rays(name).kind == 0
        fetches, hit = log.fetches, log.counts["prim_id"] >= 0
        said = f"{study.differences(name, THEIRS[name])}; up to {BOUNCES} diffuse bounces"
        kinds = (f"camera and bounce rays that hit take {fetches[path & hit].mean():.1f} nodes, shadow rays, {np.mean(~path):.0%} of all,"
                 f" {fetches[~path].mean():.1f}")
        yield Figure(f"nodes a ray, {name}, camera, bounce and shadow rays", float(fetches.mean()), MEAN[name], "nodes",
                     f"{said}, with shadow rays to one light", kinds)
        yield Figure(f"nodes a ray, {name}, camera and bounce rays", float(fetches[path].mean()), MEAN[name], "nodes",
                     f"{said}, without shadow rays", kinds)
        yield Figure(f"most nodes of a ray, {name}", float(fetches.max()), MOST[name], "nodes", said, kinds)


# --- lanes of warps ---------------------------------------------------------------------------------------------------

def parents(log: Walk) -> np.ndarray:
    """Return the fetch that pushed each fetch, (M,) int64; -1 for a root. The log must be one of a stack without culling."""
    out, entered = np.full(len(log.fetch), -1, np.int64), log.entered.tolist()
    for first, end in zip(log.first[:-1].tolist(), log.first[1:].tolist(), strict=True):
        stack: list[int] = []
        for fetch in range(first, end):
            if stack:
                out[fetch] = stack.pop()
            stack += [fetch] * entered[fetch]
    return out


def helped(log: Walk, warp: np.ndarray) -> np.ndarray:
    """Return the steps of each warp if its 32 lanes take the waiting entries of all its rays, the oldest first, (W,) int64; `parents`
    says which logs. A bound of Tozlu and Zhou 2025, "CoopRT": an idle lane takes any entry that waits in the warp."""
    parent, of, steps = parents(log), warp[log.owner], np.zeros(int(warp[-1]) + 1, np.int64)
    by_parent = np.lexsort((-np.arange(len(parent)), parent))  # in the order of the pushes, as a stack pops the last one first
    begin, end = (np.searchsorted(parent[by_parent], np.arange(len(parent)), side) for side in ("left", "right"))
    waiting = np.flatnonzero(parent < 0)  # sorted by warp, then by age
    while len(waiting):
        steps[np.unique(of[waiting])] += 1
        place = np.arange(len(waiting)) - np.searchsorted(of[waiting], of[waiting])
        taken, left = waiting[place < WARP], waiting[place >= WARP]
        length = end[taken] - begin[taken]
        pushed = by_parent[np.repeat(end[taken] - np.cumsum(length), length) + np.arange(int(length.sum()))]
        waiting = np.concatenate([left, pushed])
        waiting = waiting[np.argsort(of[waiting], kind="stable")]
    return steps


def coop_rt(study: Study) -> Iterator[Figure]:
    """Measure the share of active lanes without and with help, and the gain of help, by workload."""
    name = "sponza"
    gains, said = {}, study.differences(name, THEIRS[name])
    for workload in (PATH, AO, SHADOW):
        log, warp = study.ttp(name, workload), study.rays(name, workload).warp
        cost = log.fetches.astype(np.float64)
        alone, together = longest_of(cost, warp).sum(), helped(log, warp).sum()
        gains[workload] = float(alone / together), float(cost.sum() / (WARP * alone)), float(cost.sum() / (WARP * together))
    bound = "one step a node, no memory: the gain is an upper bound; any idle lane takes any waiting entry of its warp"
    _, active, after = gains[PATH]
    yield Figure("active lanes, path tracing", 100.0 * active, (30.0, 70.0), "%", said,
                 f"the scene decides: {active:.1%} here, 30.5 % in their bathroom")
    yield Figure("active lanes with help, path tracing", 100.0 * after, 94.6, "%", f"{said}; their bathroom; {bound}",
                 f"help lifts {active:.1%} to {after:.1%}: at the ends of its rays a warp has fewer entries than lanes")
    for workload, published in ((PATH, 2.15), (AO, 1.42), (SHADOW, 1.28)):
        yield Figure(f"gain of help, {workload}", gains[workload][0], published, "ratio", f"{said}; {bound}",
                     f"lanes active {gains[workload][1]:.1%} without and {gains[workload][2]:.1%} with help; a gain in steps leaves out"
                     " waits for memory")
    rays, accel, gpu = study.rays(name), build(study.scene(name).geometry, "bvh6"), GPUS["rtx2060"]
    part = rays.part(rays.kind == 0)
    work = Work(PATH, counters_of(accel, part, trace=True), np.unique(part.warp, return_inverse=True)[1])
    few, many = (predict(work, gpu, replace(gpu.core, boxes=6.0, warps=warps)) for warps in (4, 32))
    yield Figure("speed with 32 warps at a time over 4, path tracing", many.rays_per_second / few.rays_per_second, 1.64, "ratio",
                 f"{said}; the model of docs/rt_core.md in place of a simulator; one node of six boxes a clock assumed; camera and bounce"
                 " rays, sorted and culled", f"4 warps wait for {few.limit}: {few.clocks[few.limit]:.1f} clocks a ray; 32 for"
                 f" {many.limit}: {many.clocks[many.limit]:.1f}")


# --- bytes ------------------------------------------------------------------------------------------------------------

def diffuse(rays: Rays) -> Rays:
    """Return the diffuse bounces of a workload."""
    return rays.part((rays.kind == 0) & (rays.depth > 0))


def cwbvh(study: Study) -> Iterator[Figure]:
    """Compare the memory and the bytes a ray of compressed wide nodes with those of an uncompressed binary tree."""
    for name in THEIRS:
        geometry, sizes, moved = study.scene(name).geometry, {}, {}
        for structure in ("bvh2", "bvh8c"):
            accel = build(geometry, structure)
            counters = counters_of(accel, diffuse(study.rays(name)))
            sizes[structure] = accel.stats.bytes / len(geometry)
            moved[structure] = float((counters.node_bytes.astype(np.float64) + counters.primitive_bytes).mean())
        yield Figure(f"memory of bvh8c over bvh2, {name}", 100.0 * sizes["bvh8c"] / sizes["bvh2"], (35.0, 60.0), "%",
                     f"{study.differences(name, 'their own scenes')}; nodes of 96 bytes with references instead of 80; triangles of 40"
                     " bytes count", f"bytes a triangle {sizes['bvh2']:.0f} to {sizes['bvh8c']:.0f}, triangles included; bytes a diffuse"
                     f" ray {moved['bvh2']:.0f} to {moved['bvh8c']:.0f}")


def eight_bits(study: Study) -> Iterator[Figure]:
    """Compare bytes a ray of nodes and triangles in 8 bits with those in 32 bits, alone and shared by the rays of a warp."""
    rays = diffuse(study.rays("sponza"))
    warp = np.unique(rays.warp, return_inverse=True)[1]
    alone, shared = [], []
    for bits, node, triangle in zip((32, 8), NODE, TRIANGLE, strict=True):
        log = walk(study.tree("sponza", 8, 8, bits), rays, Rules())
        alone.append(float((log.counts["inner"] * node + log.counts["tests"].astype(np.float64) * triangle).mean()))
        inner = np.unique(warp[log.owner] * (1 << 32) + log.fetch) % (1 << 32) < 1 << 31  # of each node or leaf that a warp fetches
        tests = log.counts["tests"].sum() / max(log.counts["leaves"].sum(), 1)
        shared.append(float((inner.sum() * node + (~inner).sum() * tests * triangle) / len(rays)))
    said = (f"{study.differences('sponza', 'their own scenes')}; diffuse bounces; sizes of nodes and triangles as published: {NODE[0]} to"
            f" {NODE[1]} and {TRIANGLE[0]} to {TRIANGLE[1]} bytes")
    yield Figure("traffic in 8 bits with nodes shared by 32 rays, over 32 bits unshared", 100.0 * shared[1] / alone[0], 18.0, "%",
                 f"{said}; a warp of 32 rays in place of a stream",
                 f"bytes a ray: {alone[0]:.0f} in 32 bits, {alone[1]:.0f} in 8; shared by the rays of a warp {shared[0]:.0f} and"
                 f" {shared[1]:.0f}")


TTP_NODES = Claim(f"{TTP}, Table I", SETUP, "read", ttp_nodes)
COOP_RT = Claim("Tozlu, Zhou: CoopRT, ISCA 2025, doi 10.1145/3695053.3731118, Figures 9, 10 and 17",
                "RTX 2060 model: 30 SMs, L1 64 KB, L2 3 MB, 256 x 256, one sample; mean of LumiBench", "quoted", coop_rt)
CWBVH = Claim("Ylitie, Karras, Laine: Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs, HPG 2017, abstract",
              "8 children in 80 bytes; memory over that of an uncompressed tree", "abstract", cwbvh)
EIGHT_BITS = Claim("Grauer, Hanika, Dachsbacher, arXiv 2505.24653 (2025)", "8 children, 8 bits for boxes and triangles, streams of rays",
                   "quoted", eight_bits)
