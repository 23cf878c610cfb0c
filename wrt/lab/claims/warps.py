"""Claims about warps: idle lanes and their help, repacking of rays, and the loops of software traversal."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import warp as wp

from wrt.accel.scenes.build import build
from wrt.core.device import launch, start, upload
from wrt.core.types import WarpStruct
from wrt.kernels.study import warp_loops as kernels
from wrt.lab.bench.rays import counters_of
from wrt.lab.claims.claim import Claim, Figure, Study
from wrt.lab.claims.nodes import THEIRS
from wrt.lab.claims.prefetch import device_log, replayed
from wrt.lab.claims.scenes import AO, PATH, SHADOW
from wrt.lab.claims.walks import Rays, Rules, Walk, walk
from wrt.lab.rtcore.model import Work, predict
from wrt.lab.rtcore.parameters import GPUS
from wrt.lab.rtcore.warps import WARP, longest_of

LOOP_NAMES = {"if-if": kernels.IF_IF, "while-while": kernels.WHILE_WHILE, "speculative while-while": kernels.SPECULATIVE}
# Instructions of two box tests, and of one Moeller-Trumbore test: docs/rt_core.md, "The units in machine code".
NODE_COST, TEST_COST = 70, 78
REPACK_BELOW = 22


def firsts(warp: np.ndarray) -> np.ndarray:
    """Return the index of each warp's first ray, and the end, (W + 1,) int64. warp: (N,) ascending from 0."""
    return np.searchsorted(warp, np.arange(int(warp[-1]) + 2)).astype(np.int64)


def helped(log: Walk, warp: np.ndarray) -> np.ndarray:
    """Return the steps of each warp if its lanes take the waiting entries of all its rays, (W,) int64. The log must be one of a stack."""
    cpu, first = start("cpu"), firsts(warp)
    used, _ = replayed(log)
    begin = np.cumsum(log.entered) - log.entered
    steps = wp.zeros(len(first) - 1, dtype=wp.int64, device=cpu)
    scratch = wp.empty(max(len(log.fetch), 1), dtype=wp.int64, device=cpu)
    launch(kernels.helped_steps, len(first) - 1, upload(first, wp.int64, cpu), device_log(log), upload(begin, wp.int64, cpu),
           upload(used, wp.int32, cpu), scratch, steps)
    return steps.numpy().copy()


def looped(log: Walk, warp: np.ndarray, loop: int) -> WarpStruct:
    """Return the kernels' LaneSteps of each warp under a loop, one of LOOP_NAMES."""
    cpu, first, out = start("cpu"), firsts(warp), kernels.LaneSteps()
    for name in ("node", "test", "node_lanes", "test_lanes", "rounds"):
        setattr(out, name, wp.zeros(len(first) - 1, dtype=wp.int64, device=cpu))
    launch(kernels.loop_steps, len(first) - 1, upload(first, wp.int64, cpu), device_log(log), int(loop),
           wp.zeros(len(warp), dtype=kernels.Lane, device=cpu), out)
    return out


def coop_rt(study: Study) -> Iterator[Figure]:
    """Measure the share of active lanes without and with help, and the gain of help, by workload."""
    name = "sponza"
    gains, said = {}, study.differences(name, THEIRS[name])
    for workload in (PATH, AO, SHADOW):
        log, warp = study.ttp(name, workload), study.rays(name, workload).warp
        cost = log.fetches.astype(np.float64)
        alone, together = longest_of(cost, warp), helped(log, warp)
        gains[workload] = float(alone.sum() / together.sum()), float(cost.sum() / (WARP * alone.sum())), float(
            cost.sum() / (WARP * together.sum()))
    bound = "one step a node, no memory: the gain is an upper bound; any idle lane takes any waiting entry of its warp"
    _, active, after = gains[PATH]
    yield Figure("active lanes, path tracing", 100.0 * active, (30.0, 70.0), "%", said,
                 f"the scene decides: {active:.1%} here, 30.5 % in their bathroom")
    yield Figure("active lanes with help, path tracing", 100.0 * after, 94.6, "%", f"{said}; their bathroom; {bound}",
                 f"help lifts {active:.1%} to {after:.1%}: at the ends of its rays a warp has fewer entries than lanes")
    order = " > ".join(sorted(gains, key=lambda each: -gains[each][0]))
    for workload, published in ((PATH, 2.15), (AO, 1.42), (SHADOW, 1.28)):
        yield Figure(f"gain of help, {workload}", gains[workload][0], published, "ratio", f"{said}; {bound}",
                     f"lanes active {gains[workload][1]:.1%} without and {gains[workload][2]:.1%} with help; a gain in steps leaves out"
                     " waits"
                     f" for memory. Order of the gains: {order}")
    yield occupancy(study, name, said)


