"""Older claims: predictors of a tree's cost, planes of any orientation, sorted rays, and watertight tests."""

from collections.abc import Iterator

import numpy as np

from wrt.accel.bvh.builders import BVH_BUILDERS
from wrt.accel.cells.kdtree import KdTree
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.kernels.traverse.kdtree import LEAF
from wrt.lab.bench.rays import ball_around, counters_of, random
from wrt.lab.bench.visibility import terrain
from wrt.lab.claims.claim import SAME_SCENE, Claim, Figure, Study
from wrt.lab.claims.prefetch import SLOTS, SMS, fetches_of, fully_associative, in_order, through_caches
from wrt.lab.claims.walks import NODE_BYTES, Rays, Rules, walk
from wrt.lab.rtcore.warps import by_coherence, efficiency, packed
from wrt.scene.shapes import icosphere

RANDOM_RAYS = 40_000


def correlation(a: list[float], b: list[float]) -> float:
    return float(np.corrcoef(a, b)[0, 1])


def predictors(study: Study) -> Iterator[Figure]:
    """Correlate SAH cost and end-point overlap with measured steps, over all builders of bvh2."""
    for name in ("bunny", "sponza"):
        scene, rays = study.scene(name), study.rays(name)
        _, _, center, radius = ball_around(scene.geometry)
        lines = random(RANDOM_RAYS, center, radius, np.random.default_rng(0))
        part = rays.part((rays.kind == 0) & (rays.depth > 0))
        sah, epo, crossing, ending, spread = (list[float]() for _ in range(5))
        for builder in BVH_BUILDERS:
            accel = build(scene.geometry, "bvh2", builder=builder)
            sah.append(float(accel.stats.sah_cost))
            epo.append(accel.epo())
            for out, traced in ((crossing, lines), (ending, part)):
                counters = counters_of(accel, traced)
                out.append(float((counters.nodes + counters.primitives).mean()))
            spread.append(float(counters.leaves.std()))
        mixes = [correlation([(1.0 - a) * s + a * e for s, e in zip(sah, epo, strict=True)], ending) for a in np.linspace(0.0, 1.0, 101)]
        said = f"{study.differences(name, 'their own scenes')}; {len(sah)} builders of bvh2; no number was at hand to compare with"
        yield Figure(f"correlation of SAH cost with steps, random lines, {name}", correlation(sah, crossing), None, "", said)
        yield Figure(f"correlation of SAH cost with steps, diffuse rays, {name}", correlation(sah, ending), None, "", said)
        yield Figure(f"correlation of end-point overlap with steps, diffuse rays, {name}", correlation(epo, ending), None, "", said)
        yield Figure(f"correlation of the best mix of both with steps, diffuse rays, {name}", max(mixes), None, "",
                     f"{said}; {int(np.argmax(mixes))} % end-point overlap")
        yield Figure(f"correlation of the leaves' variability with steps, diffuse rays, {name}", correlation(spread, ending), None, "",
                     f"{said}; standard deviation of the leaves a ray visits")


def cells(study: Study) -> Iterator[Figure]:
    """Compare steps a ray of BSP, k-d tree and BVH."""
    for name in ("bunny", "sponza"):
        rays = study.rays(name)
        part = rays.part(rays.kind == 0)
        found = {}
        for structure in ("bvh2", "kdtree", "bsp"):
            counters = counters_of(build(study.scene(name).geometry, structure), part)
            found[structure] = float(counters.nodes.mean()), float(counters.primitives.mean())
        for structure in ("kdtree", "bsp"):
            (nodes, tests), (of_bvh, tests_of_bvh) = found[structure], found["bvh2"]
            yield Figure(f"triangle tests of {structure} over bvh2, {name}", tests / tests_of_bvh, None, "ratio",
                         f"{study.differences(name, 'their own scenes')}; no number was at hand to compare with; nodes a ray {nodes:.1f}"
                         " against"
                         f" {of_bvh:.1f}, triangles {tests:.2f} against {tests_of_bvh:.2f}")