def occupancy(study: Study, name: str, said: str) -> Figure:
    """Predict what more warps at a time gain. said: differences of set-up."""
    rays, accel, gpu = study.rays(name), build(study.scene(name).geometry, "bvh6"), GPUS["rtx2060"]
    part = rays.part(rays.kind == 0)
    work = Work(PATH, counters_of(accel, part, trace=True), np.unique(part.warp, return_inverse=True)[1])
    few, many = (predict(work, gpu, replace(gpu.core, boxes=6.0, warps=warps)) for warps in (4, 32))
    slow = [predict(work, gpu, replace(gpu.core, warps=warps)).rays_per_second for warps in (4, 32)]
    return Figure("speed with 32 warps at a time over 4, path tracing", many.rays_per_second / few.rays_per_second, 1.64, "ratio",
                  f"{said}; the model of docs/rt_core.md in place of a simulator; one node of six boxes a clock assumed; camera and bounce"
                  " rays, sorted and culled", f"4 warps wait for {few.limit}: {few.clocks[few.limit]:.1f} clocks a ray; 32 for"
                  f" {many.limit}: {many.clocks[many.limit]:.1f}; with 4 boxes a clock the ratio is {slow[1] / slow[0]:.2f}")


def repacked(cost: np.ndarray, warp: np.ndarray, below: int = REPACK_BELOW) -> float:
    """Return the SIMT efficiency if each warp with fewer than `below` active lanes gives up its rays, which form new full warps in turn."""
    left, group, issued = cost.astype(np.int64), warp.astype(np.int64), 0
    while len(left):
        first = firsts(group)
        sizes = np.diff(first)
        order = np.lexsort((-left, group))
        # A warp runs until only below - 1 of its rays are left: as long as its ray of that rank. The very last warp runs to its end.
        place = first[:-1] + np.minimum(below, sizes) - 1
        steps = np.where((sizes < below) & (len(sizes) > 1), 0, left[order][np.where(len(sizes) > 1, place, first[:-1])])
        issued += int(steps.sum())
        left = left - np.repeat(steps, sizes)
        left = left[left > 0]
        group = np.arange(len(left)) // WARP
    return float(cost.sum() / (WARP * issued))


def repacking(study: Study) -> Iterator[Figure]:
    """Measure SIMT efficiency over whole paths, without and with repacking of rays into full warps."""
    name = "bunny"
    log, rays = study.ttp(name), study.rays(name)
    said = (f"{study.differences(name, '144k triangles')}; SIMT efficiency counts one step a node; the paper's treelet phase is not"
            " modelled")
    # Lanes of paths that have ended idle while the others of their block of pixels go on.
    path = rays.kind == 0
    cost = log.fetches[path].astype(np.float64)
    issued = longest_of(cost, rays.warp[path])
    before = float(cost.sum() / (WARP * issued.sum()))
    packed = repacked(log.fetches[path], np.unique(rays.warp[path], return_inverse=True)[1])
    yield Figure("SIMT efficiency, paths", before, 0.37, "share", said,
                 f"bounces of {np.mean(rays.depth[path] > 0):.0%} of the rays; camera rays alone have"
                 f" {_efficiency(log, rays, path & (rays.depth == 0)):.2f}, bounces {_efficiency(log, rays, path & (rays.depth > 0)):.2f}")
    yield Figure(f"SIMT efficiency with repacking below {REPACK_BELOW} lanes", packed, 0.82, "share", said,
                 f"repacking lifts {before:.2f} to {packed:.2f}")


def _efficiency(log: Walk, rays: Rays, chosen: np.ndarray) -> float:
    cost = log.fetches[chosen].astype(np.float64)
    longest = longest_of(cost, np.unique(rays.warp[chosen], return_inverse=True)[1])
    return float(cost.sum() / max(WARP * longest.sum(), 1.0))


def loops(study: Study) -> Iterator[Figure]:
    """Compare the steps of if-if, while-while and speculative while-while loops, for primary and diffuse rays."""
    name = "conference" if "conference" in study.files else "sponza"
    rays, tree = study.rays(name), study.tree(name, 2, 8)
    published = {("if-if", "primary"): 129.3 / 166.7, ("if-if", "diffuse"): 70.5 / 81.4,
                 ("speculative while-while", "primary"): 165.7 / 166.7, ("speculative while-while", "diffuse"): 92.9 / 81.4}
    for kind, chosen in (("primary", (rays.kind == 0) & (rays.depth == 0)), ("diffuse", (rays.kind == 0) & (rays.depth > 0))):
        part = rays.part(chosen)
        warp = np.unique(part.warp, return_inverse=True)[1]
        log, cost, busy, rounds = walk(tree, part, Rules(), log=True), {}, {}, {}
        for said, loop in LOOP_NAMES.items():
            steps = looped(log, warp, loop)
            node, test, node_lanes, test_lanes = (float(getattr(steps, each).numpy().sum()) for each in
                                                  ("node", "test", "node_lanes", "test_lanes"))
            cost[said], rounds[said] = NODE_COST * node + TEST_COST * test, float(steps.rounds.numpy().sum())
            busy[said] = (NODE_COST * node_lanes + TEST_COST * test_lanes) / (WARP * cost[said])
        for said in ("if-if", "speculative while-while"):
            wanted = published[said, kind]
            control = (wanted * cost[said] - cost["while-while"]) / (rounds["while-while"] - wanted * rounds[said])
            explained = (f"; {control:.0f} more instructions for each round of the outer loop would give the published ratio"
                         if control > 0.0 else "")
            yield Figure(f"speed of {said} over while-while, {kind}", cost["while-while"] / cost[said], wanted, "ratio",
                         f"{study.differences(name, 'Conference, 282k triangles')}; simulated there as here; cost of a node {NODE_COST},"
                         " of a"
                         f" triangle {TEST_COST} instructions; nodes that speculation visits in vain are not counted",
                         f"lanes busy: {', '.join(f'{each} {share:.0%}' for each, share in busy.items())}{explained}")


COOP_RT = Claim("Tozlu, Zhou: CoopRT, ISCA 2025, doi 10.1145/3695053.3731118, Figures 9, 10 and 17",
                "RTX 2060 model: 30 SMs, L1 64 KB, L2 3 MB, 256 x 256, one sample; mean of LumiBench", "quoted", coop_rt)
REPACKING = Claim("Chou, Nowicki, Aamodt: Treelet queues, ASPLOS 2025, doi 10.1145/3676641.3716279, Figures 11 and 13",
                  "16 SMs, L1 16 KB, L2 128 KB, one warp a unit, 256 x 256, 3 bounces; bunny of 144.1k triangles; mean of the scenes",
                  "quoted", repacking)
LOOPS = Claim("Aila, Laine: Understanding the Efficiency of Ray Traversal on GPUs, HPG 2009, Table 1, simulated rates",
              "Conference; rates simulated without memory: 166.7, 129.3, 165.7 Mray/s for primary and 81.4, 70.5, 92.9 for diffuse rays",
              "memory", loops)