def split_references(tree: KdTree) -> int:
    """Sum the number of different primitives in a cell over the cells that the build split."""
    nodes, n = tree.built.arrays["nodes"], len(tree.geometry)
    leaf, first = (nodes["word"] & 3) == LEAF, (nodes["word"] >> 2).astype(np.int64)
    levels, level = [], np.zeros(1, np.int64)
    while len(level):
        levels.append(level)
        level = np.concatenate([first[level[~leaf[level]]] + side for side in (0, 1)])
    parent = np.zeros(len(nodes), np.int64)
    for side in (0, 1):
        parent[first[~leaf] + side] = np.flatnonzero(~leaf)
    total, below = 0, np.zeros(0, np.int64)  # keys of a cell and a primitive in it, for the cells of a level that were split
    for level in reversed(levels):
        total += len(below)
        ends = level[leaf[level]]
        count = nodes["split"][ends].astype(np.int64)
        at = np.repeat(first[ends] - (np.cumsum(count) - count), count) + np.arange(int(count.sum()))
        keys = np.concatenate([below, np.repeat(ends, count) * n + tree.built.order[at]])
        below = np.unique(parent[keys // n] * n + keys % n) if level[0] else keys[:0]
    return total


def kd_build(study: Study) -> Iterator[Figure]:
    """Compare the growth of a k-d build's work with that of N log N."""
    for name, meshes in (("terrain", [terrain(22 << k) for k in range(4)]), ("ball", [icosphere(k) for k in range(3, 7)])):
        size, work = np.array([(len(mesh.faces), split_references(KdTree(Geometry.of(mesh)))) for mesh in meshes], np.float64).T
        exponent, published = (np.log(each[-1] / each[0]) / np.log(size[-1] / size[0]) for each in (work, size * np.log2(size)))
        yield Figure(f"growth of the swept references over that of N log N, {name}",
                     work[-1] / work[0] / ((size * np.log2(size))[-1] / (size * np.log2(size))[0]), 1.0, "factor",
                     f"generated meshes of {size[0]:.0f} to {size[-1]:.0f} triangles (theirs: their own scenes); operations in place of"
                     " time: references of all cells that the build split, each of which it sweeps in six sorted events",
                     f"exponent {exponent:.3f} where N log N has {published:.3f}; references swept for each triangle: "
                     f"{', '.join(f'{each:.1f}' for each in work / size)}", factor=SAME_SCENE)


def reordering(study: Study) -> Iterator[Figure]:
    """Sort diffuse rays by a key of direction and origin; compare idle lanes and misses."""
    name = "sponza"
    rays = study.rays(name)
    part = rays.part((rays.kind == 0) & (rays.depth > 0))
    orders = {"order of pixels": np.arange(len(part)), "sorted": by_coherence(part.origins, part.directions),
              "random": np.random.default_rng(0).permutation(len(part))}
    misses, busy = {}, {}
    for said, order in orders.items():
        sorted_rays: Rays = part.part(order)
        log = walk(study.six(name), sorted_rays, Rules(), log=True)
        warp = packed(len(part))
        misses[said] = through_caches(in_order(fetches_of(log), warp, SMS, SLOTS), fully_associative(32 << 10, NODE_BYTES)).misses
        busy[said] = efficiency(log.fetches.astype(np.float64), warp)
    for said in ("sorted", "random"):
        yield Figure(f"L1 misses of diffuse rays, {said} over the order of pixels", misses[said] / misses["order of pixels"], None, "ratio",
                     f"{study.differences(name, 'their own scenes')}; no number was at hand to compare with; lanes busy {busy[said]:.0%}"
                     " against"
                     f" {busy['order of pixels']:.0%}; key: octant, then Morton codes of origin and direction; bvh6, L1 32 KB")


def watertight(study: Study) -> Iterator[Figure]:
    """Count rays lost at vertices and edges by the triangle tests; the watertight test must lose none."""
    rng, ball = np.random.default_rng(0), icosphere(5)
    count = 4 * study.side**2
    corners = ball.vertices[ball.faces[rng.integers(len(ball.faces), size=count)]].astype(np.float64)
    weight = rng.random(count)[:, None] * (rng.random(count) < 0.5)[:, None]  # half of the rays aim at a vertex, half at a point of an edge
    targets = (1.0 - weight) * corners[:, 0] + weight * corners[:, 1]
    origins = (0.3 * rng.normal(size=(count, 3)) / 3.0).astype(np.float32)  # inside the ball, so that every ray hits it
    directions = (targets - origins).astype(np.float32)
    lost = {}
    for test, box in (("watertight", "conservative"), ("moeller_trumbore", "minmax")):
        accel = build(ball, "bvh2", triangle=test, box=box)
        lost[test] = int((accel.closest_hit(origins, directions).prim_id < 0).sum())
    for test, number in lost.items():
        yield Figure(f"rays lost at vertices and edges, {test}", float(number), 0.0 if test == "watertight" else None, "rays",
                     f"{count} rays from inside a closed ball of {len(ball.faces)} triangles; machine instructions of a test:"
                     " docs/rt_core.md")
    name = "sponza"
    rays = study.rays(name)
    part = rays.part(rays.kind == 0)
    exact, wide = (counters_of(build(study.scene(name).geometry, "bvh2", box=box), part) for box in ("minmax", "conservative"))
    yield Figure("boxes tested a ray, conservative box test over minmax", float(wide.boxes.sum() / exact.boxes.sum()), None, "ratio",
                 f"{study.differences(name, 'their own scenes')}; Ize 2013 widens the interval of each box; triangles tested a ray"
                 f" {wide.primitives.mean():.4f} against {exact.primitives.mean():.4f}")


PREDICTORS = Claim("Aila, Karras, Laine: On Quality Metrics of Bounding Volume Hierarchies, HPG 2013",
                   "a mix of SAH and end-point overlap, and the variability of leaves, predict speed", "memory", predictors)
CELLS = Claim("Ize, Wald, Parker: Ray Tracing with the BSP Tree, RT 2008", "fewer triangle tests than k-d tree and BVH", "memory", cells)
KD_BUILD = Claim("Wald, Havran: On Building Fast kd-Trees for Ray Tracing, and on Doing That in O(N log N), RT 2006",
                 "splits by the surface area heuristic at exact planes take a time of O(N log N)", "memory", kd_build)
REORDERING = Claim("Meister et al.: On Ray Reordering Techniques for Faster GPU Ray Tracing, I3D 2020", "keys of origin and direction",
                   "memory", reordering)
WATERTIGHT = Claim("Woop, Benthin, Wald: Watertight Ray/Triangle Intersection, JCGT 2013; Ize: Robust BVH Ray Traversal, JCGT 2013",
                   "no ray is lost at edges and vertices", "memory", watertight)
